"""Change the resolution of a model: the same model on another triangulation of its template's surface."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from scanprep.decimation.decimate import DecimateConfig, decimate
from scanprep.geometry.attached import Attached
from scanprep.geometry.carrier import mount
from scanprep.geometry.mesh import Mesh, check_template, take_any_mesh
from scanprep.geometry.surface import Surface

from ..body import BodyModel, Progress
from .transfer import transfer_skeleton


@take_any_mesh
def change_resolution(model: BodyModel, template: Mesh, rounds: int = 2, progress: Progress | None = None
                      ) -> BodyModel:
    """Transfer a model to a coarser or finer triangulation, so that pose, betas and trans keep their meaning.

    Bent bodies of a skinning model may move some millimetres. Its joints are averages of the vertices within two edges
    of the borders of parts, and other triangles make that band wider or narrower. SCAPE models are not affected.

    Parameters
    ----------
    model : BodyModel
        A model of any kind.
    template : Mesh, metres
        Other triangles on the surface of the model's template, in the same place.
    rounds : int
        How often pose space and shape space are corrected; 0 is faster and rougher.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    BodyModel
        A model of the same kind, with the same tree, joints, features, betas and priors. Landmarks are on the nearest
        new vertices.

    Raises
    ------
    ValueError
        A mesh that is no template, another surface, or too coarse to have every part.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> from model.resolution.change import resample
    >>> model = load_built_in_model()
    >>> coarse = change_resolution(model, resample(model.template, 2000), rounds=0)
    >>> len(coarse.template.vertices), coarse.n_betas
    (2000, 30)

    [MoSh]
    """
    check_template(template)
    _check_same_surface(model.template, template)
    template = _with_attached(replace(template, up=model.template.up), model.template)
    skeleton = transfer_skeleton(model.skeleton, model.template, template)
    moved = model.resample(template, skeleton, rounds, progress or (lambda done, total: None))
    # landmarks on the nearest new vertices; digests of training bodies say nothing of bodies in another topology
    old, marks = model.template, model.info.get("landmarks", {})
    nearest = cKDTree(template.vertices).query(old.vertices[np.array(list(marks.values()), dtype=np.int64)])[1]
    info = {name: value for name, value in model.info.items() if name != "digests"} | {
        "landmarks": {name: int(v) for name, v in zip(marks, nearest, strict=True)},
        "resolution_of": f"{len(old.vertices)} vertices, {len(old.faces)} triangles"}
    return replace(moved, info=info)                                             # type: ignore[type-var]


def _with_attached(template: Mesh, old: Mesh) -> Mesh:
    """Attach to new triangles of a body what was attached to the old ones: it comes after the vertices of the body."""
    if old.attached is None:
        return template
    others, whole, N = old.attached.others, old.attached.whole, len(template.vertices)
    place = np.full(len(whole.vertices), -1)
    place[others] = N + np.arange(len(others))
    faces = place[whole.faces]
    mesh = Mesh(np.concatenate([template.vertices, whole.vertices[others]]),
                np.concatenate([template.faces, faces[(faces >= 0).all(axis=1)]]))
    return replace(template, attached=Attached(mesh, np.arange(N), template))


def resolution_gap(model: BodyModel, changed: BodyModel, poses: np.ndarray, betas: np.ndarray | None = None
                   ) -> np.ndarray:
    """Measure the mean distance (B,), metres, of two resolutions of a model in poses (B, J, 3).

    At the vertices of the second, for betas (B, k) or the template's own body.
    """
    follow, gaps = mount(model.template, changed.template), []
    for b, pose in enumerate(poses):
        own = None if betas is None else betas[b]
        off = follow.positions(model.vertices(pose, own)) - changed.vertices(pose, own)
        gaps.append(np.linalg.norm(off, axis=1).mean())
    return np.array(gaps)


def subdivide_at_middles(mesh: Mesh) -> Mesh:
    """Cut every triangle into four at the middles of its sides; the surface stays the same."""
    import igl

    return Mesh(*igl.upsample(mesh.vertices, mesh.faces, 1))


def resample(mesh: Mesh, vertices: int) -> Mesh:
    """Resample a surface to about so many vertices: subdivide until there are enough, then decimate."""
    times = 0
    while len(mesh.vertices) < vertices:
        mesh, times = subdivide_at_middles(mesh), times + 1
    faces = len(mesh.faces) - 2 * (len(mesh.vertices) - vertices)
    return decimate(mesh, faces, DecimateConfig(method="even" if times else "quadric"))


def _check_same_surface(old: Mesh, new: Mesh) -> None:
    # the two surfaces may be two mean edges of the coarser one apart
    limit = 2.0 * max(old.mean_edge, new.mean_edge)
    for a, b, which in ((new, old, "it lies"), (old, new, "the model's own lies")):
        far = float(Surface(b).closest(a.vertices).distances.max())
        if far > limit:
            raise ValueError(f"template: expected the surface of the model's template in the same place, {which} up to "
                             f"{far:.3g} m away from the other")
