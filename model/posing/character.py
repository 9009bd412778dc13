"""A character as the mean of a body model: betas are then offsets from it, and poses bend it as they bend people."""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import singledispatch
from typing import Annotated, Literal

import numpy as np

from scanprep.ranges import FLAG, Settings

from ..body import BodyModel
from ..gradients import GradientSystem, ShapeSolver
from ..learning.sex_plane import PLANE
from ..linear import check_pose
from ..scape import ScapeModel
from ..skinning import SkinningModel

OWN_CHARACTER = "character"          # its place in a model's info
SMOOTHNESS = 0.0001                  # of Eq. 8: a character's triangles share less of their shape than people's
NORMAL = 0.3                         # how much normals count beside edges: triangles thicken as they grow
ROUNDS = 2                           # of adding what is left of the character to its shape


@dataclass(frozen=True)
class CharacterConfig(Settings):
    """Settings of `character_model`.

    Attributes
    ----------
    pose : "found" or "rest"
        How the character stands: its parts are turned against the template's, which is found and undone, or it stands
        in the template's pose and parts that look turned are built so.
    """

    pose: Annotated[Literal["found", "rest"], FLAG] = "found"


def character_model(model: BodyModel, vertices: np.ndarray, config: CharacterConfig | None = None,
                    pose: np.ndarray | None = None) -> BodyModel:
    """The model with a character in place of its mean person.

    Shape components, pose-dependent deformation and pose prior stay: betas are offsets from the character, whose own
    are zero. None is still the template's own body.

    Parameters
    ----------
    model : BodyModel
    vertices : (N, 3) float, metres
        The character in the triangles of the model's template, anywhere.
    config : CharacterConfig, optional
    pose : (J, 3) float, radians, optional
        How the character stands, where it is known.

    Raises
    ------
    ValueError
        Vertices of another count or not finite, a pose of another shape, a model without betas.

    [MoSh]
    """
    config = config or CharacterConfig()
    vertices = np.asarray(vertices, dtype=np.float64)
    if vertices.shape != model.template.vertices.shape or not np.isfinite(vertices).all():
        raise ValueError(f"vertices: expected finite numbers of shape {model.template.vertices.shape}, "
                         f"got shape {vertices.shape}")
    if not model.n_betas:
        raise ValueError("model: it has no betas, so no mean person to put a character in the place of")
    if pose is None:
        pose = character_pose(model, vertices, config)
    pose, _ = check_pose(model.skeleton, pose, None)
    found = recentred(model, vertices, pose)
    kept = {name: value for name, value in model.info.items() if name != PLANE}   # these betas are nobody's
    return replace(found, info={**kept, OWN_CHARACTER: True})                      # type: ignore[type-var]


def character_pose(model: BodyModel, vertices: np.ndarray, config: CharacterConfig) -> np.ndarray:
    """How the parts (J, 3) of a character are turned against the template's, radians."""
    R = model.skeleton.fit_rotations(model.template, vertices)
    if config.pose == "rest":
        R[:] = R[0]
    return model.skeleton.pose_of(R)


@singledispatch
def recentred(model: BodyModel, vertices: np.ndarray, pose: np.ndarray) -> BodyModel:
    """The model whose mean person is in the pose (J, 3) the character with vertices (N, 3), for one kind of model."""
    raise ValueError(f"model: the kind '{model.kind}' cannot take a character")


@recentred.register
def _of_triangles(model: ScapeModel, vertices: np.ndarray, pose: np.ndarray) -> ScapeModel:
    """S by Eq. 8, and again for what the stitched character then lacks.

    Two edges leave open how a triangle thickens. People are smooth enough to share it with their neighbours; where a
    character is squeezed and stretched, poses that turn triangles out of their plane would then turn them over.
    """
    posed, wanted = model.posed_edges(pose), model.parts.local_edges(vertices, pose)
    with_normals = np.concatenate([posed, NORMAL * _normals(posed)], axis=1)
    solver = ShapeSolver(GradientSystem(model.template, SMOOTHNESS), with_normals)
    target, S = np.concatenate([wanted, NORMAL * _normals(wanted)], axis=1), np.zeros((len(posed), 3, 3))
    for _ in range(1 + ROUNDS):
        S += solver(target - with_normals @ np.swapaxes(S, -1, -2))
    return replace(model, shape_space=replace(model.shape_space, mean=S.astype(np.float32)))


def _normals(pairs: np.ndarray) -> np.ndarray:
    """A third edge (F, 1, 3) for each pair of edges (F, 2, 3): square to both, as long as the triangle is wide.

    [Sumner]
    """
    cross = np.cross(pairs[:, 0], pairs[:, 1])
    length = np.sqrt(np.linalg.norm(cross, axis=1, keepdims=True))
    return np.asarray(cross / np.maximum(length, np.finfo(float).tiny))[:, None]


@recentred.register
def _of_vertices(model: SkinningModel, vertices: np.ndarray, pose: np.ndarray) -> SkinningModel:
    return replace(model, shape_mean=model.unposed(vertices, pose))
