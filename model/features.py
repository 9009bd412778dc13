"""Pose features: the functions of the joint twists in which a pose model is linear."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from scanprep.geometry import rotations, storage
from scanprep.skeleton.tree import Skeleton

_FIRST, _SECOND = np.triu_indices(3)        # the six pairs of entries of a twist, for products


def twists(pose: np.ndarray) -> np.ndarray:
    """Compute the twists (..., J, 3), radians, at most π long, of poses (..., J, 3) of any length.

    [SCAPE] §4.2
    """
    pose = np.asarray(pose, dtype=np.float64)
    far = np.linalg.norm(pose, axis=-1, keepdims=True) > np.pi
    return np.where(far, rotations.log(rotations.exp(pose)), pose) if far.any() else pose


class Lift(Protocol):
    """A fixed map from the twist of each joint to m numbers, in which the regression is linear.

    `kind` is its name in files; `width` is m.
    """

    kind: str

    @property
    def width(self) -> int: ...

    def evaluate(self, t: np.ndarray) -> np.ndarray:
        """Compute the values (..., J, m) at twists (..., J, 3), radians."""
        ...

    def derivative(self, t: np.ndarray) -> np.ndarray:
        """Compute the derivatives (..., J, m, 3) of the values of each joint by its own twist (..., J, 3)."""
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
        """Express twists along directions (3, k), and their products, in the nine numbers: (9, k + k (k + 1) / 2)."""
        pairs = [np.outer(directions[:, a], directions[:, b])
                 for a, b in zip(*np.triu_indices(directions.shape[1]), strict=True)]
        out = np.zeros((9, directions.shape[1] + len(pairs)))
        out[:3, :directions.shape[1]] = directions
        for column, pair in zip(out.T[directions.shape[1]:], pairs, strict=True):
            # (a·t)(b·t) in the six products of the entries of t; squares stand once, mixed products twice
            column[3:] = np.where(_FIRST == _SECOND, 0.5, 1.0) * (pair + pair.T)[_FIRST, _SECOND]
        return out


@dataclass(frozen=True)
class RotationLift:
    """The rotation minus the identity, row by row.

    Loper et al., SMPL, 2015.
    """

    kind = "rotation"
    width = 9

    def evaluate(self, t: np.ndarray) -> np.ndarray:
        return (rotations.exp(t) - np.eye(3)).reshape(*t.shape[:-1], 9)

    def derivative(self, t: np.ndarray) -> np.ndarray:
        # dR = R hat(J_r dt), for each of the three parameters
        along = rotations.hat(np.swapaxes(rotations.right_jacobian(t), -1, -2))
        return np.moveaxis(rotations.exp(t)[..., None, :, :] @ along, -3, -1).reshape(*t.shape[:-1], 9, 3)


@dataclass(frozen=True)
class QuaternionLift:
    """The unit quaternion (x, y, z, w) of the rotation, minus that of the identity.

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
    """Compute the lifted twists (..., J, m) of poses (..., J, 3) of any length."""
    return lift.evaluate(twists(pose))


def lift_derivative(lift: Lift, pose: np.ndarray) -> np.ndarray:
    """Compute the derivative (..., J, m, 3) of the lifted twists by the joints' pose parameters (..., J, 3)."""
    pose = np.asarray(pose, dtype=np.float64)
    t = twists(pose)
    slope = lift.derivative(t)
    far = np.linalg.norm(pose, axis=-1) > np.pi
    if far.any():
        # beyond half a turn the twist is another vector with the same rotation: chain rule between the two
        turn = rotations.inverse_right_jacobian(t[far]) @ rotations.right_jacobian(pose[far])
        slope = slope.copy()
        slope[far] = slope[far] @ turn
    return slope


def restore_features(skeleton: Skeleton, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> PoseFeatures:
    """Read the features of a model file; ValueError where they do not fit."""
    J = len(skeleton.parents)
    if "direction_count" in arrays:             # files of version 1 have linear features only
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
    """The features in which Q is linear: for every part a constant, and mixtures of the lifted twists of its joints.

    `part` (A,) is the part of every feature, in rising order; the first feature of a part is its constant. `mix`
    (J, m, A) is the weight of each lifted number in each feature, zero for the constants.

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
        """Return the features of part p, as a slice of all."""
        end = self.starts[p + 1] if p + 1 < len(self.starts) else self.count
        return slice(int(self.starts[p]), int(end))

    def evaluate(self, pose: np.ndarray) -> np.ndarray:
        """Compute the features (..., A) of poses (..., J, 3), radians."""
        raised = lift_twists(self.lift, pose)
        return raised.reshape(*raised.shape[:-2], len(self._flat)) @ self._flat + self.constant

    def derivative(self, pose: np.ndarray) -> np.ndarray:
        """Compute the derivative (..., A, J, 3) of every feature by the pose parameters (..., J, 3)."""
        by_joint = np.swapaxes(self.mix, -1, -2) @ lift_derivative(self.lift, pose)              # (..., J, A, 3)
        return np.swapaxes(by_joint, -2, -3)


def part_features(skeleton: Skeleton, lift: Lift, axes: Sequence[np.ndarray],
                  joints_of_part: Sequence[Sequence[int]] | None = None) -> PoseFeatures:
    """Build features: for every part a constant, and mixtures `axes` (J arrays (m, k_j)) of its joints' lifted twists.

    [SCAPE] Eq. 3
    """
    J = len(skeleton.parents)
    part, columns = [], []
    for p, joints in enumerate(skeleton.joints_of_part if joints_of_part is None else joints_of_part):
        # the constant of the part, then the mixtures of each of its joints
        part += [p] * (1 + sum(axes[j].shape[1] for j in joints))
        columns.append(np.zeros((J, lift.width, 1)))
        for j in joints:
            column = np.zeros((J, lift.width, axes[j].shape[1]))
            column[j] = axes[j]
            columns.append(column)
    return PoseFeatures(skeleton, lift, np.array(part), np.concatenate(columns, axis=-1))


def linear_features(skeleton: Skeleton, directions: Sequence[np.ndarray]) -> PoseFeatures:
    """Build the features of the paper: for every part a constant and the twist directions (3, k_j) of its joints.

    [SCAPE] Eq. 3
    """
    return part_features(skeleton, LinearLift(), directions)
