"""Learning from large meshes: on fewer vertices, and finished at full resolution."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scanprep.decimation.decimate import decimate
from scanprep.geometry.carrier import SurfaceCarrier, mount
from scanprep.geometry.mesh import Mesh, check_template
from scanprep.skeleton.tree import Skeleton

from ..body import BodyModel, Progress
from ..resolution.change import change_resolution
from ..resolution.transfer import transfer_skeleton

LARGE = 60_000                       # vertices from which on learning takes more than 1 GB
# Vertices that are then learned on. Held-out SCAPE poses of 50,000 vertices are 8.81 mm off, learned on 25,000 of them
# 8.78 mm, and on 12,500 8.80 mm.
LEARNED = 20_000


@dataclass(frozen=True, eq=False)
class Resolutions:
    """A template, and the one of fewer vertices on which its model is learned; a small template is learned on itself.

    Attributes
    ----------
    full : Mesh
        The template of the meshes.
    """

    full: Mesh

    @cached_property
    def learned(self) -> Mesh:
        """The template that is learned on."""
        if len(self.full.vertices) < LARGE:
            return self.full
        check_template(self.full)
        return decimate(self.full, 2 * LEARNED)

    @cached_property
    def _carrier(self) -> SurfaceCarrier:
        return mount(self.full, self.learned)

    def reduce(self, bodies: np.ndarray) -> np.ndarray:
        """Compute bodies (M, N, 3) on the vertices that are learned on, (M, n, 3); one by one, to save memory."""
        if self.learned is self.full:
            return bodies
        return np.stack([self._carrier.positions(body) for body in bodies])

    def reduce_skeleton(self, skeleton: Skeleton) -> Skeleton:
        """Transfer a skeleton of the full template to the one that is learned on."""
        if self.learned is self.full:
            return skeleton
        return transfer_skeleton(skeleton, self.full, self.learned).with_root_centred(self.learned)

    def finish(self, models: Mapping[str, BodyModel], digests: list[str], progress: Progress) -> dict[str, BodyModel]:
        """Bring learned models to the full template; they keep the digests of the full bodies of their learning."""
        if self.learned is self.full:
            return dict(models)
        finished = {}
        for k, (name, model) in enumerate(models.items()):
            moved = change_resolution(model, self.full, rounds=0)
            finished[name] = replace(moved, info=moved.info | {"digests": digests})      # type: ignore[type-var]
            progress(k + 1, len(models))
        return finished
