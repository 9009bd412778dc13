"""Registration of the control model by features: pose, segment lengths and place, then the shape of the head."""
from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from scanprep.alignment.icp import align_landmarks
from scanprep.geometry import rotations

from ..control.model import ControlModel
from .articulated import Articulated, BoundPoints


@dataclass(frozen=True, eq=False)
class FeatureFit:
    """The control model in the pose, with the lengths and at the place of a scan."""

    pose: np.ndarray      # (J, 3) radians, as `Skeleton.part_rotations` takes it
    lengths: np.ndarray   # (S,) metres, of the segments
    vertices: np.ndarray  # (N, 3) metres
    joints: np.ndarray    # (J, 3) metres
    joint_rms: float      # metres, misfit of the joints; NaN without any
    point_rms: float      # metres, misfit of the points of the surface; NaN without any
    converged: bool


def fit_features(control: ControlModel, joints: Mapping[str, np.ndarray],
                 points: Mapping[str, np.ndarray] | None = None) -> FeatureFit:
    """Pose, segment lengths and place of a control model that bring its features, by name, to those of a scan.

    What they leave open (the twist of an arm with a straight elbow, the length of a hand) a weak prior keeps near the
    default pose and lengths. ValueError for unknown names, places that are not finite, fewer than three features that
    are not on one line.

    [Statues] Eq. 4
    """
    from scipy.optimize import minimize

    model = Articulated(control)
    features, goal = _features(control, joints, points or {})
    T = _place(model, features, joints, goal)
    scale = float(np.cbrt(np.linalg.det(T[:3, :3])))
    R = T[:3, :3] / scale
    goal = (goal - T[:3, 3]) @ R / scale                        # in the axes and the size of the control model
    bounds = np.concatenate([model.limits, [[0.4, 2.5]] * len(model.lengths), [[-np.inf, np.inf]] * 3])
    at = {name: goal[k] for k, name in enumerate(joints)}
    start = np.clip(analytic_start(model, at), *bounds.T)
    # Each unknown is measured by what it moves: a hand and the whole body alike, in millimetres.
    reach = np.linalg.norm(model.derivatives(model.frames(start), features), axis=(0, 1))
    unit = 1e-3 / np.maximum(reach, 0.03 * reach.max())

    def energy(z: np.ndarray) -> tuple[float, np.ndarray]:
        x = unit * z
        value, slope = feature_misfit(model, x, features, goal)
        off = (x - model.rest)[:-3]
        off[:3] = 0                                             # the way the body stands is nobody's default
        # one radian, or a length twice the default one, is worth a misfit of 1 mm: what the features leave open
        slope[:-3] += 2e-6 * off
        return 1e6 * (value + 1e-6 * float(off @ off)), 1e6 * unit * slope

    found = minimize(energy, start / unit, jac=True, method="L-BFGS-B", bounds=bounds / unit[:, None],
                     options={"maxiter": 2000, "maxfun": 4000, "ftol": 1e-9, "gtol": 1e-6, "maxcor": 50})
    x = np.clip(unit * found.x, *bounds.T)
    frames = model.frames(x)
    pose = model.pose(x)
    pose[0] = rotations.log(R @ rotations.exp(pose[0]))
    centres = scale * frames.joints @ R.T + T[:3, 3]
    apart = scale * np.linalg.norm(model.positions(frames, features) - goal, axis=1)
    vertices = scale * model.positions(frames, model.vertices) @ R.T + T[:3, 3]
    return FeatureFit(pose, scale * model.split(x)[1] * model.lengths, vertices, centres, _rms(apart[:len(joints)]),
                      _rms(apart[len(joints):]), bool(found.success))


def feature_misfit(model: Articulated, x: np.ndarray, features: BoundPoints, goal: np.ndarray) -> tuple[float,
                                                                                                        np.ndarray]:
    """Sum of squares between features and where they are wanted (n, 3), and its gradient (P,). [Statues] Eq. 4"""
    frames = model.frames(x)
    off = model.positions(frames, features) - goal
    return float(np.sum(off**2)), 2 * np.einsum("nd,ndp->p", off, model.derivatives(frames, features))


def warp(vertices: np.ndarray, from_points: np.ndarray, to_points: np.ndarray, share: np.ndarray | None = None
         ) -> np.ndarray:
    """Carry vertices (N, 3) along with points (n, 3), by the smoothest displacement of space (φ(p) = |p|³ with an
    affine part), of which each vertex takes its `share` (N,). [Statues] Eq. 5

    The paper prints φ(p_k^H - p_k^C), a constant; interpolation needs φ(p - p_k^C). ValueError for points in one plane:
    the affine part would be anything across it, and the back of a head would go anywhere.
    """
    from scipy.interpolate import RBFInterpolator

    spread = np.linalg.svd(from_points - from_points.mean(axis=0), compute_uv=False)
    if len(from_points) < 4 or spread[2] <= 0.02 * spread[0]:
        raise ValueError(f"from_points: expected at least 4 points that are not in one plane, got {len(from_points)}")
    moved = RBFInterpolator(from_points, to_points - from_points, kernel="cubic", degree=1)(vertices)
    return vertices + (moved if share is None else share[:, None] * moved)


def head_share(control: ControlModel) -> np.ndarray:
    """(N,) from 1 on the head to 0 beyond it: w²(3 - 2w) of its skinning weight, flat at both ends of the neck."""
    w = control.weights[:, control.skeleton.names.index("skullbase")]
    return w * w * (3 - 2 * w)


def _features(control: ControlModel, joints: Mapping[str, np.ndarray], points: Mapping[str, np.ndarray]
              ) -> tuple[BoundPoints, np.ndarray]:
    """The features on the control model and where they are wanted (n, 3): joints first."""
    names = control.skeleton.names
    for what, given, known in (("joints", joints, names), ("points", points, control.landmarks)):
        unknown = [name for name in given if name not in known]
        if unknown:
            raise ValueError(f"{what}: the control model has no {', '.join(map(repr, unknown))}, it has "
                             f"{', '.join(known)}")
    parts = [names.index(name) for name in joints]
    vertices = [control.landmarks[name] for name in points]
    for name, place in {**joints, **points}.items():
        if np.shape(place) != (3,) or not np.isfinite(place).all():
            raise ValueError(f"{name}: expected three finite numbers, got {place!r}")
    goal = np.array([*joints.values(), *points.values()], dtype=np.float64).reshape(-1, 3)
    return BoundPoints(np.concatenate([np.eye(len(names))[parts], control.weights[vertices]]),
                       np.concatenate([control.skeleton.joints[parts], control.mesh.vertices[vertices]])), goal


def _place(model: Articulated, features: BoundPoints, joints: Mapping[str, np.ndarray], goal: np.ndarray) -> np.ndarray:
    """The similarity (4, 4) of the trunk, from the bases of the limbs where they suffice, else from all features."""
    bases = [model.control.skeleton.names[base] for base, _, _ in limb_joints(model)]
    trunk = [k for k, name in enumerate(joints) if name in bases]
    for rows in (trunk, list(range(len(goal)))):
        if len(rows) > 2 and not _on_a_line(goal[rows]) and not _on_a_line(features.rest[rows]):
            return align_landmarks(features.rest[rows], goal[rows], scale=True).T_target_source
    raise ValueError(f"joints, points: expected at least three features that are not on one line, got {len(goal)}")


def _on_a_line(points: np.ndarray) -> bool:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= 0.01 * spread[0])


def _rms(distances: np.ndarray) -> float:
    return float(np.sqrt(np.mean(distances**2))) if len(distances) else np.nan


def limb_joints(model: Articulated) -> list[tuple[int, int, int | None]]:
    """Base, middle and end joint of every limb: a joint of three axes, on it one of one axis, and what it carries."""
    freedom = np.bincount(model.joint_of, minlength=len(model.control.axes))
    parents = model.control.skeleton.parents
    found = []
    for middle in range(1, len(parents)):
        base = int(parents[middle])
        if base > 0 and freedom[middle] == 1 and freedom[base] == 3:
            ends = np.flatnonzero(parents == middle)
            found.append((base, middle, int(ends[0]) if len(ends) else None))
    return found


def analytic_start(model: Articulated, at: Mapping[str, np.ndarray]) -> np.ndarray:
    """Lengths from joints that are neighbours, and each limb from its base, middle and end joints in closed form."""
    skeleton, x = model.control.skeleton, model.rest.copy()
    o, names = skeleton.joints, skeleton.names
    angles, factors, _ = model.split(x)
    ratios = defaultdict(list)
    for c, p in enumerate(skeleton.parents[1:], 1):
        if names[c] in at and names[p] in at:
            ratios[model.control.segment_of_part[p]].append(
                np.linalg.norm(at[names[c]] - at[names[p]]) / max(np.linalg.norm(o[c] - o[p]), 1e-9))
    for s, values in ratios.items():
        factors[s] = np.mean(values)
    for base, middle, end in limb_joints(model):
        if names[base] in at and names[middle] in at:
            goal = [at[names[middle]] - at[names[base]]]
            if end is not None and names[end] in at:
                goal.append(at[names[end]] - at[names[middle]])
            angles[model.joint_of == base], angles[model.joint_of == middle] = limb_angles(
                model, base, middle, end, np.array(goal))
    return x


def limb_angles(model: Articulated, base: int, middle: int, end: int | None, goal: np.ndarray
                ) -> tuple[np.ndarray, float]:
    """Angles (3,) of the base joint and of the middle one that point bones along goals, in the axes above.

    A hinge has two angles at which two bones enclose the right one: of these the one that is farther inside the limits
    of both joints, or else nearer to the default pose.
    """
    o, of_base, of_hinge = model.control.skeleton.joints, model.joint_of == base, model.joint_of == middle
    bones = _unit(np.array([o[middle] - o[base], *([o[end] - o[middle]] if len(goal) == 2 else [])]))
    goal, hinge, limits = _unit(goal), model.axes[of_hinge][0], model.limits[of_base]
    tried = []
    for bend in _bends(hinge, bones[0], bones[1], float(goal[0] @ goal[1])) if len(goal) == 2 else np.zeros(1):
        allowed = float(np.clip(bend, *model.limits[of_hinge][0]))
        bent = np.concatenate([bones[:1], bones[1:] @ rotations.exp(allowed * hinge).T])
        # The identity decides how a straight limb is rotated about itself.
        H = goal.T @ bent + 1e-3 * np.eye(3)
        angles = np.linalg.solve(model.axes[of_base].T, rotations.log(rotations.project(H[None])[0]))
        beyond = np.abs(angles - np.clip(angles, *limits.T)).sum() + abs(bend - allowed)
        tried.append((round(float(beyond), 3), abs(allowed), allowed, angles))
    _, _, bend, angles = min(tried, key=lambda t: t[:2])
    return angles, bend


def _bends(axis: np.ndarray, first: np.ndarray, second: np.ndarray, cosine: float) -> np.ndarray:
    """The two angles of a hinge at which two bones, unit, enclose an angle of the given cosine, or come nearest."""
    still = (first @ axis) * (axis @ second)
    a, b = first @ second - still, first @ np.cross(axis, second)
    middle, half = np.arctan2(b, a), np.arccos(np.clip((cosine - still) / max(np.hypot(a, b), 1e-12), -1, 1))
    return (np.array([middle - half, middle + half]) + np.pi) % (2 * np.pi) - np.pi


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
