"""Sliders of shape, pose and place, shared by all models that are shown."""
from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from model.priors import LEAST_POSES, JointLimits, sample_poses
from scanprep.ranges import BETAS, TURNS

from .dragging import Drag
from .movable import MovableBody


@dataclass(frozen=True, eq=False)
class Shown:
    """The body of a model, and the pane and layer that show it."""

    body: MovableBody
    name: str
    pane: int
    layer: int


@dataclass(eq=False)
class Controls:
    """The state of the sliders.

    All models with at least k betas share the k-th beta; parts of the same name share their angles. A model without
    betas shows its template's own body.
    """

    shown: list[Shown] = field(default_factory=list)
    betas: np.ndarray = field(default_factory=lambda: np.zeros(0))
    turns: dict[str, np.ndarray] = field(default_factory=dict)
    trans: np.ndarray = field(default_factory=lambda: np.zeros(3))
    chosen: str = ""                     # part whose angles are shown
    held: tuple[Shown, Drag] | None = None
    rng: np.random.Generator = field(default_factory=np.random.default_rng)

    def take(self, shown: list[Shown]) -> None:
        """Take other bodies; the sliders keep their values where the new bodies have them."""
        count = max([one.body.model.n_betas for one in shown], default=0)
        betas = np.zeros(count)
        betas[:min(count, len(self.betas))] = self.betas[:count]
        names = dict.fromkeys(name for one in shown for name in one.body.parts)
        self.turns = {name: self.turns.get(name, np.zeros(3)) for name in names}
        self.shown, self.betas, self.held = shown, betas, None
        if self.chosen not in names:
            self.chosen = next(iter(names), "")

    def pose_of(self, body: MovableBody) -> np.ndarray:
        """Return the pose (J, 3) of a body, radians."""
        return np.array([self.turns[name] for name in body.parts])

    def betas_of(self, body: MovableBody) -> np.ndarray | None:
        """Return the betas (K,) of a body, or None for a model without betas."""
        return self.betas[:body.model.n_betas] if body.model.n_betas else None

    def vertices(self, body: MovableBody) -> np.ndarray:
        """Compute the vertices (N, 3) float32, metres, relative to the body's `origin`."""
        return body.vertices(self.betas_of(body), self.pose_of(body), self.trans)

    # what sliders and buttons do

    def set_beta(self, index: int, value: float) -> None:
        """Set one shape coefficient, standard deviations."""
        if not 0 <= index < len(self.betas):
            raise ValueError(f"index: expected 0 to {len(self.betas) - 1}, got {index}")
        BETAS.check(np.array(value), "betas")
        betas = self.betas.copy()
        betas[index] = value
        self.betas = betas

    def set_turn(self, part: str, turn: list[float]) -> None:
        """Turn a part relative to its parent, axis-angle in radians."""
        value = np.asarray(turn, dtype=float)
        if part not in self.turns or value.shape != (3,):
            raise ValueError(f"part: expected one of {', '.join(self.turns)} and three angles, got {part} {turn}")
        TURNS.check(value, "pose")
        self.turns[part] = value

    def random_body(self) -> None:
        """Draw random betas, distributed like those of the training people."""
        self.betas = self.rng.normal(size=len(self.betas))

    def random_pose(self) -> None:
        """Draw a pose from the pose prior of the first model, within the seen limits of its joints."""
        if not self.shown:
            return
        body = self.shown[0].body
        examples = body.model.pose_examples
        limits = JointLimits.from_poses(examples) if len(examples) >= LEAST_POSES else None
        pose = sample_poses(body.model, 1, self.rng, limits)[0]
        pose[0] = 0
        self.turns.update(zip(body.parts, pose, strict=True))
        self.trans = np.zeros(3)

    def reset(self) -> None:
        """Return to the mean body at rest."""
        self.betas = np.zeros_like(self.betas)
        self.turns = {name: np.zeros(3) for name in self.turns}
        self.trans = np.zeros(3)

    # dragging

    def choose_part(self, part: str) -> None:
        """Choose the part whose angles are shown."""
        if part in self.turns:
            self.chosen = part

    def choose(self, pane: int, layer: int, vertex: int) -> Shown:
        """Choose the part that was clicked."""
        one = next((one for one in self.shown if (one.pane, one.layer) == (pane, layer)), None)
        if one is None:
            raise ValueError(f"pane and layer: expected a model's body, got {pane}, {layer}")
        if not 0 <= vertex < len(one.body.part_of_vertex):
            raise ValueError(f"vertex: expected 0 to {len(one.body.part_of_vertex) - 1}, got {vertex}")
        self.chosen = one.body.parts[int(one.body.part_of_vertex[vertex])]
        return one

    def grab(self, pane: int, layer: int, vertex: int) -> None:
        """Grab a vertex."""
        one = self.choose(pane, layer, vertex)
        self.held = one, Drag(one.body, vertex, self.betas_of(one.body), self.pose_of(one.body))

    def drag(self, target: list[float]) -> None:
        """Drag the grabbed vertex towards a place (3,), metres."""
        wanted = np.asarray(target, dtype=float)
        if wanted.shape != (3,) or not np.isfinite(wanted).all():
            raise ValueError(f"target: expected three finite numbers, got {target}")
        if self.held is not None:
            one, held = self.held
            pose, self.trans = held.drag_to(self.pose_of(one.body), self.trans, wanted)
            self.turns.update(zip(one.body.parts, pose, strict=True))
