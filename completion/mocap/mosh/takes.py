"""One sequence of a person with all its results, for files and pictures."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from model.body import BodyModel
from model.linear import Subject

from ...motion import Motion
from ...motion_pictures import LightMesh
from ..artefacts.results import MarkerArtefacts
from ..files.markers import MarkerSequence
from ..soft_tissue.soft_tissue import SoftTissue
from .recordings import Recording


@dataclass(frozen=True, eq=False)
class Take:
    """One sequence of a person: its source, its results, and a light mesh for small pictures."""

    source: Recording
    unit: str | None
    model: BodyModel
    subject: Subject
    markers: MarkerSequence
    motion: Motion
    soft: SoftTissue | None
    artefacts: MarkerArtefacts
    light: LightMesh
    _kept: dict[int, np.ndarray] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def shown(self) -> Motion:
        """The motion that pictures show: with soft tissue where there is one."""
        return self.motion if self.soft is None else self.soft.motion

    def bodies(self, frames: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return meshes (n, N, 3) of some frames, metres, with soft tissue where there is one; each is made once."""
        new = np.array([t for t in map(int, frames) if t not in self._kept], dtype=int)
        if len(new):
            self._kept.update(zip(new.tolist(), self.make(new).astype(np.float32), strict=True))
        return np.stack([self._kept[int(t)] for t in frames]).astype(float)

    def make(self, frames: np.ndarray) -> np.ndarray:
        """Compute meshes (n, N, 3) of some frames, metres, without keeping them."""
        return self.motion.vertices(self.subject, frames) if self.soft is None else \
            self.soft.vertices(self.model, frames, subject=self.subject)

    def rigid(self, frames: Sequence[int] | np.ndarray) -> np.ndarray:
        """Compute meshes (n, N, 3) of the same poses with the person's own shape, metres."""
        return self.shown.vertices(self.subject, np.asarray(frames)).astype(float)
