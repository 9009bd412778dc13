"""Search for a person who stands in a scan with unknown up and front, by the control model."""
from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sides import other_side
from scanprep.geometry.surface import Surface

from ...features import linear_features
from ...fitting.bodies import as_body
from ...fitting.limbs import with_limbs
from ...fitting.rounds import solve_jointly
from ...fitting.scan import ScanPoints, prepare_scan
from ...fitting.scan_fit import ScanFit, scan_fit
from ...fitting.settings import ScanFitConfig
from ...fitting.starts import approach, best_starts, first_starts
from ...human_poses import human_poses, with_human_poses
from ...skinning import SkinningModel
from ..control.model import ControlModel
from .articulated import Articulated
from .features import fit_features
from .sketch import sketch_joints

# standard deviations of people around the control model: all lengths (share), single segments (share), and girth as
# offset of the surface (metres); of toons and game figures single segments and girth
STATURE, LENGTH, GIRTH = 0.12, 0.08, 0.02
ODD_LENGTH, ODD_GIRTH = 0.3, 0.08
# Of 40 public figures in T or A pose those below this distance, metres, and above this ratio to the stand that faces
# the other way were right; the others are tried with odd proportions.
SURE_OFF, SURE_MARGIN = 0.025, 1.2
# Largest distance, metres, of the posed body from a scan, and least ratio of that distance when it faces another way.
# Six synthetic persons: 11 to 13 mm, ratio 1.7 to 3.3. Nine real ones, five of them bent: 18 to 21 mm, 1.5 to 2.9.
# Fronts and sides alone: 21 mm, 1.35 to 1.6. A cylinder: 47 mm, 1.13; a chair: 56 mm; two people: 65 and 70 mm.
OFF, MARGIN = 0.042, 1.05
# By so many times odd proportions must explain more than a person's, since they follow loose clothes too (hips 9% of
# the height off, not 5%), and those of a sketch more than others.
ODD, SKETCHED = 1.1, 1.02
CAP, NORMALS = 0.08, 0.05        # metres: largest distance that counts, and weight of a unit difference of normals
# the control model is coarse and of another body, so it stays 2 cm off
SETTINGS = ScanFitConfig(scan_sd=0.02, rounds=5, scan_points=1500, model_points=800, random_starts=30)


@dataclass(frozen=True, eq=False)
class Stand:
    """A control model that stands in a scan."""

    mesh: Mesh     # the control mesh, metres, in the axes of the scan
    off: float     # metres, RMS distance of the scan from the body, at most `CAP` each, with what normals differ
    misfit: float  # metres, the same with the body from the scan, which counts less: the best stand has the least


def control_body(control: ControlModel, length: float = LENGTH, girth: float = GIRTH) -> SkinningModel:
    """Build the control model as a body of unknown shape: betas for stature, and each segment's length and girth.

    `length` (share) and `girth` (metres) are their standard deviations.
    """
    model, skeleton = Articulated(control), control.skeleton
    x, (N, J, A, S) = control.mesh.vertices, (*control.weights.shape, len(model.axes), len(model.lengths))
    frames = model.frames(model.rest)
    # what a length factor moves: Eq. 2 and 3 are linear in it
    by_length = np.moveaxis(model.derivatives(frames, model.vertices)[..., A:A + S], -1, 0)
    joints_by_length = np.moveaxis(frames.shifts, 1, 0)
    by_girth = (control.weights @ model.is_of).T[..., None] * control.mesh.vertex_normals
    components = np.concatenate([STATURE * by_length.sum(axis=0, keepdims=True), length * by_length, girth * by_girth])
    joints = np.concatenate([STATURE * joints_by_length.sum(axis=0, keepdims=True), length * joints_by_length,
                             np.zeros((S, J, 3))])
    mean, covariance = with_human_poses(control.mesh, skeleton, 0, np.zeros((J, 3)), np.eye(3 * J))
    known = human_poses(control.mesh, skeleton, 200, np.random.default_rng(0))
    return SkinningModel(
        control.mesh, skeleton, x, control.weights, linear_features(skeleton, (np.zeros((3, 0)),) * J),
        np.zeros((0, N, 3)), x, components, np.ones(len(components)), float(len(components)), mean, covariance,
        pose_examples=np.zeros((0, J, 3)) if known is None else known, joint_components=joints)


def find_stand(control: ControlModel, scan: Mesh | np.ndarray) -> list[Stand]:
    """Find the best stand in a scan of a person's size, metres, and the best one that faces another way.

    Where a body of a person's proportions is in doubt, one of odd proportions starts from it, and from a sketch of the
    joints; the best stand wins.
    """
    cloud = prepare_scan(scan)
    fit = _search(control_body(control), cloud)
    coarse = fit.few()
    x, _ = with_limbs(fit, coarse, best_starts(coarse, first_starts(fit, coarse)))
    x = solve_jointly(fit, coarse, x, lambda done: None).x
    other = approach(coarse, facing_back(fit, x))
    stands = sorted((_stand(fit, one) for one in (x, other)), key=lambda stand: stand.misfit)
    if stands[0].off < SURE_OFF and stands[1].off > SURE_MARGIN * stands[0].off:
        return stands
    # the same unknowns, in standard deviations of odd figures
    S, n = len(control.segments), fit.body.n_angles + 3
    to_odd = np.concatenate([np.ones(n + 1), np.full(S, LENGTH / ODD_LENGTH), np.full(S, GIRTH / ODD_GIRTH)])
    odd = _search(control_body(control, ODD_LENGTH, ODD_GIRTH), cloud)
    tried = [(ODD if shows_person(*stands) else 1.0, stands), (1.0, _settle(odd, [to_odd * x, to_odd * other]))]
    with contextlib.suppress(ValueError):                  # no figure that spreads its limbs
        sketch = sketch_joints(scan)
        sides = sketch, tuple({other_side(name) or name: place for name, place in marks.items()} for marks in sketch)
        tried.append((1 / SKETCHED, _settle(odd, [pose_by_sketch(control, odd, *marks) for marks in sides])))
    return min(tried, key=lambda one: one[1][0].misfit / one[0])[1]


def shows_person(best: Stand, other: Stand) -> bool:
    """Tell whether a stand, and the one that faces another way, show that there is a person who stands upright."""
    return best.off <= OFF and other.off >= MARGIN * best.off


def _search(body: SkinningModel, cloud: ScanPoints) -> ScanFit:
    return scan_fit(as_body(body), cloud, np.zeros(0, dtype=np.int64), np.zeros((0, 3)), SETTINGS)


def _settle(fit: ScanFit, starts: list[np.ndarray]) -> list[Stand]:
    """Fit a body from unknowns (P,) that face different ways; the better stand comes first."""
    coarse = fit.few()
    stands = [_stand(fit, solve_jointly(fit, coarse, x, lambda done: None).x) for x in starts]
    return sorted(stands, key=lambda stand: stand.misfit)


def pose_by_sketch(control: ControlModel, fit: ScanFit, joints: dict[str, np.ndarray], tips: dict[str, np.ndarray]
                      ) -> np.ndarray:
    """Compute the unknowns (P,) of a body of odd proportions that is posed by sketched joints and tips of limbs."""
    posed, n = fit_features(control, joints, tips), fit.body.n_angles
    longer = posed.lengths / Articulated(control).lengths - 1
    x = np.concatenate([posed.pose.ravel(), np.zeros(4), longer / ODD_LENGTH, np.zeros(len(longer))])
    x[n:n + 3] = posed.vertices.mean(axis=0) - fit.body.vertices(x).mean(axis=0)
    return x


def facing_back(fit: ScanFit, x: np.ndarray) -> np.ndarray:
    """Turn a body by half a turn about its long axis, with limbs at rest; return unknowns (P,)."""
    body, out = fit.body, x.copy()
    pose, before = body.pose_mean.copy(), body.vertices(x).mean(axis=0)
    up = np.zeros(3)
    up[np.ptp(body.template.vertices, axis=0).argmax()] = np.pi
    pose[0] = rotations.log(rotations.exp(x[:3]) @ rotations.exp(up))
    out[:body.n_angles] = pose.ravel()
    out[body.n_angles:body.n_angles + 3] += before - body.vertices(out).mean(axis=0)
    return out


def _stand(fit: ScanFit, x: np.ndarray) -> Stand:
    mesh = fit.mesh(x)
    return Stand(mesh, *stand_misfit(mesh, fit.thin.points, fit.thin.normals))


def stand_misfit(body: Mesh, points: np.ndarray, normals: np.ndarray) -> tuple[float, float]:
    """Measure the distance of a body and scan points (n, 3): `off` and `misfit` of a `Stand`."""
    there = Surface(body).closest(points)
    facing = np.einsum("nd,nd->n", body.face_normals[there.faces], normals)
    off = np.minimum(there.distances**2 + NORMALS**2 * (1 - facing), CAP**2)
    near = cKDTree(np.hstack([points, NORMALS * normals]))
    back = np.minimum(near.query(np.hstack([body.vertices, NORMALS * body.vertex_normals]))[0] ** 2, CAP**2)
    unseen = float(back @ body.vertex_areas) / float(body.vertex_areas.sum())
    return float(np.sqrt(off.mean())), float(np.sqrt(off.mean() + 0.3 * unseen))      # it may show a part only
