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
    """Result of `fit_features`: the control model with pose, segment lengths and place of a scan."""

    pose: np.ndarray      # (J, 3) radians, as `Skeleton.part_rotations` takes it
    lengths: np.ndarray   # (S,) metres, of the segments
    vertices: np.ndarray  # (N, 3) metres
    joints: np.ndarray    # (J, 3) metres
    joint_rms: float      # metres, misfit of the joints; NaN without any
    point_rms: float      # metres, misfit of the points of the surface; NaN without any
    converged: bool
    worst: str = ""       # the feature that is farthest from its place, and how far


def fit_features(control: ControlModel, joints: Mapping[str, np.ndarray],
                 points: Mapping[str, np.ndarray] | None = None) -> FeatureFit:
    """Fit pose, segment lengths and place of a control model to features of a scan, by name.

    A weak prior keeps what they leave open (the twist of an arm with a straight elbow, the length of a hand) near the
    default. ValueError for unknown names, points that are not finite, or fewer than three features off a line.

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
    # scale each unknown by how far it moves the features, so that all have about the same effect, in millimetres
    reach = np.linalg.norm(model.derivatives(model.frames(start), features), axis=(0, 1))
    unit = 1e-3 / np.maximum(reach, 0.03 * reach.max())

    def energy(z: np.ndarray) -> tuple[float, np.ndarray]:
        x = unit * z
        value, slope = feature_misfit(model, x, features, goal)
        off = (x - model.rest)[:-3]
        off[:3] = 0                                             # the root's rotation has no prior
        # one radian, or twice the default length, costs as much as a misfit of 1 mm
        slope[:-3] += 2e-6 * off
        return 1e6 * (value + 1e-6 * float(off @ off)), 1e6 * unit * slope

    result = minimize(energy, start / unit, jac=True, method="L-BFGS-B", bounds=bounds / unit[:, None],
                      options={"maxiter": 2000, "maxfun": 4000, "ftol": 1e-9, "gtol": 1e-6, "maxcor": 50})
    x = np.clip(unit * result.x, *bounds.T)
    frames = model.frames(x)
    pose = model.pose(x)
    pose[0] = rotations.log(R @ rotations.exp(pose[0]))
    centres = scale * frames.joints @ R.T + T[:3, 3]
    apart = scale * np.linalg.norm(model.positions(frames, features) - goal, axis=1)
    vertices = scale * model.positions(frames, model.vertices) @ R.T + T[:3, 3]
    farthest = f"'{[*joints, *(points or {})][apart.argmax()]}' most, {100 * apart.max():.0f} cm"
    return FeatureFit(pose, scale * model.split(x)[1] * model.lengths, vertices, centres, _rms(apart[:len(joints)]),
                      _rms(apart[len(joints):]), bool(result.success), farthest)


def feature_misfit(model: Articulated, x: np.ndarray, features: BoundPoints, goal: np.ndarray) -> tuple[float,
                                                                                                        np.ndarray]:
    """Compute the sum of squared distances of features from goals (n, 3), and its gradient (P,). [Statues] Eq. 4"""
    frames = model.frames(x)
    off = model.positions(frames, features) - goal
    return float(np.sum(off**2)), 2 * np.einsum("nd,ndp->p", off, model.derivatives(frames, features))


def warp(vertices: np.ndarray, from_points: np.ndarray, to_points: np.ndarray, share: np.ndarray | None = None
         ) -> np.ndarray:
    """Warp vertices (N, 3) so that points (n, 3) reach their goals, each vertex by its `share` (N,).

    The displacement of space is the smoothest one: φ(p) = |p|³ with an affine part. The paper prints φ(p_k^H - p_k^C),
    a constant; interpolation needs φ(p - p_k^C). ValueError for points in one plane, which do not determine the affine
    part: the back of a head could go anywhere.

    [Statues] Eq. 5
    """
    from scipy.interpolate import RBFInterpolator

    spread = np.linalg.svd(from_points - from_points.mean(axis=0), compute_uv=False)
    if len(from_points) < 4 or spread[2] <= 0.02 * spread[0]:
        raise ValueError(f"from_points: expected at least 4 points that are not in one plane, got {len(from_points)}")
    moved = RBFInterpolator(from_points, to_points - from_points, kernel="cubic", degree=1)(vertices)
    return vertices + (moved if share is None else share[:, None] * moved)


def head_share(control: ControlModel) -> np.ndarray:
    """Compute shares (N,) from 1 on the head to 0 beyond: w²(3 - 2w) of its blend weight, flat at both ends."""
    w = control.weights[:, control.skeleton.names.index("skullbase")]
    return w * w * (3 - 2 * w)


def _features(control: ControlModel, joints: Mapping[str, np.ndarray], points: Mapping[str, np.ndarray]
              ) -> tuple[BoundPoints, np.ndarray]:
    """Collect the features on the control model and their goals (n, 3), joints first."""
    names = control.skeleton.names
    for what, named, known in (("joints", joints, names), ("points", points, control.landmarks)):
        unknown = [name for name in named if name not in known]
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
    """Fit a similarity (4, 4) of the trunk, by the bases of the limbs where they suffice, else by all features."""
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
    """List base, middle and end joint of every limb: a joint with three axes, a hinge on it, and the hinge's child."""
    freedom = np.bincount(model.joint_of, minlength=len(model.control.axes))
    parents = model.control.skeleton.parents
    limbs = []
    for middle in range(1, len(parents)):
        base = int(parents[middle])
        if base > 0 and freedom[middle] == 1 and freedom[base] == 3:
            ends = np.flatnonzero(parents == middle)
            limbs.append((base, middle, int(ends[0]) if len(ends) else None))
    return limbs


def analytic_start(model: Articulated, at: Mapping[str, np.ndarray]) -> np.ndarray:
    """Compute a start: lengths from neighbouring joints, and limbs from base, middle and end joints in closed form."""
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
    """Compute angles (3,) of the base joint and that of the hinge which point bones along goals.

    A hinge has two angles at which the bones enclose the right angle. The one that better respects the limits of both
    joints is taken, or else the one nearer to the default pose.
    """
    o, of_base, of_hinge = model.control.skeleton.joints, model.joint_of == base, model.joint_of == middle
    bones = _unit(np.array([o[middle] - o[base], *([o[end] - o[middle]] if len(goal) == 2 else [])]))
    goal, hinge, limits = _unit(goal), model.axes[of_hinge][0], model.limits[of_base]
    tried = []
    for bend in _bends(hinge, bones[0], bones[1], float(goal[0] @ goal[1])) if len(goal) == 2 else np.zeros(1):
        allowed = float(np.clip(bend, *model.limits[of_hinge][0]))
        bent = np.concatenate([bones[:1], bones[1:] @ rotations.exp(allowed * hinge).T])
        # a small multiple of the identity decides the twist of a straight limb
        H = goal.T @ bent + 1e-3 * np.eye(3)
        angles = np.linalg.solve(model.axes[of_base].T, rotations.log(rotations.project(H[None])[0]))
        beyond = np.abs(angles - np.clip(angles, *limits.T)).sum() + abs(bend - allowed)
        tried.append((round(float(beyond), 3), abs(allowed), allowed, angles))
    _, _, bend, angles = min(tried, key=lambda t: t[:2])
    return angles, bend


def _bends(axis: np.ndarray, first: np.ndarray, second: np.ndarray, cosine: float) -> np.ndarray:
    """Compute the two hinge angles at which two unit bones enclose an angle of a given cosine, or come nearest."""
    still = (first @ axis) * (axis @ second)
    a, b = first @ second - still, first @ np.cross(axis, second)
    middle, half = np.arctan2(b, a), np.arccos(np.clip((cosine - still) / max(np.hypot(a, b), 1e-12), -1, 1))
    return (np.array([middle - half, middle + half]) + np.pi) % (2 * np.pi) - np.pi


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
