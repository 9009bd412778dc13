"""One sequence of a person with all that was found of it, for files and pictures."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from model.body import BodyModel
from model.linear import Subject

from ...energy import lifted
from ...motion import Motion, spread_frames
from ...motion_pictures import LightMesh
from ..artefacts.results import MarkerArtefacts
from ..files.markers import MarkerSequence
from ..files.motion_files import MEASURED
from ..marker_sets.layout import MarkerLayout
from ..pose.marked_body import supports
from ..soft_tissue.soft_tissue import SoftTissue
from .quick_bodies import QuickBodies
from .recordings import Recording

AT_ONCE = 128                        # frames whose changes are held at a time
KEYS = 100                           # frames of soft tissue whose bodies are exact in files and pictures that move


@dataclass(frozen=True, eq=False)
class HeldOut:
    """How far the body is (T, H), metres, from markers that no stage saw; `soft` with soft tissue, if any."""

    labels: tuple[str, ...]
    fixed: np.ndarray
    soft: np.ndarray | None

    @property
    def shown(self) -> np.ndarray:
        """(T, H) with soft tissue where there is one."""
        return self.fixed if self.soft is None else self.soft


@dataclass(frozen=True, eq=False)
class Take:
    """One sequence of a person: where it was read from, what was found of it, and a body for small pictures."""

    source: Recording
    unit: str | None
    model: BodyModel
    subject: Subject
    markers: MarkerSequence
    motion: Motion
    soft: SoftTissue | None
    artefacts: MarkerArtefacts
    held: HeldOut | None
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
        """The meshes (n, N, 3) of some frames, metres, with soft tissue where there is one; made once each."""
        new = np.array([t for t in map(int, frames) if t not in self._kept], dtype=int)
        if len(new):
            self._kept.update(zip(new.tolist(), self.make(new).astype(np.float32), strict=True))
        return np.stack([self._kept[int(t)] for t in frames]).astype(float)

    @cached_property
    def keys(self) -> np.ndarray:
        """Frames (k,) in order, spread over the sequence; those in which a GLB is measured are among them."""
        return np.union1d(*(spread_frames(len(self.motion.poses), count) for count in (KEYS, MEASURED)))

    @cached_property
    def _quick(self) -> QuickBodies | None:
        return None if self.soft is None else QuickBodies.of(
            self.model, self.subject, self.soft, np.arange(self.subject.n_vertices), self.keys, self.bodies(self.keys))

    def quick(self, frames: np.ndarray) -> np.ndarray:
        """As `make`, and exact in `keys`: in between, soft tissue is as of `QuickBodies`."""
        return self.make(frames) if self._quick is None else self._quick.vertices(frames)

    def make(self, frames: np.ndarray) -> np.ndarray:
        """As `bodies`, which are not kept."""
        return self.motion.vertices(self.subject, frames) if self.soft is None else \
            self.soft.vertices(self.model, frames)

    def rigid(self, frames: Sequence[int] | np.ndarray) -> np.ndarray:
        """The meshes (n, N, 3) of the same poses with the person's own shape."""
        return self.shown.vertices(self.subject, np.asarray(frames)).astype(float)


def held_out(model: BodyModel, layout: MarkerLayout, labels: Sequence[str], markers: MarkerSequence, motion: Motion,
             soft: SoftTissue | None) -> HeldOut | None:
    """How far a motion is from markers of the layout that it was not made from; None where there are none of them."""
    wanted = {layout.aliases.get(label, label) for label in labels}
    known = layout.matched(markers.labels, 0)
    names = tuple(label for label in known if layout.aliases.get(label, label) in wanted)
    if not names:
        return None
    places = layout.select(names)
    ids, weights = supports(model.template, places)
    lift, seen = np.asarray(places.distances), markers.select(names).positions
    assert motion.betas is not None, "a person of a shape space"
    K = len(motion.betas) if soft is None else max(len(motion.betas), soft.changes.shape[1])
    shaped = model.points(ids, weights, K)
    points = shaped.operator(motion.betas)
    fixed = lifted(points.evaluate(motion.poses, motion.trans), lift)
    if soft is None:
        return HeldOut(names, np.linalg.norm(fixed - seen, axis=2), None)
    moving = points.evaluate(soft.motion.poses, soft.motion.trans)
    changes = np.pad(soft.changes, ((0, 0), (0, K - soft.changes.shape[1])))
    for start in range(0, len(moving), AT_ONCE):
        some = slice(start, start + AT_ONCE)
        moving[some] += np.einsum("tk,tldk->tld", changes[some], shaped.shape_jacobian(soft.motion.poses[some]))
    return HeldOut(names, np.linalg.norm(fixed - seen, axis=2), np.linalg.norm(lifted(moving, lift) - seen, axis=2))
