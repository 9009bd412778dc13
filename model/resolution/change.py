"""The same model on another triangulation of its template's surface."""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import singledispatch
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from model.priors import sample_poses
from scanprep.decimation.decimate import DecimateConfig, decimate
from scanprep.geometry.mesh import Mesh, check_template
from scanprep.geometry.surface import Surface
from scanprep.ranges import Settings
from scanprep.skeleton.tree import Skeleton, affine_weights

from ..body import BodyModel
from ..pose_space import PoseSpace, faces_of_part
from ..scape import BlendScapeModel, ScapeModel
from ..shape_space import ShapeSpace
from ..skinning import SkinningModel
from .transfer import Distillation, Follower, Piece, Progress, enough_poses, gradients_of, transfer_skeleton


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
    return transfer_model(model, template, config or ResolutionConfig(), progress)


@singledispatch
def transfer_model(model: BodyModel, template: Mesh, config: ResolutionConfig, progress: Progress | None) -> BodyModel:
    """What `change_resolution` does for one kind of model."""
    raise ValueError(f"model: the resolution of the kind '{model.kind}' cannot be changed")


@transfer_model.register
def _transfer_scape(model: ScapeModel, template: Mesh, config: ResolutionConfig, progress: Progress | None
                 ) -> ScapeModel:
    skeleton = transfer_skeleton(model.skeleton, model.template, template)
    pieces = [Piece(model.template, template, old, new) for old, new in
              zip(faces_of_part(model.skeleton), faces_of_part(skeleton), strict=True)]
    moved = replace(
        model, template=template, skeleton=skeleton, info=transfer_info(model, template),
        pose_space=_transfer_pose_space(model.pose_space, skeleton, pieces),
        shape_space=_transfer_shape_space(model, pieces), **_transfer_blend(model, pieces))
    if not config.rounds:
        return moved
    poses = sample_poses(model, enough_poses(model, 40), np.random.default_rng(0))
    poses[0] = model.pose_mean
    teacher = Distillation(model, Follower(model.template, template), config.rounds, progress)
    return teacher.shape_space(teacher.pose_space(moved, poses), poses[:8])


def _transfer_pose_space(space: PoseSpace, skeleton: Skeleton, pieces: list[Piece]) -> PoseSpace:
    coefficients = []
    for piece, a in zip(pieces, space.coefficients, strict=True):
        action = a.astype(np.float64)
        average = np.stack([piece.average(each) for each in action])
        coefficients.append(gradients_of(piece.v_hat, piece.edges(action), average).astype(a.dtype))
    return PoseSpace(replace(space.features, skeleton=skeleton), tuple(coefficients))


def _transfer_shape_space(model: ScapeModel, pieces: list[Piece]) -> ShapeSpace:
    """S with which the parts, in the mean pose, have the shapes they had."""
    old, F = model.shape_space, sum(len(piece.new_faces) for piece in pieces)
    Q = model.pose_space.gradients(model.pose_mean)
    mean = np.empty((F, 3, 3), dtype=old.mean.dtype)
    components = np.empty((old.count, F, 3, 3), dtype=old.components.dtype)
    for piece in pieces:
        S = np.concatenate([old.mean[None, piece.old_faces], old.components[:, piece.old_faces]]).astype(np.float64)
        average = np.stack([piece.average(each) for each in S])
        bent = Q[piece.old_faces]
        posed = piece.edges(bent[None])[0]
        S = gradients_of(posed, piece.edges(S @ bent), average)
        mean[piece.new_faces], components[:, piece.new_faces] = S[0], S[1:]
    return ShapeSpace(mean, components, old.variances, old.total_variance)


def _transfer_blend(model: ScapeModel, pieces: list[Piece]) -> dict[str, np.ndarray]:
    """The weights of blended rotations, where the model has them."""
    if not isinstance(model, BlendScapeModel):
        return {}
    blend = np.empty((sum(len(piece.new_faces) for piece in pieces), model.blend.shape[1]))
    for piece in pieces:
        blend[piece.new_faces] = piece.average(model.blend[piece.old_faces])
    return {"blend": blend}


@transfer_model.register
def _transfer_skinning(model: SkinningModel, template: Mesh, config: ResolutionConfig, progress: Progress | None
                    ) -> SkinningModel:
    skeleton = transfer_skeleton(model.skeleton, model.template, template)
    follow = Follower(model.template, template)

    def displaced(field: np.ndarray) -> np.ndarray:
        return follow.displacements(field.astype(np.float64)).astype(field.dtype)

    weights = np.maximum(follow.values(model.weights), 0)
    rest, shape_mean = (follow.positions(x.astype(np.float64)).astype(x.dtype) for x in (model.rest, model.shape_mean))
    # the variance is summed over the vertices, of which there are now more or fewer
    per_vertex = len(template.vertices) / len(model.template.vertices)
    return replace(
        model, template=template, skeleton=skeleton, rest=rest, weights=weights / weights.sum(axis=1, keepdims=True),
        features=replace(model.features, skeleton=skeleton), correctives=displaced(model.correctives),
        shape_mean=shape_mean, shape_components=displaced(model.shape_components),
        shape_variances=model.shape_variances * per_vertex, shape_total=model.shape_total * per_vertex,
        regressor=_transfer_regressor(model, template), info=transfer_info(model, template))


def _transfer_regressor(model: SkinningModel, template: Mesh) -> csr_array | None:
    """The joints of a model that has its own, as combinations of the new vertices nearest to theirs and to them."""
    if model.regressor is None:
        return None
    near, places, old = cKDTree(template.vertices), model.regressor @ model.template.vertices, model.regressor
    rows = np.zeros((len(places), len(template.vertices)))
    for j, place in enumerate(places):
        theirs = model.template.vertices[old.indices[old.indptr[j]:old.indptr[j + 1]]]
        chosen = np.union1d(near.query(theirs)[1], near.query(place, 8)[1])
        rows[j, chosen] = affine_weights(template.vertices[chosen], place)
    return csr_array(rows)


def transfer_info(model: BodyModel, template: Mesh) -> dict[str, Any]:
    """The model's info with its landmarks on the nearest new vertices and a note of the resolution it was made at."""
    old, marks = model.template, model.info.get("landmarks", {})
    points = old.vertices[np.array(list(marks.values()), dtype=np.int64)]
    nearest = cKDTree(template.vertices).query(points)[1]
    # digests of training bodies say nothing of bodies in another topology
    kept = {name: value for name, value in model.info.items() if name != "digests"}
    return {**kept, "landmarks": {name: int(v) for name, v in zip(marks, nearest, strict=True)},
            "resolution_of": f"{len(old.vertices)} vertices, {len(old.faces)} triangles"}


def resolution_gap(model: BodyModel, changed: BodyModel, poses: np.ndarray, betas: np.ndarray | None = None
                   ) -> np.ndarray:
    """(B,) mean distance, metres, of two resolutions of a model at the vertices of the second, in poses (B, J, 3).

    With betas (B, k), or of the template's own body.
    """
    follow, gaps = Follower(model.template, changed.template), []
    for b, pose in enumerate(poses):
        mine = None if betas is None else betas[b]
        off = follow.positions(model.vertices(pose, mine)) - changed.vertices(pose, mine)
        gaps.append(np.linalg.norm(off, axis=1).mean())
    return np.array(gaps)


def subdivide(mesh: Mesh, times: int = 1) -> Mesh:
    """Every triangle cut into four by the middles of its sides, so that the surface stays."""
    import igl

    return Mesh(*igl.upsample(mesh.vertices, mesh.faces, times))


def resample(mesh: Mesh, vertices: int) -> Mesh:
    """About so many vertices on the same surface: subdivided until there are enough, then decimated."""
    times = 0
    while len(mesh.vertices) < vertices:
        mesh, times = subdivide(mesh), times + 1
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
