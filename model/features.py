"""What a pose model is linear in: functions of the joint twists, and their products with part rotations."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from scanprep.geometry import rotations, storage
from scanprep.skeleton.tree import Skeleton

_FIRST, _SECOND = np.triu_indices(3)


def twists(pose: np.ndarray) -> np.ndarray:
    """The twists (..., J, 3), radians, at most π long, of poses (..., J, 3) of any length.

    [SCAPE] §4.2
    """
    pose = np.asarray(pose, dtype=np.float64)
    far = np.linalg.norm(pose, axis=-1, keepdims=True) > np.pi
    return np.where(far, rotations.log(rotations.exp(pose)), pose) if far.any() else pose


class Lift(Protocol):
    """A fixed map of the twists of each joint to a few numbers a joint, in which a regression is linear.

    Its kind names it in files; width is m, the numbers of each joint.
    """

    kind: str

    @property
    def width(self) -> int: ...

    def evaluate(self, t: np.ndarray) -> np.ndarray:
        """Values (..., J, m) at twists (..., J, 3), radians."""
        ...

    def derivative(self, t: np.ndarray) -> np.ndarray:
        """Derivatives (..., J, m, 3) of the values of each joint by its own twist (..., J, 3)."""
        ...


@dataclass(frozen=True)
class LinearLift:
    """The twist itself.

    [SCAPE] Eq. 3
    """

    kind = "linear"
    width = 3

    def evaluate(self, t: np.ndarray) -> np.ndarray:
        return t

    def derivative(self, t: np.ndarray) -> np.ndarray:
        return np.broadcast_to(np.eye(3), (*t.shape, 3))


@dataclass(frozen=True)
class QuadraticLift:
    """The twist and the six products of its entries."""

    kind = "quadratic"
    width = 9

    def evaluate(self, t: np.ndarray) -> np.ndarray:
        return np.concatenate([t, t[..., _FIRST] * t[..., _SECOND]], axis=-1)

    def derivative(self, t: np.ndarray) -> np.ndarray:
        eye = np.eye(3)
        product = t[..., _FIRST, None] * eye[_SECOND] + t[..., _SECOND, None] * eye[_FIRST]
        return np.concatenate([np.broadcast_to(eye, (*t.shape, 3)), product], axis=-2)

    @staticmethod
    def of_directions(directions: np.ndarray) -> np.ndarray:
        """(9, k + k (k + 1) / 2) mixtures of the numbers: twists along directions (3, k), and products of these."""
        pairs = [np.outer(directions[:, a], directions[:, b])
                 for a, b in zip(*np.triu_indices(directions.shape[1]), strict=True)]
        out = np.zeros((9, directions.shape[1] + len(pairs)))
        out[:3, :directions.shape[1]] = directions
        for column, pair in zip(out.T[directions.shape[1]:], pairs, strict=True):
            column[3:] = np.where(_FIRST == _SECOND, 0.5, 1.0) * (pair + pair.T)[_FIRST, _SECOND]
        return out


@dataclass(frozen=True)
class RotationLift:
    """The rotation less the identity, row by row.

    Loper et al., SMPL, 2015.
    """

    kind = "rotation"
    width = 9

    def evaluate(self, t: np.ndarray) -> np.ndarray:
        return (rotations.exp(t) - np.eye(3)).reshape(*t.shape[:-1], 9)

    def derivative(self, t: np.ndarray) -> np.ndarray:
        along = rotations.hat(np.swapaxes(rotations.right_jacobian(t), -1, -2))                # of every parameter
        return np.moveaxis(rotations.exp(t)[..., None, :, :] @ along, -3, -1).reshape(*t.shape[:-1], 9, 3)


@dataclass(frozen=True)
class QuaternionLift:
    """The unit quaternion (x, y, z, w) of the rotation, less that of none.

    Osman et al., STAR, 2020.
    """

    kind = "quaternion"
    width = 4

    def evaluate(self, t: np.ndarray) -> np.ndarray:
        half = np.linalg.norm(t, axis=-1, keepdims=True) / 2
        return np.concatenate([0.5 * np.sinc(half / np.pi) * t, np.cos(half) - 1], axis=-1)

    def derivative(self, t: np.ndarray) -> np.ndarray:
        # a rotation vector d from the right changes q = (v, w) by (w d + v × d, -v · d) / 2
        q = self.evaluate(t)
        v, w = q[..., :3], q[..., 3, None, None] + 1
        by_turn = np.concatenate([w * np.eye(3) + rotations.hat(v), -v[..., None, :]], axis=-2) / 2
        return by_turn @ rotations.right_jacobian(t)


LIFTS: dict[str, Lift] = {lift.kind: lift for lift in (LinearLift(), QuadraticLift(), RotationLift(),
                                                       QuaternionLift())}


def lift_twists(lift: Lift, pose: np.ndarray) -> np.ndarray:
    """The lifted twists (..., J, m) of poses (..., J, 3) of any length."""
    return lift.evaluate(twists(pose))


def lift_derivative(lift: Lift, pose: np.ndarray) -> np.ndarray:
    """(..., J, m, 3) derivative of the lifted twists of each joint by its pose parameters (..., J, 3)."""
    pose = np.asarray(pose, dtype=np.float64)
    t = twists(pose)
    slope = lift.derivative(t)
    far = np.linalg.norm(pose, axis=-1) > np.pi
    if far.any():
        turn = rotations.inverse_right_jacobian(t[far]) @ rotations.right_jacobian(pose[far])
        slope = slope.copy()
        slope[far] = slope[far] @ turn
    return slope


def restore_features(skeleton: Skeleton, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> PoseFeatures:
    """The features of a model file, or ValueError."""
    J = len(skeleton.parents)
    if "direction_count" in arrays:             # of the first version, which had linear ones only
        kept = storage.numbers(arrays, "direction_count", J)
        directions = storage.numbers(arrays, "directions", int(kept.sum()), 3)
        return linear_features(skeleton, tuple(np.split(directions.T, np.cumsum(kept)[:-1], axis=1)))
    if header["lift"] not in LIFTS:
        raise ValueError(f"features: '{header['lift']}' is not known here (known: {', '.join(LIFTS)})")
    lift = LIFTS[header["lift"]]
    part = storage.numbers(arrays, "feature_part", None)
    return PoseFeatures(skeleton, lift, part.astype(np.int64),
                        storage.numbers(arrays, "feature_mix", J, lift.width, len(part)))


@dataclass(frozen=True, eq=False)
class PoseFeatures:
    """What Q is linear in: for every part a constant, and mixtures of the lifted twists of its joints.

    `part` (A,) is the part of every feature, rising, the first of each its constant; `mix` (J, m, A) is how much each
    lifted number counts in each feature, zero for the constants.

    [SCAPE] Eq. 3
    """

    skeleton: Skeleton
    lift: Lift
    part: np.ndarray
    mix: np.ndarray

    def __post_init__(self) -> None:
        J, A = len(self.skeleton.parents), len(self.part)
        if self.mix.shape != (J, self.lift.width, A):
            raise ValueError(f"mix: expected shape {(J, self.lift.width, A)}, got {self.mix.shape}")
        if (np.diff(self.part) < 0).any() or set(self.part.tolist()) != set(range(J)):
            raise ValueError(f"part: expected 0..{J - 1} in rising order, got {self.part.tolist()}")

    @property
    def count(self) -> int:
        """A, the number of features of all parts together."""
        return len(self.part)

    @cached_property
    def starts(self) -> np.ndarray:
        """(J,) the first feature of every part, its constant."""
        return np.searchsorted(self.part, np.arange(len(self.skeleton.parents)))

    @cached_property
    def constant(self) -> np.ndarray:
        """(A,) 1 for the constants, 0 for the others."""
        return np.isin(np.arange(self.count), self.starts).astype(float)

    @cached_property
    def uses(self) -> np.ndarray:
        """(A, J) bool: which joints each feature depends on."""
        return (self.mix != 0).any(axis=1).T

    @cached_property
    def _flat(self) -> np.ndarray:
        return self.mix.reshape(-1, self.count)

    def of_part(self, p: int) -> slice:
        """The features of part p."""
        end = self.starts[p + 1] if p + 1 < len(self.starts) else self.count
        return slice(int(self.starts[p]), int(end))

    def evaluate(self, pose: np.ndarray) -> np.ndarray:
        """Features (..., A) of poses (..., J, 3), radians."""
        raised = lift_twists(self.lift, pose)
        return raised.reshape(*raised.shape[:-2], len(self._flat)) @ self._flat + self.constant

    def derivative(self, pose: np.ndarray) -> np.ndarray:
        """(..., A, J, 3) derivative of every feature by the pose parameters (..., J, 3)."""
        by_joint = np.swapaxes(self.mix, -1, -2) @ lift_derivative(self.lift, pose)              # (..., J, A, 3)
        return np.swapaxes(by_joint, -2, -3)


def part_features(skeleton: Skeleton, lift: Lift, axes: Sequence[np.ndarray],
                  joints_of_part: Sequence[Sequence[int]] | None = None) -> PoseFeatures:
    """For every part a constant, and the mixtures `axes` (J arrays (m, k_j)) of the lifted twists of its joints.

    [SCAPE] Eq. 3
    """
    J = len(skeleton.parents)
    part, columns = [], []
    for p, joints in enumerate(skeleton.joints_of_part if joints_of_part is None else joints_of_part):
        part += [p] * (1 + sum(axes[j].shape[1] for j in joints))
        columns.append(np.zeros((J, lift.width, 1)))
        for j in joints:
            column = np.zeros((J, lift.width, axes[j].shape[1]))
            column[j] = axes[j]
            columns.append(column)
    return PoseFeatures(skeleton, lift, np.array(part), np.concatenate(columns, axis=-1))


def linear_features(skeleton: Skeleton, directions: Sequence[np.ndarray]) -> PoseFeatures:
    """The features of the paper: for every part a constant and the twist directions (3, k_j) of its joints.

    [SCAPE] Eq. 3
    """
    return part_features(skeleton, LinearLift(), directions)
