"""The control model as a function of joint angles, segment lengths and place, with its derivatives."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scanprep.geometry import rotations

from ..control.model import ControlModel


@dataclass(frozen=True, eq=False)
class BoundPoints:
    """Points carried by a control model: blend weights (n, J) of its parts, and the default pose (n, 3), metres."""

    weights: np.ndarray
    rest: np.ndarray


@dataclass(frozen=True, eq=False)
class Frames:
    """Rotations, joints and shapes of the J parts for one set of parameters."""

    R: np.ndarray       # (J, 3, 3), world rotation of every part
    joints: np.ndarray  # (J, 3) metres
    shapes: np.ndarray  # (J, 3, 3), the stretch of every part in the axes of the default pose
    axes: np.ndarray    # (A, 3), in the world: about which each angle rotates its part and all that hangs on it
    shifts: np.ndarray  # (J, S, 3) metres, derivative of the joints by the length factors


@dataclass(frozen=True, eq=False)
class Articulated:
    """The control model as a function of its parameters x: angles (A,), length factors (S,), place (3,).

    A length factor moves the joints on its parts as in Eq. 3. By Eq. 2 alone the vertices would keep their offsets from
    the joints, and a longer forearm would leave a gap. So a part with one bone is stretched along it by the factor, and
    across it by the size factor: the mean of all factors, weighted by the default lengths. A part with several joints
    on it (pelvis, trunk) grows by its factor in all directions.

    [Statues] Eq. 1, 2, 3
    """

    control: ControlModel

    @cached_property
    def axes(self) -> np.ndarray:
        """(A, 3) the axis of every angle in the default pose."""
        return np.concatenate([np.reshape(a, (-1, 3)) for a in self.control.axes])

    @cached_property
    def joint_of(self) -> np.ndarray:
        """(A,) the joint of every angle."""
        return np.repeat(np.arange(len(self.control.axes)), [len(a) for a in self.control.axes])

    @cached_property
    def limits(self) -> np.ndarray:
        """(A, 2) radians, least and greatest angle; none at the root."""
        found = np.concatenate([np.reshape(a, (-1, 2)) for a in self.control.limits])
        return np.where(self.joint_of[:, None] == 0, [-np.inf, np.inf], found)

    @cached_property
    def bones(self) -> np.ndarray:
        """(J, 3) metres, from the joint of every part to the end of its bone.

        That is the joint of a child of the same segment, else the farthest child, else the farthest of its vertices.
        """
        control, o = self.control, self.control.skeleton.joints
        segment, out = control.segment_of_part, np.zeros_like(o)
        most = control.weights.argmax(axis=1)
        for p in range(len(o)):
            children = np.flatnonzero(control.skeleton.parents == p)
            same = children[segment[children] == segment[p]]
            ends = o[same] if len(same) else o[children] if len(children) else control.mesh.vertices[most == p]
            if len(ends):
                out[p] = max(ends - o[p], key=np.linalg.norm)
        return out

    @cached_property
    def lengths(self) -> np.ndarray:
        """(S,) metres, the default lengths of the segments; the mean of left and right."""
        segment, parents = self.control.segment_of_part, self.control.skeleton.parents
        own = np.linalg.norm(self.bones, axis=1)
        heads = [p for p in range(len(own)) if p == 0 or segment[p] != segment[parents[p]]]
        sides = np.bincount(segment[heads], minlength=len(self.control.segments))
        return np.bincount(segment, own, len(self.control.segments)) / np.maximum(sides, 1)

    @cached_property
    def shares(self) -> np.ndarray:
        """(S,) the part of each length factor in the size factor."""
        return self.lengths / self.lengths.sum()

    @cached_property
    def along(self) -> np.ndarray:
        """(J, 3, 3) projection of every part onto what its length stretches: its bone, or all where it branches."""
        unit = self.bones / np.maximum(np.linalg.norm(self.bones, axis=1, keepdims=True), 1e-300)
        children = np.bincount(self.control.skeleton.parents[1:], minlength=len(unit))
        return np.where(children[:, None, None] > 1, np.eye(3), unit[:, :, None] * unit[:, None, :])

    @cached_property
    def is_of(self) -> np.ndarray:
        """(J, S) 1 where a part belongs to a segment."""
        return np.eye(len(self.control.segments))[self.control.segment_of_part]

    @cached_property
    def rest(self) -> np.ndarray:
        """The parameters of the default pose."""
        return np.concatenate([np.zeros(len(self.axes)), np.ones(len(self.lengths)), np.zeros(3)])

    @cached_property
    def vertices(self) -> BoundPoints:
        return BoundPoints(self.control.weights, self.control.mesh.vertices)

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Split parameters into angles (A,), length factors (S,) and place (3,)."""
        A, S = len(self.axes), len(self.lengths)
        return x[:A], x[A:A + S], x[A + S:]

    def pose(self, x: np.ndarray) -> np.ndarray:
        """Compute the pose (J, 3), radians: `exp(angles @ axes)` rotates every part in its parent."""
        pose = np.zeros_like(self.control.skeleton.joints)
        np.add.at(pose, self.joint_of, self.split(x)[0][:, None] * self.axes)
        return pose

    def size(self, x: np.ndarray) -> float:
        """Compute the size factor."""
        return float(self.shares @ self.split(x)[1])

    def frames(self, x: np.ndarray) -> Frames:
        """Compute rotations and joints of all parts, with derivatives by the lengths. [Statues] Eq. 3"""
        skeleton, segment = self.control.skeleton, self.control.segment_of_part
        _, factors, place = self.split(x)
        pose, o = self.pose(x), skeleton.joints
        R = skeleton.part_rotations(pose)
        joints, shifts = np.empty_like(o), np.zeros((len(o), len(factors), 3))
        joints[0] = o[0] + place
        for c in range(1, len(o)):
            p = skeleton.parents[c]
            offset = R[p] @ (o[c] - o[p])
            joints[c] = joints[p] + factors[segment[p]] * offset
            shifts[c] = shifts[p]
            shifts[c, segment[p]] += offset
        above = np.concatenate([np.eye(3)[None], R[skeleton.parents[1:]]])
        left = above @ rotations.right_jacobian(-pose)           # exp(t + d) ≈ exp(J_l(t) d) exp(t), J_l(t) = J_r(-t)
        axes = np.einsum("aij,aj->ai", left[self.joint_of], self.axes)
        shapes = factors[segment, None, None] * self.along + self.size(x) * (np.eye(3) - self.along)
        return Frames(R, joints, shapes, axes, shifts)

    def positions(self, frames: Frames, points: BoundPoints) -> np.ndarray:
        """Compute the positions (n, 3) of points, metres. [Statues] Eq. 2"""
        return np.einsum("nj,njd->nd", points.weights, self._by_part(frames, points))

    def derivatives(self, frames: Frames, points: BoundPoints) -> np.ndarray:
        """Compute the derivatives (n, 3, P) of the positions by the parameters."""
        # by an angle: its axis times the arm to all that hangs below; by a length: joints, and the stretch of parts
        skeleton, w = self.control.skeleton, points.weights
        n, J = w.shape
        below = skeleton.descends.astype(float)
        carried = (w[..., None] * self._by_part(frames, points)).transpose(0, 2, 1) @ below          # (n, 3, J)
        arm = carried - (w @ below)[:, None] * frames.joints.T
        by_angle = np.cross(frames.axes, arm.transpose(0, 2, 1)[:, self.joint_of]).transpose(0, 2, 1)
        d = w[..., None] * (points.rest[:, None] - skeleton.joints)
        along = _each(frames.R @ self.along, d)
        across = (_each(frames.R, d) - along).sum(axis=1)
        by_length = (w @ frames.shifts.reshape(J, -1)).reshape(n, -1, 3).transpose(0, 2, 1)
        by_length = by_length + along.transpose(0, 2, 1) @ self.is_of + across[..., None] * self.shares
        return np.concatenate([by_angle, by_length, np.broadcast_to(np.eye(3), (n, 3, 3))], axis=2)

    def _by_part(self, frames: Frames, points: BoundPoints) -> np.ndarray:
        """Compute where each part alone would carry each point, (n, J, 3)."""
        d = points.rest[:, None] - self.control.skeleton.joints
        return frames.joints + _each(frames.R @ frames.shapes, d)


def _each(M: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Multiply the matrices M (J, 3, 3) of the parts with their vectors in d (n, J, 3)."""
    return (d.transpose(1, 0, 2) @ M.transpose(0, 2, 1)).transpose(1, 0, 2)
