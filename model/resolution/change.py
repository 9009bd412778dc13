"""The same model on another triangulation of its template's surface."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from scanprep.decimation.decimate import DecimateConfig, decimate
from scanprep.geometry.mesh import Mesh, check_template
from scanprep.geometry.surface import Surface
from scanprep.ranges import Settings

from ..body import BodyModel, Progress
from .transfer import SurfaceCarrier, transfer_skeleton


@dataclass(frozen=True)
class ResolutionConfig(Settings):
    """Settings of `change_resolution`.

    Parameters
    ----------
    rounds : int
        How often pose space and shape space are corrected; none for a fast and rougher answer.
    """

    rounds: int = 2


def change_resolution(model: BodyModel, template: Mesh, config: ResolutionConfig | None = None,
                      progress: Progress | None = None) -> BodyModel:
    """Transfer a model to a coarser or finer triangulation, so that pose, betas and trans keep their meaning.

    A skinning model turns parts about joints, and on a body of other betas these are averages of the vertices within
    two edges of the borders of parts, with other triangles a band of another width: such bodies move some millimetres
    apart when they bend. SCAPE models do not use joints in this way.

    Parameters
    ----------
    model : BodyModel
    template : Mesh
        Other triangles on the surface of the model's template, in the same place.
    config : ResolutionConfig, optional
    progress : callable(done, total), optional

    Returns
    -------
    BodyModel
        Of the same kind, with the same tree, joints, features, betas and priors; landmarks are on the nearest new
        vertices.

    Raises
    ------
    ValueError
        Not usable as a template, another surface, or too coarse to have every part.

    [MoSh]
    """
    check_template(template)
    _check_same_surface(model.template, template)
    skeleton = transfer_skeleton(model.skeleton, model.template, template)
    rounds = (config or ResolutionConfig()).rounds
    moved = model.resample(template, skeleton, rounds, progress or (lambda done, total: None))
    # landmarks on the nearest new vertices; digests of training bodies say nothing of bodies in another topology
    old, marks = model.template, model.info.get("landmarks", {})
    nearest = cKDTree(template.vertices).query(old.vertices[np.array(list(marks.values()), dtype=np.int64)])[1]
    info = {name: value for name, value in model.info.items() if name != "digests"} | {
        "landmarks": {name: int(v) for name, v in zip(marks, nearest, strict=True)},
        "resolution_of": f"{len(old.vertices)} vertices, {len(old.faces)} triangles"}
    return replace(moved, info=info)                                             # type: ignore[type-var]


def resolution_gap(model: BodyModel, changed: BodyModel, poses: np.ndarray, betas: np.ndarray | None = None
                   ) -> np.ndarray:
    """(B,) mean distance, metres, of two resolutions of a model at the vertices of the second, in poses (B, J, 3).

    With betas (B, k), or of the template's own body.
    """
    follow, gaps = SurfaceCarrier(model.template, changed.template), []
    for b, pose in enumerate(poses):
        mine = None if betas is None else betas[b]
        off = follow.positions(model.vertices(pose, mine)) - changed.vertices(pose, mine)
        gaps.append(np.linalg.norm(off, axis=1).mean())
    return np.array(gaps)


def subdivide_at_middles(mesh: Mesh, times: int = 1) -> Mesh:
    """Every triangle cut into four by the middles of its sides, so that the surface stays."""
    import igl

    return Mesh(*igl.upsample(mesh.vertices, mesh.faces, times))


def resample(mesh: Mesh, vertices: int) -> Mesh:
    """About so many vertices on the same surface: subdivided until there are enough, then decimated."""
    times = 0
    while len(mesh.vertices) < vertices:
        mesh, times = subdivide_at_middles(mesh), times + 1
    faces = len(mesh.faces) - 2 * (len(mesh.vertices) - vertices)
    return decimate(mesh, faces, DecimateConfig(method="even" if times else "quadric"))


def _check_same_surface(old: Mesh, new: Mesh) -> None:
    # mean edges of the coarser surface that the two may lie apart
    limit = 2.0 * max(old.mean_edge, new.mean_edge)
    for a, b, which in ((new, old, "it lies"), (old, new, "the model's own lies")):
        far = float(Surface(b).closest(a.vertices).distances.max())
        if far > limit:
            raise ValueError(f"template: expected the surface of the model's template in the same place, {which} up to "
                             f"{far:.3g} m away from the other")
