"""Solve [SCAPE] Eq. 10 as the paper does: rotations of the parts, surface and shape in turns.

The energy is E_H[Y] + w_Z Σ |y_l - z_l|². Each block is a linear least-squares problem while the others are fixed, and
the joint angles follow from the rotations afterwards. The patent has a variant in which joint angles of a kinematic
chain replace the rotations: moving one joint then carries all parts below it and changes its own Q. The default method
does that: its unknowns are the pose parameters, and `model.linear.PointOperator.jacobian` holds the derivative of the
chain [SCAPE-patent §0090-0091].
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from scipy.sparse import csr_array

from model.body import BodyModel
from model.fitting.free_surface import FreeSurface
from model.fitting.rounds import SETTLED, Solved
from model.fitting.scan_fit import EVIDENCE, FINAL_REACH, REACH, ScanFit, Skin
from model.gradients import edges
from model.linear import Subject
from model.scape import ScapeModel
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from .settings import CompletionConfig

MORE = 3                             # times the rounds of the joint method: each block moves only a little in a round


def turns_of(body: BodyModel | Subject, config: CompletionConfig) -> Callable[..., Solved]:
    """Return the alternating solver; ValueError for a body without R, S and Q per triangle, or for a free scale."""
    if config.method != "alternation":
        raise ValueError(f"method: expected 'joint' or 'alternation', got {config.method!r}")
    if config.free_scale:
        raise ValueError("free_scale: expected False with method='alternation'; a scan of unknown scale needs 'joint'")
    if isinstance(body, ScapeModel) and body.kind == ScapeModel.kind:
        return partial(solve_in_turns, body, config.surface_weight)
    what = f"a model of kind {body.kind!r}" if isinstance(body, BodyModel) else f"a {type(body).__name__}"
    raise ValueError(f"body: expected a SCAPE model with method='alternation', which turns and deforms its triangles, "
                     f"got {what}; a model learned without shapes stands for its template's own body")


@dataclass(frozen=True, eq=False)
class Markers:
    """Measured points of [SCAPE] Eq. 10."""

    vertices: np.ndarray    # (L,) int, the vertex y_l of each
    points: np.ndarray      # (L, 3), metres, z_l
    weights: np.ndarray     # (L,), w_Z of each


@dataclass(frozen=True, eq=False)
class Blocks:
    """Unknowns of [SCAPE] Eq. 10."""

    R: np.ndarray           # (J, 3, 3), rotations of the parts
    Y: np.ndarray           # (N, 3), metres
    betas: np.ndarray       # (K,)


class Alternation:
    """The three steps of the alternation for one model."""

    def __init__(self, model: ScapeModel) -> None:
        self.model, self.skeleton = model, model.skeleton
        self.part = model.skeleton.part_of_face
        self.v_hat = edges(model.template.vertices, model.template.faces)
        self.surface = FreeSurface(model.template)

    @cached_property
    def _components(self) -> np.ndarray:
        return np.ascontiguousarray(self.model.shape_space.components)

    def deform_edges(self, R: np.ndarray) -> np.ndarray:
        """Compute the edges `Q v̂` (F, 2, 3) for rotations (J, 3, 3), from the joint angles between them."""
        Q = self.model.pose_space.gradients(self.skeleton.pose_of(R))
        return self.v_hat @ np.swapaxes(Q, -1, -2)

    def shape(self, betas: np.ndarray) -> np.ndarray:
        """Compute S (F, 3, 3) for betas (K,); a model without shape components has its template's own body."""
        return self.model.shape_space.gradients(betas if len(betas) else None)

    def predict(self, R: np.ndarray, betas: np.ndarray) -> np.ndarray:
        """Compute the minimum Ŷ (N, 3) of E_H, metres, with the root's joint at the origin."""
        turned = R[self.part] @ self.shape(betas)
        return self.model.stitching.stitch(self.deform_edges(R) @ np.swapaxes(turned, -1, -2))

    def solve_rotations(self, now: Blocks, w_T: float) -> Blocks:
        """Solve for R with Y, betas and Q fixed; differences between neighbouring twists are damped.

        [SCAPE] Eq. 11
        """
        e = self.deform_edges(now.R) @ np.swapaxes(now.R[self.part] @ self.shape(now.betas), -1, -2)
        t = solve_twists(self.skeleton, self.part, e, edges(now.Y, self.model.template.faces), w_T)
        return Blocks(rotations.exp(t) @ now.R, now.Y, now.betas)

    def solve_vertices(self, now: Blocks, markers: Markers) -> Blocks:
        """Solve for Y with R and betas fixed.

        [SCAPE] Eq. 10
        """
        L = len(markers.vertices)
        pick = csr_array((np.ones(L), (np.arange(L), markers.vertices)), shape=(L, len(now.Y)))
        Y = self.surface.solve(self.predict(now.R, now.betas), pick, markers.points, markers.weights)
        return Blocks(now.R, Y, now.betas)

    def solve_shape(self, now: Blocks) -> Blocks:
        """Solve for the betas with R and Y fixed: linear least squares, as R⁻¹ brings the edges back to the part.

        [SCAPE] §6
        """
        if not len(now.betas):
            return now
        # Σ |S(β) Q v̂ - Rᵀ v|² with S = Uβ + μ: the design matrix U q and the right side Rᵀ v - μ q
        q = np.swapaxes(self.deform_edges(now.R), -1, -2)                                                   # (F, 3, 2)
        U = (self._components @ q.astype(self._components.dtype)).reshape(len(now.betas), -1)
        wanted = np.swapaxes(edges(now.Y, self.model.template.faces) @ now.R[self.part], -1, -2)      # Rᵀ v
        left = (wanted - self.model.shape_space.mean @ q).reshape(-1)
        normal = (U @ U.T).astype(np.float64)
        betas = np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(len(normal)), U @ left)
        return Blocks(now.R, now.Y, betas)

    def energy(self, now: Blocks, markers: Markers) -> float:
        """Compute E_H[Y] + w_Z Σ |y_l - z_l|².

        [SCAPE] Eq. 10
        """
        e = self.deform_edges(now.R) @ np.swapaxes(now.R[self.part] @ self.shape(now.betas), -1, -2)
        off = now.Y[markers.vertices] - markers.points
        return float(((e - edges(now.Y, self.model.template.faces))**2).sum()
                     + (markers.weights * (off**2).sum(axis=1)).sum())


def solve_twists(skeleton: Skeleton, part: np.ndarray, e: np.ndarray, v: np.ndarray, w_T: float) -> np.ndarray:
    """Solve for twists t (J, 3), radians, that turn the edges e of every part onto v, similar for neighbours.

    Minimises Σ |(I + t̂) e - v|² + w_T Σ_adj |t_a - t_b|². `part` (F,) int is the part of each triangle; `e` and `v`
    are (F, 2, 3), metres; `w_T` is in square metres.

    [SCAPE] Eq. 11
    """
    # data: t̂ e = -[e] t, so each triangle adds [e]ᵀ[e] to the block of its part and e × v to the right side
    J = len(skeleton.parents)
    block = np.einsum("fjd,fjd->f", e, e)[:, None, None] * np.eye(3) - np.swapaxes(e, -1, -2) @ e   # [e]ᵀ[e]
    right = np.cross(e, v).sum(axis=1)
    normal, side = np.zeros((J, 3, J, 3)), np.zeros((J, 3))
    np.add.at(side, part, right)
    own = np.zeros((J, 3, 3))
    np.add.at(own, part, block)
    normal[np.arange(J), :, np.arange(J), :] = own
    # damping: w_T (t_j - t_p) for every joint between a part j and its parent p
    for j in range(1, J):
        p = skeleton.parents[j]
        for a, b, sign in ((j, j, 1), (p, p, 1), (j, p, -1), (p, j, -1)):
            normal[a, :, b, :] += sign * w_T * np.eye(3)
    return np.linalg.solve(normal.reshape(3 * J, 3 * J), side.ravel()).reshape(J, 3)


def solve_in_turns(model: ScapeModel, surface_weight: float, fit: ScanFit, few: ScanFit, x: np.ndarray,
                   report_progress: Callable[[int], None]) -> Solved:
    """Alternate over R, Y and betas; in every round the scan points closest to Y[Z] become markers.

    Arguments and result are those of `solve_jointly`.

    [SCAPE] §7
    """
    config, steps = fit.config, Alternation(model)
    pose, _, betas = fit.body.split(x)
    now = Blocks(model.skeleton.part_rotations(pose), fit.body.vertices(x), betas)
    # the limit on the distance of matches shrinks for half of the rounds, then stays
    rounds, shift = MORE * config.rounds, np.inf
    reaches = np.geomspace(REACH, FINAL_REACH, rounds)
    for i, reach in enumerate([*reaches, *[FINAL_REACH] * rounds]):
        markers, before = nearest_markers(fit, surface_weight, model.template.with_vertices(now.Y), reach), now.Y
        now = steps.solve_rotations(now, config.twist_weight)               # [SCAPE] Eq. 11
        now = steps.solve_vertices(now, markers)                         # [SCAPE] Eq. 10
        now = steps.solve_shape(now)                                     # [SCAPE] §6
        shift = float(np.sqrt(((now.Y - before)**2).sum(axis=1).mean()))
        report_progress(min(1 + i // MORE, config.rounds))
        if i >= rounds and shift < SETTLED / MORE:
            break
    # back to the unknowns of the joint method: joint angles, place, betas
    trans = model.stitching.root_weights @ now.Y - model.skeleton.joints[0]
    x = np.concatenate([model.skeleton.pose_of(now.R).ravel(), trans, now.betas])
    return Solved(x, bool(shift < SETTLED), i + 1, {"eq_10": steps.energy(now, markers)})


def nearest_markers(fit: ScanFit, surface_weight: float, mesh: Mesh, reach: float) -> Markers:
    """Find the closest points, and return them with the landmarks as markers, weighted as in the joint method.

    Weights are in units of one scan point. `surface_weight` is meant for all points of the scan; fewer are matched.

    [SCAPE] §7
    """
    config = fit.config
    ids, points, _, weights = fit.matches(Skin(mesh.vertices, mesh.vertex_normals), fit.thin, reach)
    one = EVIDENCE / config.scan_sd**2 / len(fit.thin.points)
    w_Z = surface_weight * len(fit.cloud.points) / len(fit.thin.points)
    marked = np.full(len(fit.vertices), config.landmark_sd**-2)
    return Markers(np.concatenate([fit.vertices, ids]), np.concatenate([fit.points, points]),
                   w_Z / one * np.concatenate([marked, weights]))
