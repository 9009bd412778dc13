"""One sequence of a person with all its results, for files and pictures."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.body import BodyModel
from model.linear import Subject

from ...motion import Motion
from ..artefacts.results import MarkerArtefacts
from ..files.markers import MarkerSequence
from ..soft_tissue.soft_tissue import SoftTissue
from .recordings import Recording


@dataclass(frozen=True, eq=False)
class Take:
    """One sequence of a person: its source, and its results."""

    source: Recording
    unit: str | None
    model: BodyModel
    subject: Subject
    markers: MarkerSequence
    motion: Motion
    soft: SoftTissue | None
    artefacts: MarkerArtefacts

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def shown(self) -> Motion:
        """The motion that pictures show: with soft tissue where there is one."""
        return self.motion if self.soft is None else self.soft.motion

    def make(self, frames: np.ndarray) -> np.ndarray:
        """Compute meshes (n, N, 3) of some frames, metres, with soft tissue where there is one."""
        return self.motion.vertices(self.subject, frames) if self.soft is None else \
            self.soft.vertices(self.model, frames, subject=self.subject)
