"""Points of a body for many poses at once, with as few products as possible.

A feature of a part's shape depends on the joints of that part only. So the sum over products of features and rotations
becomes one local shape for each part p, rotated once:

    Y = Σ_p (K_p + Σ_j Σ_c f_c(t_j) B_{p,j,c}) R_pᵀ + origin + trans

K_p is the constant shape, t_j the twist of joint j, f_c its lifted features, B the change of shape by each. In skinned
bodies every feature moves every point: there the operator of the points itself needs the fewest products.
"""
from __future__ import annotations

import numpy as np

from model.blended import Blended
from model.features import twists
from model.linear import PointOperator
from model.products import Products, Terms
from scanprep.geometry import rotations


class PartShapes:
    """Points (L) of a body as local shapes of its parts; arrays have coordinates before points, (3, L)."""

    def __init__(self, operator: Products) -> None:
        terms, features = operator.terms, operator.terms.features
        self.skeleton, self.lift, self.origin = terms.skeleton, features.lift, operator.origin
        J, L, m = len(terms.skeleton.parents), operator.count, features.lift.width
        self.joints, self.count = J, L
        # K_p and B_{p,j,c}, summed over the terms of each part
        flat = operator.basis.reshape(terms.count, -1)
        of_part = terms.part == np.arange(J)[:, None]
        self.constant = ((of_part * features.constant[terms.feature]) @ flat).reshape(J, 3, L)
        uses = np.array([features.uses[terms.feature[one]].any(axis=0) for one in of_part])    # (J parts, J joints)
        mix = features.mix[:, :, terms.feature]                                                  # (J, m, M)
        self.bends = {(int(p), int(j)): ((mix[j] * of_part[p]) @ flat).reshape(m, 3, L)
                      for p, j in np.argwhere(uses)}
        self._below = terms.skeleton.descends.T.astype(float)
        # parts of equal depth in the tree with their parents, for rotations level by level
        depth = terms.skeleton.descends.sum(axis=1) - 1
        levels = [np.flatnonzero(depth == d) for d in range(1, depth.max() + 1)]
        self._levels = [(children, terms.skeleton.parents[children]) for children in levels]
        self._arrange()

    def _arrange(self) -> None:
        """Store the bends B by part and by joint as two arrays, padded with zeros."""
        J, L, m = self.joints, self.count, self.lift.width
        self._joint_of, by_part = _pad_lists([[j for q, j in self.bends if q == p] for p in range(J)])
        self._part_of, by_joint = _pad_lists([[p for p, q in self.bends if q == j] for j in range(J)])
        self._by_part = np.zeros((*by_part.shape, m, 3, L))
        self._by_joint = np.zeros((*by_joint.shape, m, 3, L))
        for p, i in np.argwhere(by_part):
            self._by_part[p, i] = self.bends[p, self._joint_of[p, i]]
        for j, i in np.argwhere(by_joint):
            self._by_joint[j, i] = self.bends[self._part_of[j, i], j]

    def rotations(self, pose: np.ndarray) -> np.ndarray:
        """Compute world rotations (J, B, 3, 3) of the parts at poses (J, B, 3)."""
        relative = rotations.exp(pose)
        R = relative.copy()
        for children, parents in self._levels:
            R[children] = R[parents] @ relative[children]
        return R

    def shapes(self, t: np.ndarray) -> np.ndarray:
        """Compute local shapes (J, B, 3, L) of the parts at twists (J, B, 3)."""
        raised = self.lift.evaluate(t.swapaxes(0, 1)).swapaxes(0, 1)                             # (J, B, m)
        features = raised[self._joint_of].swapaxes(1, 2)                                            # (J, B, n, m)
        J, B = t.shape[:2]
        bent = features.reshape(J, B, -1) @ self._by_part.reshape(J, -1, 3 * self.count)
        return self.constant[:, None] + bent.reshape(J, B, 3, -1)

    def evaluate(self, pose: np.ndarray, trans: np.ndarray) -> np.ndarray:
        """Compute points (B, 3, L), metres, at poses (B, J, 3) and trans (B, 3)."""
        t = twists(pose).swapaxes(0, 1)
        carried = self.rotations(t) @ self.shapes(t)
        return carried.sum(axis=0) + (self.origin + trans)[:, :, None]

    def columns(self, pose: np.ndarray, trans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute points (B, 3, L), metres, and derivatives (B, 3J + 3, 3, L), as in `MarkedBody`."""
        t = twists(pose).swapaxes(0, 1)
        (J, B), L = t.shape[:2], self.count
        R = self.rotations(t)
        below = (self._below @ (R @ self.shapes(t)).reshape(J, -1)).reshape(J, B, 3, L)
        # a rotation about the column ω of R moves x by ω × x = hat(ω) @ x
        columns = rotations.hat(np.swapaxes(R, -1, -2)).reshape(J, B, 9, 3) @ below
        # a turn also changes the twist of its joint, which bends the shapes of the parts beside it
        slope = self.lift.derivative(t.swapaxes(0, 1)).swapaxes(0, 1) @ rotations.inverse_right_jacobian(t)
        rotated = R[self._part_of].swapaxes(1, 2)                                                # (J, B, n, 3, 3)
        along = slope.swapaxes(-1, -2)[:, :, :, None, None, :, None] \
            * rotated[:, :, None].swapaxes(-2, -3)[..., None, :]
        columns += (along.reshape(J, 9 * B, -1) @ self._by_joint.reshape(J, -1, L)).reshape(J, B, 9, L)
        out = np.empty((B, 3 * J + 3, 3, L))
        out[:, :-3].reshape(B, J, 9, L)[:] = columns.swapaxes(0, 1)
        out[:, -3:] = np.eye(3)[:, :, None]
        return below[0] + (self.origin + trans)[:, :, None], out

    def lift_off(self, part: np.ndarray, offsets: np.ndarray, bends: list[dict[int, np.ndarray]]) -> None:
        """Add to every point a vector (L, 3), metres, fixed to a part (L,), and changes (m, 3) by its joints."""
        for i, p in enumerate(part):
            self.constant[p, :, i] += offsets[i]
            for j, bend in bends[i].items():
                self.bends[p, j][:, :, i] += bend
        self._arrange()


class SkinnedShapes(PartShapes):
    """Points (L) of a skinned body: its operator moves them, and part shapes lift them off the skin."""

    def __init__(self, operator: Blended) -> None:
        # empty shapes for all parts and joints, filled by `lift_off`
        of_part, L = operator.skeleton.joints_of_part, operator.count
        part = np.repeat(np.arange(len(of_part)), [len(joints) for joints in of_part])
        features = operator.features
        constants = np.arange(features.count)[features.constant == 1]
        super().__init__(Products(Terms(features, np.arange(len(of_part)), constants),
                                  np.zeros((len(of_part), 3, L)), operator.origin))
        self.bends = {(int(p), j): np.zeros((self.lift.width, 3, L))
                      for p, j in zip(part, (j for joints in of_part for j in joints), strict=True)}
        self.operator, self.lifts = operator, False

    def evaluate(self, pose: np.ndarray, trans: np.ndarray) -> np.ndarray:
        y = np.swapaxes(self.operator.evaluate(pose, trans), 1, 2)
        return y + super().evaluate(pose, np.zeros_like(trans) - self.origin) if self.lifts else y

    def columns(self, pose: np.ndarray, trans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        y, by_pose = self.operator.columns(pose, trans)
        B, J, L = len(pose), self.joints, self.count
        # a turn d from the right changes the pose by the inverse right Jacobian times d
        local = np.swapaxes(rotations.inverse_right_jacobian(pose), -1, -2)
        out = np.empty((B, 3 * J + 3, 3, L))
        out[:, :-3] = (local @ by_pose.reshape(B, J, 3, 3 * L)).reshape(B, 3 * J, 3, L)
        out[:, -3:] = np.eye(3)[:, :, None]
        y = np.swapaxes(y, 1, 2)
        if self.lifts:
            lift, by_turn = super().columns(pose, np.zeros_like(trans) - self.origin)
            y, out[:, :-3] = y + lift, out[:, :-3] + by_turn[:, :-3]
        return y, out

    def lift_off(self, part: np.ndarray, offsets: np.ndarray, bends: list[dict[int, np.ndarray]]) -> None:
        super().lift_off(part, offsets, bends)
        self.lifts = True


def part_shapes(operator: PointOperator) -> PartShapes:
    """Return the points of an operator in the form for the inner loop."""
    if isinstance(operator, Products):
        return PartShapes(operator)
    assert isinstance(operator, Blended), "one of the two kinds of operators"
    return SkinnedShapes(operator)


def _pad_lists(lists: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Pad lists of different lengths to rows (n, width), and return a mask of the real entries."""
    width = max(1, max(len(row) for row in lists))
    return (np.array([row + [0] * (width - len(row)) for row in lists]),
            np.array([[i < len(row) for i in range(width)] for row in lists]))
