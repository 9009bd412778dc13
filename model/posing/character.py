"""A character as the mean of a body model: betas are then offsets from it, and poses bend it as they bend people."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from scanprep.geometry.landmarks import match_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import check_points, check_surface
from scanprep.registration.nonrigid import Registration, register
from scanprep.registration.schedule import RegistrationConfig

from ..body import BodyModel, Progress
from ..linear import check_pose
from ..shape_statistics import PLANE

Pose = Literal["found", "rest"]


def character_model(model: BodyModel, vertices: np.ndarray, pose: np.ndarray | Pose = "found") -> BodyModel:
    """Build a model with a character in place of its mean person.

    Shape components, pose-dependent deformation and pose prior stay. Betas are then offsets from the character, whose
    betas are zero. `betas=None` is still the template's own body.

    Parameters
    ----------
    model : BodyModel
        A model with betas.
    vertices : (N, 3) float, metres
        The character in the triangles of the model's template, anywhere.
    pose : (J, 3) float, radians, or "found" or "rest"
        The pose of the character, where it is known. "found" estimates it from the vertices and undoes it. "rest"
        assumes the template's pose, so parts that look rotated have that shape.

    Raises
    ------
    ValueError
        Vertices of another count or not finite, a pose of another shape, a model without betas.

    [MoSh]
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    if vertices.shape != model.template.vertices.shape or not np.isfinite(vertices).all():
        raise ValueError(f"vertices: expected finite numbers of shape {model.template.vertices.shape}, "
                         f"got shape {vertices.shape}")
    if not model.n_betas:
        raise ValueError("model: it has no betas, so no mean person to put a character in the place of")
    if isinstance(pose, str):
        pose = character_pose(model, vertices, pose)
    pose, _ = check_pose(model.skeleton, pose, None)
    found = model.recentre(vertices, pose)
    kept = {name: value for name, value in model.info.items() if name != PLANE}   # these betas are nobody's
    return replace(found, info={**kept, "character": True})                      # type: ignore[type-var]


def character_pose(model: BodyModel, vertices: np.ndarray, pose: Pose) -> np.ndarray:
    """Estimate the pose (J, 3) of a character relative to the template, radians, as for `character_model`."""
    R = model.skeleton.fit_rotations(model.template, vertices)
    if pose == "rest":
        R[:] = R[0]
    return model.skeleton.pose_of(R)


@dataclass(frozen=True, eq=False)
class Character:
    """Result of `register_character`.

    `model` has the character as its mean. `mesh` is the template registered to the character, with its `pose` (J, 3),
    `joints` (J, 3), metres, and which of these lie `inside` (J,). `registration` is None for a mesh that had the
    template's triangles.
    """

    model: BodyModel
    mesh: Mesh
    pose: np.ndarray
    joints: np.ndarray
    inside: np.ndarray
    registration: Registration | None


def register_character(model: BodyModel, mesh: Mesh, landmarks: Mapping[str, np.ndarray] | None = None,
                       template_landmarks: Mapping[str, int] | None = None, config: RegistrationConfig | None = None,
                       progress: Progress | None = None, pose: Pose = "found") -> Character:
    """Make a model of a character from its mesh: register the template to it, then `character_model`.

    The mesh has any size, place and direction, and is about in the template's pose; a mesh with the template's
    triangles is taken as it is. A dozen landmarks spread over the body are enough: tips of hands and feet, elbows,
    knees, head, trunk. `pose` is that of `character_model`. ValueError for fewer than four of the same names.

    [MoSh]
    """
    fit = None
    if np.array_equal(mesh.faces, model.template.faces):
        body = mesh
    else:
        # other triangles: the template is registered by landmarks of the same names
        known = model.info.get("landmarks", {}) if template_landmarks is None else template_landmarks
        _, vertices, points = match_landmarks(known, landmarks or {}, minimum=4)
        fit = _register_character(model.template, mesh, vertices.astype(np.int64), points, config, progress)
        body = fit.mesh
    turns = character_pose(model, body.vertices, pose)
    made = character_model(model, body.vertices, turns)
    joints = model.joint_regressor @ body.vertices
    return Character(made, body, turns, joints, points_inside(body, joints), fit)


def _register_character(template: Mesh, mesh: Mesh, vertices: np.ndarray, points: np.ndarray,
                        config: RegistrationConfig | None, progress: Progress | None) -> Registration:
    """Register the template to the mesh, scaled by the landmarks, in two passes."""
    report_progress = progress or (lambda done, total: None)
    size = _spread(template.vertices[vertices]) / _spread(points)
    start = template.with_vertices(template.vertices / size)
    # two registrations, the second from the result of the first: one alone does not stretch so far
    registrations = 2
    for k in range(registrations):
        def told(done: int, total: int, before: int = k) -> None:
            report_progress(before * total + done, registrations * total)

        fit = register(start, mesh, (vertices, points), config, told)
        start = fit.mesh
    return fit


def _spread(points: np.ndarray) -> float:
    """Compute the root mean square distance of points (n, 3) from their centroid."""
    return float(np.sqrt(((points - points.mean(axis=0))**2).sum(axis=1).mean()))


def points_inside(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Find which points (n, 3) lie inside a closed mesh; ValueError for points that are not finite."""
    import igl

    turns = igl.fast_winding_number(*check_surface(mesh), check_points(points))
    return np.asarray(np.abs(turns) > 0.5)


def character_problem(found: Character) -> str | None:
    """Explain why a character is useless, with the likely cause; None where it is usable."""
    missed = 0.0 if found.registration is None else found.registration.uncovered
    lost = 0.5  # with half of the character missed, or half of the joints outside, the registration has failed
    if missed <= lost and found.inside.mean() >= lost:
        return None
    return (f"{100 * missed:.0f}% of the character lies off the template and {found.inside.sum()} of "
            f"{len(found.inside)} joints inside it; landmarks of other places, left and right exchanged, or a mesh "
            "that is no body?")
