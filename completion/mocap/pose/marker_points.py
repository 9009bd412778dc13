"""Marker places of a fixed body as a function of its pose, in the fewest products: the inner loop of animation.

A feature of a part's shape depends on the joints of that part alone, so the sum over all products of a
feature and a rotation falls apart into one local shape a part, turned once:

    Y = Σ_p (K_p + Σ_j Σ_c f_c(t_j) B_{p,j,c}) R_pᵀ + origin + trans

Everything is done for a batch of poses. Derivatives are by small turns of every joint from the right,
`R_parent exp(pose) exp(d)`, so that no chart ends at a half turn.
"""
from __future__ import annotations

import numpy as np

from model.features import twists
from model.linear import PointOperator, Subject
from model.priors import gaussian_prior
from scanprep.geometry import rotations
from scanprep.skeleton.tree import Skeleton

from ... import energy
from .fast_rotations import exp

SAMPLES = 120                        # poses from which the turning of the normals is learned
RIDGE = 1e-2                         # that holds a normal to its part where the poses say little


class PartShapes:
    """Points (L) of a body as local shapes of its parts; coordinates come before points, (3, L), everywhere.

    Parameters
    ----------
    operator : PointOperator
    """

    def __init__(self, operator: PointOperator) -> None:
        terms, features = operator.terms, operator.terms.features
        self.skeleton, self.lift, self.origin = terms.skeleton, features.lift, operator.origin
        J, L, m = len(terms.skeleton.parents), operator.count, features.lift.width
        self.joints, self.count = J, L
        flat = operator.basis.transpose(0, 2, 1).reshape(terms.count, -1)
        of_part = terms.part == np.arange(J)[:, None]
        self.constant = ((of_part * features.constant[terms.feature]) @ flat).reshape(J, 3, L)
        uses = np.array([features.uses[terms.feature[mine]].any(axis=0) for mine in of_part])    # (J parts, J joints)
        mix = features.mix[:, :, terms.feature]                                                  # (J, m, M)
        self.bends = {(int(p), int(j)): ((mix[j] * of_part[p]) @ flat).reshape(m, 3, L)
                      for p, j in np.argwhere(uses)}
        self._below = terms.skeleton.descends.T.astype(float)
        self._levels = _levels(terms.skeleton)
        self._arrange()

    def _arrange(self) -> None:
        """Lay the bends out part by part and joint by joint, padded with zeros to one length."""
        J, L, m = self.joints, self.count, self.lift.width
        self._joint_of, by_part = _padded([[j for q, j in self.bends if q == p] for p in range(J)])
        self._part_of, by_joint = _padded([[p for p, q in self.bends if q == j] for j in range(J)])
        self._by_part = np.zeros((*by_part.shape, m, 3, L))
        self._by_joint = np.zeros((*by_joint.shape, m, 3, L))
        for p, i in np.argwhere(by_part):
            self._by_part[p, i] = self.bends[p, self._joint_of[p, i]]
        for j, i in np.argwhere(by_joint):
            self._by_joint[j, i] = self.bends[self._part_of[j, i], j]

    def rotations(self, pose: np.ndarray) -> np.ndarray:
        """World rotations (J, B, 3, 3) of the parts at poses (J, B, 3)."""
        relative = exp(pose)
        R = relative.copy()
        for children, parents in self._levels:
            R[children] = R[parents] @ relative[children]
        return R

    def shapes(self, t: np.ndarray) -> np.ndarray:
        """Local shapes (J, B, 3, L) of the parts at twists (J, B, 3)."""
        raised = self.lift.evaluate(t.swapaxes(0, 1)).swapaxes(0, 1)                             # (J, B, m)
        known = raised[self._joint_of].swapaxes(1, 2)                                            # (J, B, n, m)
        J, B = t.shape[:2]
        bent = known.reshape(J, B, -1) @ self._by_part.reshape(J, -1, 3 * self.count)
        return self.constant[:, None] + bent.reshape(J, B, 3, -1)

    def evaluate(self, pose: np.ndarray, trans: np.ndarray) -> np.ndarray:
        """Places (B, 3, L), metres, at poses (B, J, 3) and trans (B, 3)."""
        t = twists(pose).swapaxes(0, 1)
        carried = self.rotations(t) @ self.shapes(t)
        return carried.sum(axis=0) + (self.origin + trans)[:, :, None]

    def columns(self, pose: np.ndarray, trans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places and their derivatives.

        Parameters
        ----------
        pose : (B, J, 3) float, radians
        trans : (B, 3) float, metres

        Returns
        -------
        (B, 3, L) float, metres
        (B, 3J, 3, L) float
            By small turns of the joints from the right; by trans it is the identity.
        """
        t = twists(pose).swapaxes(0, 1)
        (J, B), L = t.shape[:2], self.count
        R = self.rotations(t)
        below = (self._below @ (R @ self.shapes(t)).reshape(J, -1)).reshape(J, B, 3, L)
        # a turn about the column ω of R moves x by ω × x = hat(ω) @ x
        columns = rotations.hat(np.swapaxes(R, -1, -2)).reshape(J, B, 9, 3) @ below
        slope = self.lift.derivative(t.swapaxes(0, 1)).swapaxes(0, 1) @ rotations.inverse_right_jacobian(t)
        turned = R[self._part_of].swapaxes(1, 2)                                                 # (J, B, n, 3, 3)
        sway = slope.swapaxes(-1, -2)[:, :, :, None, None, :, None] * turned[:, :, None].swapaxes(-2, -3)[..., None, :]
        columns += (sway.reshape(J, 9 * B, -1) @ self._by_joint.reshape(J, -1, L)).reshape(J, B, 9, L)
        return below[0] + (self.origin + trans)[:, :, None], \
            columns.reshape(J, B, 3, 3, L).swapaxes(0, 1).reshape(B, 3 * J, 3, L)

    def lift_off(self, part: np.ndarray, offsets: np.ndarray, bends: list[dict[int, np.ndarray]]) -> None:
        """Add to every point a vector that turns with a part and bends with its joints.

        Parameters
        ----------
        part : (L,) int
        offsets : (L, 3) float, metres
        bends : for each point, (m, 3) float, metres, of some joints
        """
        for i, p in enumerate(part):
            self.constant[p, :, i] += offsets[i]
            for j, bend in bends[i].items():
                self.bends[p, j][:, :, i] += bend
        self._arrange()


def marker_shapes(subject: Subject, vertex_ids: np.ndarray, weights: np.ndarray, distances: np.ndarray
                  ) -> PartShapes:
    """Markers above the skin as local shapes: one point each, the normal fitted once to the exact one.

    The exact normal, of `energy.above_skin`, is no linear function of the body's features. Over poses drawn
    from the prior, each marker's normal is regressed on the turn of the part that it follows best and the
    lifted twists of that part's joints.

    Parameters
    ----------
    subject : Subject
    vertex_ids, weights : (3 L, k)
        Three points of the skin for each marker, as `energy.above_skin` takes them.
    distances : (L,) float, metres
    """
    shapes = PartShapes(subject.points(vertex_ids[::3], weights[::3]))
    if not distances.any():
        return shapes
    poses = _sample_poses(subject)
    supports = subject.points(vertex_ids, weights).evaluate(poses)
    normals = energy.lifted(supports, np.ones(len(distances))) - supports[:, ::3]         # (S, L, 3)
    back = np.swapaxes(shapes.skeleton.part_rotations(poses), -1, -2)
    local = (back[:, :, None] @ normals[:, None, ..., None])[..., 0]                      # (S, J, L, 3)
    part = np.argmin(local.var(axis=0).sum(axis=-1), axis=0)
    raised = shapes.lift.evaluate(twists(poses))
    offsets, bends = np.empty((len(part), 3)), []
    for i, p in enumerate(part):
        joints = [j for q, j in shapes.bends if q == p]
        known = raised[:, joints].reshape(len(poses), -1)
        wanted, middle = local[:, p, i], known.mean(axis=0)
        A = known - middle
        slope = np.linalg.solve(A.T @ A + RIDGE * len(poses) * np.eye(A.shape[1]), A.T @ (wanted - wanted.mean(axis=0)))
        offsets[i] = distances[i] * (wanted.mean(axis=0) - middle @ slope)
        bends.append(dict(zip(joints, distances[i] * slope.reshape(len(joints), shapes.lift.width, 3), strict=True)))
    shapes.lift_off(part, offsets, bends)
    return shapes


def _sample_poses(subject: Subject) -> np.ndarray:
    """Poses (S, J, 3) of the prior, the root at rest."""
    assert subject.pose_mean is not None and subject.pose_covariance is not None, "a subject with a pose prior"
    prior = gaussian_prior(subject.pose_mean, subject.pose_covariance)
    draws = np.random.default_rng(0).standard_normal((SAMPLES, len(prior.whitening)))
    poses = np.zeros((SAMPLES, len(prior.mean)))
    poses[:, 3:] = prior.mean[3:] + np.linalg.solve(prior.whitening[:, 3:], draws.T).T
    return poses.reshape(SAMPLES, -1, 3)


def _levels(skeleton: Skeleton) -> list[tuple[np.ndarray, np.ndarray]]:
    """Parts of equal depth in the tree and their parents, from the root's children on."""
    depth = np.zeros(len(skeleton.parents), dtype=int)
    for j, parent in enumerate(skeleton.parents):
        depth[j] = depth[parent] + 1 if j else 0
    levels = [np.flatnonzero(depth == d) for d in range(1, depth.max() + 1)]
    return [(children, skeleton.parents[children]) for children in levels]


def _padded(lists: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Lists of different lengths as rows (n, width), and which entries are real."""
    width = max(1, max(len(row) for row in lists))
    return (np.array([row + [0] * (width - len(row)) for row in lists]),
            np.array([[i < len(row) for i in range(width)] for row in lists]))
