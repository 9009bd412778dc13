"""Sliders of shape and pose, shared by all models that are shown."""
from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from scanprep.ranges import BETAS, TURNS

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
    chosen: str = ""                     # part whose angles are shown

    def take(self, shown: list[Shown]) -> None:
        """Take other bodies; the sliders keep their values where the new bodies have them."""
        count = max([one.body.model.n_betas for one in shown], default=0)
        betas = np.zeros(count)
        betas[:min(count, len(self.betas))] = self.betas[:count]
        names = dict.fromkeys(name for one in shown for name in one.body.parts)
        self.turns = {name: self.turns.get(name, np.zeros(3)) for name in names}
        self.shown, self.betas = shown, betas
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
        return body.vertices(self.betas_of(body), self.pose_of(body))

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

    def reset(self) -> None:
        """Return to the mean body at rest."""
        self.betas = np.zeros_like(self.betas)
        self.turns = {name: np.zeros(3) for name in self.turns}

    def choose_part(self, part: str) -> None:
        """Choose the part whose angles are shown."""
        if part in self.turns:
            self.chosen = part
