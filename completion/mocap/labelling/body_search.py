"""Search the body that explains unlabelled points: its pose from one frame alone, and lost limbs.

Points and markers are matched one to one by least total cost; either may stay unmatched.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from model.features import twists
from model.human_poses import human_poses
from model.linear import Subject
from model.priors import typical_poses
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from ..pose.marked_body import MarkedBody

ALONE = 0.8                          # cost of a marker without a point; a match costs 1/2 at its scale, at most 1
JUDGED = 0.08                        # metres: scale of the matches by which the misfit of a frame is judged
FIRST, REST = 2, 6                   # rounds of rigid alignment for all candidates, and for the promising ones
SD = 0.03                            # metres: on the mean person markers fit only roughly
# For each round of solves: scale of the matches, metres, and weight of the pose prior; both decrease.
ROUNDS = ((0.3, 3.0), (0.2, 3.0), (0.2, 1.0), (0.15, 1.0), (0.12, 1.0), (0.1, 1.0), (0.1, 1.0))
LIMB_ROUNDS = ((0.2, 1.0), (0.12, 1.0), (0.1, 1.0))
Axis = tuple[float, float, float]
UPS: tuple[Axis, ...] = ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0))             # up axes of files
# If nobody stands: upside down, and lying along ten directions.
OTHERS: tuple[Axis, ...] = ((0.0, 0.0, -1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0),
                            (0.7, 0.7, 0.0), (-0.7, 0.7, 0.0), (0.7, -0.7, 0.0), (-0.7, -0.7, 0.0),
                            (0.7, 0.0, 0.7), (-0.7, 0.0, 0.7), (0.0, 0.7, 0.7), (0.0, -0.7, 0.7))


@dataclass(frozen=True, eq=False)
class Placement:
    """A body placed in one frame of points.

    Attributes
    ----------
    x : (P,) float
        Unknowns of the marked body: pose and place.
    matches : (L,) int
        The point of each marker, -1 without one.
    misfit : float
        Mean cost of the matches plus a small cost of the pose: 0.03 to 0.2 for a correct body, else above 0.3.
    """

    x: np.ndarray
    matches: np.ndarray
    misfit: float


def match_points(places: np.ndarray, points: np.ndarray, scale: float) -> tuple[np.ndarray, float]:
    """Match markers at places (L, 3) with points (N, 3); return the point (L,) of each, -1 without, and the mean cost.

    A pair at distance d costs d² / (d² + scale²), a marker without a point `ALONE`; points that are NaN are ignored.

    Examples
    --------
    >>> match_points(np.eye(3), np.array([[0, 1, 0.01], [9, 9, 9], [1, 0, 0]]), 0.1)[0].tolist()
    [2, 0, -1]
    """
    squared = ((places[:, None] - points)**2).sum(axis=-1)
    return assign_columns(np.where(np.isnan(squared), 1.0, squared / (squared + scale**2)), ALONE)


def assign_columns(costs: np.ndarray, alone: float) -> tuple[np.ndarray, float]:
    """Assign columns (L,) to rows of costs (L, N), -1 where `alone` is cheaper; return them and the mean cost."""
    L, N = costs.shape
    # an extra column for each row, for staying alone
    rows, columns = linear_sum_assignment(np.concatenate([costs, np.full((L, L), alone)], axis=1))
    total = np.concatenate([costs, np.full((L, L), alone)], axis=1)[rows, columns]
    return np.where(columns < N, columns, -1), float(total.mean())


class BodySearch:
    """Searches a body of known shape with markers in frames of points, from many poses and orientations.

    Parameters
    ----------
    body : MarkedBody
    subject : Subject
        The same body; its template stands upright.
    """

    TURNS = 16                           # orientations about the long axis of the body
    LIMB_POSES = 8                       # poses that are tried for each limb

    def __init__(self, body: MarkedBody, subject: Subject) -> None:
        self.body = body
        fixed = body.body
        assert fixed.pose_mean is not None and fixed.pose_covariance is not None, "a marked body has a pose prior"
        typical = typical_poses(fixed.pose_mean, fixed.pose_covariance, axes=6)
        # 120 poses of people are tried beside the typical ones of the model
        people = human_poses(subject.template, subject.skeleton, 120, np.random.default_rng(0))
        self.poses = typical if people is None else np.concatenate([typical, people])
        self.limbs = limb_trees(subject.skeleton)
        self.upright = long_axis(subject.template)
        self._laid: dict[Axis, tuple[np.ndarray, np.ndarray]] = {}

    def find(self, points: np.ndarray, axes: Sequence[Axis] = UPS) -> Placement:
        """Find the best body in a frame of points (N, 3), metres, with its long axis along one of some axes."""
        best = self._find_along(points, axes[0])
        for axis in axes[1:]:
            # 0.2: with a smaller misfit no other axis is tried; wrong axes leave at least 0.29
            if best.misfit < 0.2:
                break
            best = min(best, self._find_along(points, axis), key=lambda placement: placement.misfit)
        return best

    def _find_along(self, points: np.ndarray, axis: Axis) -> Placement:
        """Find the best body with its long axis along one axis."""
        # all poses in all orientations about the axis are aligned rigidly with the points
        x, at = self._candidates(axis)
        n = self.body.body.n_angles
        centre = points.mean(axis=0)
        R, t, scores = lay_rigidly(at + centre, points)
        # the best 40 candidates are solved for their poses
        best = np.argsort(scores)[:40]
        x, moved = x[best].copy(), np.einsum("bij,blj->bli", R[best], at[best] + centre) + t[best, None]
        x[:, :3] = rotations.log(R[best] @ rotations.exp(x[:, :3]))
        x[:, n:n + 3] += (moved - self.body.positions(x)).mean(axis=1)
        # their joints bend towards the points, with new matches in every round
        return self.refine(x, points, ROUNDS, JUDGED)

    def _candidates(self, along: Axis) -> tuple[np.ndarray, np.ndarray]:
        """Return unknowns (n, P) of all poses and orientations, and their markers (n, L, 3), centred at the origin."""
        if along not in self._laid:
            body, axis = self.body, np.asarray(along) / np.linalg.norm(along)
            turn = np.arange(self.TURNS)[:, None] * 2 * np.pi / self.TURNS * axis
            turns = rotations.exp(turn) @ rotation_between(self.upright, axis)
            poses = np.repeat(self.poses, self.TURNS, axis=0)
            poses[:, 0] = rotations.log(np.tile(turns, (len(self.poses), 1, 1)) @ rotations.exp(poses[:, 0]))
            x = body.body.join(poses, np.zeros((len(poses), 3)))
            at = np.concatenate([body.positions(x[i:i + 256]) for i in range(0, len(x), 256)])
            x[:, body.body.n_angles:body.body.n_angles + 3] -= at.mean(axis=1)
            self._laid[along] = x, at - at.mean(axis=1, keepdims=True)
        return self._laid[along]

    def refine(self, x: np.ndarray, points: np.ndarray, rounds: tuple[tuple[float, float], ...],
               judged: float) -> Placement:
        """Refine unknowns (n, P) in rounds of matching and solving; return the best placement."""
        for scale, stiff in rounds:
            at = self.body.positions(x)
            targets = np.full(at.shape, np.nan)
            for target, places in zip(targets, at, strict=True):
                matches, _ = match_points(places, points, scale)
                target[matches >= 0] = points[matches[matches >= 0]]
            x = self.body.solve(x, targets, robust_weights(at, targets, scale), 6, 1e-3, stiff).x
        return min((self.judge(one, points, judged) for one in x), key=lambda placement: placement.misfit)

    def judge(self, x: np.ndarray, points: np.ndarray, scale: float) -> Placement:
        """Compute the placement of unknowns (P,), with matches of a scale, metres."""
        matches, cost = match_points(self.body.positions(x), points, scale)
        pose, _, _ = self.body.body.split(x[None])
        off = self.body.prior.whitening @ (twists(pose).reshape(-1) - self.body.prior.mean)
        # 0.0003 per squared deviation of the pose: enough to detect a head or foot that is reversed
        return Placement(x, matches, cost + 0.0003 * float(off @ off))

    def restart_limbs(self, placement: Placement, points: np.ndarray, judged: float) -> Placement:
        """Try other poses for one limb after the other, since a foot may be reversed; return the best placement."""
        limb_poses = self.poses[np.random.default_rng(0).permutation(len(self.poses))[:self.LIMB_POSES]]
        for limb in self.limbs:
            x = np.repeat(placement.x[None], len(limb_poses), axis=0)
            for joint in limb:
                x[:, 3 * joint:3 * joint + 3] = limb_poses[:, joint]
            placement = min(placement, self.refine(x, points, LIMB_ROUNDS, judged), key=lambda one: one.misfit)
        return placement


def robust_weights(places: np.ndarray, targets: np.ndarray, scale: float) -> np.ndarray:
    """Compute robust weights (..., L) of matches between places and targets (..., L, 3), NaN without one."""
    squared = ((places - targets)**2).sum(axis=-1)
    return np.where(np.isnan(squared), 0.0, SD**-2 / (1 + np.nan_to_num(squared) / scale**2)**2)


def lay_rigidly(at: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Align marker sets (B, L, 3) rigidly with points (N, 3); return rotations, translations (B, 3) and costs (B,).

    This is ICP in both directions, with weights that fall with the distance. All sets get `FIRST` rounds, the best
    `PROMISING` get the rest.
    """
    B = len(at)
    R, t, scores = np.tile(np.eye(3), (B, 1, 1)), np.zeros((B, 3)), np.full(B, np.inf)
    rows = np.arange(B)
    for rounds in (FIRST, REST):
        for some in np.array_split(rows, max(1, len(rows) // 128)):     # 128 at once fit into the cache
            R[some], t[some], scores[some] = _closest_points(at[some], points, R[some], t[some], rounds)
        # candidates with the least cost after the first rounds
        rows = np.argsort(scores)[:300]
    return R, t, np.where(np.isin(np.arange(B), rows), scores, np.inf)


def _closest_points(at: np.ndarray, points: np.ndarray, R: np.ndarray, t: np.ndarray, rounds: int
                    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Run some rounds of ICP from rotations and translations; return the new ones and their costs."""
    y, length = at @ np.swapaxes(R, 1, 2) + t[:, None], (points**2).sum(axis=-1)
    wide = 0.25  # metres: scale of the distances, large because the pose is still wrong
    for _ in range(rounds):
        squared = np.maximum((y**2).sum(axis=-1)[..., None] + length - 2 * y @ points.T, 0)
        there, back = squared.argmin(axis=2), squared.argmin(axis=1)
        weights = np.concatenate([squared.min(axis=2), squared.min(axis=1)], axis=1)
        weights = 1 / (1 + weights / wide**2)**2
        source = np.concatenate([y, np.take_along_axis(y, back[..., None], axis=1)], axis=1)
        target = np.concatenate([points[there], np.broadcast_to(points, (len(y), *points.shape))], axis=1)
        # weighted Procrustes for all pairs in both directions
        weights /= weights.sum(axis=1, keepdims=True)
        c, d = ((weights[:, None] @ of)[:, 0] for of in (source, target))
        moments = np.swapaxes(weights[..., None] * (target - d[:, None]), 1, 2) @ (source - c[:, None])
        U, _, V = np.linalg.svd(moments)
        U[..., 2] *= np.sign(np.linalg.det(U @ V))[:, None]
        step = U @ V
        y = (y - c[:, None]) @ np.swapaxes(step, 1, 2) + d[:, None]
        t = (step @ (t - c)[..., None])[..., 0] + d
        R = step @ R
    squared = np.maximum((y**2).sum(axis=-1)[..., None] + length - 2 * y @ points.T, 0)
    return R, t, sum((least / (least + wide**2)).mean(axis=1) for least in (squared.min(axis=2), squared.min(axis=1)))


def limb_trees(skeleton: Skeleton) -> list[list[int]]:
    """Return the joints of each limb: the first part that is not of the trunk, and all below it."""
    parents, names = skeleton.parents, skeleton.names
    trees = []
    trunk = ("pelvis", "abdomen", "chest", "trunk", "spine", "neck", "head")
    for joint, parent in enumerate(parents):
        if parent >= 0 and names[parent].startswith(trunk) and not names[joint].startswith(trunk[:-2]):
            tree = [joint]
            tree += [later for later in range(joint + 1, len(parents)) if _is_below(parents, later, joint)]
            trees.append(tree)
    return trees


def _is_below(parents: np.ndarray, joint: int, above: int) -> bool:
    """Tell whether a joint is below another in the tree, or the same."""
    while joint > above:
        joint = int(parents[joint])
    return joint == above


def long_axis(template: Mesh) -> np.ndarray:
    """Return the coordinate axis (3,) along which a standing template is longest."""
    return np.eye(3)[np.ptp(template.vertices, axis=0).argmax()]


def rotation_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute the shortest rotation (3, 3) from a coordinate axis to another unit axis."""
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    if sine < 1e-9:                                                     # equal, or opposite: a half turn
        return np.eye(3) if a @ b > 0 else rotations.exp(np.pi * np.roll(np.abs(a).round(), 1))
    return rotations.exp(axis / sine * np.arctan2(sine, a @ b))
