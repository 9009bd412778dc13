"""What is seen of one thing: shapes, where they stand, and what can be done with them."""
from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from model.body import BodyModel
from model.fitting.bodies import at_rest
from model.linear import Subject
from model.statue.control.model import Statue
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import Camera, stance
from scanprep.pictures.colors import part_colors
from scanprep.pictures.scene import NO_INDEX
from scanprep.pictures.shading import CLAY, Dots, Heat, Moving, Shape, Solid
from scanprep.pictures.thinning import thin_solid
from scanprep.viewer.clicked import as_mesh, camera_before

from ..partial.completion import Completion

SHOWN_OFF = 0.03                     # metres: residual of a marker that is shown darkest
MARKER = (0.85, 0.25, 0.2)           # colour of markers and landmarks
# name of an axis -> its direction
AXES = {f"{sign}{axis}": s * np.eye(3)[i] for sign, s in (("", 1.0), ("-", -1.0)) for i, axis in enumerate("xyz")}


@dataclass(frozen=True, eq=False)
class Stance:
    """Where a thing is and how it stands.

    `extent` (n, 3), metres, are points that must be visible; `up` and `front` are unit vectors (3,).
    """

    extent: np.ndarray
    up: np.ndarray
    front: np.ndarray
    seen: Camera | None = None           # a fixed first view, where there is one

    @staticmethod
    def of(mesh: Mesh, poses: np.ndarray | None = None) -> Stance:
        """Guess the stance from the outline of a body; `poses` (T, J, 3) are its motion."""
        return Stance(_box(mesh.vertices), *stance(mesh, None if poses is None else rotations.exp(poses[:, 0])))

    def around(self, points: np.ndarray) -> Stance:
        """Return the same stance around other points (..., 3)."""
        return replace(self, extent=_box(points.reshape(-1, 3)))

    def camera(self, up: np.ndarray | None = None) -> Camera:
        """Return a camera 20 degrees beside the front and 8 degrees above."""
        if self.seen is not None:
            return self.seen
        up = self.up if up is None else up
        # a front along the vertical would give no side: take any other direction
        front = self.front if np.linalg.norm(np.cross(self.front, up)) > 0.1 else np.roll(up, 1)
        flat = front - (front @ up) * up
        side = np.cos(np.radians(20)) * flat + np.sin(np.radians(20)) * np.cross(up, flat)
        return Camera.from_side(self.extent, side, up, 8.0)


@dataclass(frozen=True, eq=False)
class MarkerResiduals:
    """Residuals (T, L), metres, of markers that are dots of one of the shapes; NaN where not seen."""

    shape: int
    labels: tuple[str, ...]
    residuals: np.ndarray

    def colors(self) -> dict[str, Any]:
        """Return the residual shown darkest, and the palette, with the colour for no value last."""
        ramp = Heat(np.append(np.linspace(0, 1, NO_INDEX), np.nan), 0, 1).colors()
        return {"high": SHOWN_OFF, "palette": np.round(255 * ramp).astype(np.uint8).tobytes().hex()}


@dataclass(frozen=True, eq=False)
class Content:
    """One thing as it is shown; its first shape is the body of a model, or the surface of a statue, if it has one.

    `start` is the stance in the first frame of a motion, for a view that follows it.
    """

    name: str
    shapes: Sequence[Shape | Moving]
    stance: Stance
    about: str = ""
    start: Stance | None = None
    model: BodyModel | None = None
    statue: Statue | None = None
    markers: MarkerResiduals | None = None
    notes: tuple[str, ...] = ()


def of_mesh(name: str, shape: Mesh | np.ndarray, landmarks: dict[str, np.ndarray] | None = None) -> Content:
    """Show a mesh, or points (n, 3), with landmarks; simplified so that a browser turns it smoothly."""
    mesh = as_mesh(shape)
    stance = Stance.of(mesh)
    marks = [mark_places(landmarks, stance, "landmarks")] if landmarks else []
    if not len(mesh.faces):
        size, every = float(np.linalg.norm(np.ptp(stance.extent, axis=0))), max(1, len(mesh.vertices) // 150_000)
        return Content(name, [Dots(mesh.vertices[::every], CLAY, size / 500), *marks], stance,
                       f"{len(mesh.vertices):,} points")
    solid = thin_solid(Solid(mesh, shades={"plain": np.array(CLAY)} if mesh.colors is not None else {}), 120_000)
    simplified = len(solid.mesh.faces) < len(mesh.faces)
    notes = (f"{name}: shown with fewer than its {len(mesh.faces):,} triangles",) * simplified
    return Content(name, [solid, *marks], stance, sizes(mesh), notes=notes)


def mark_places(places: Mapping[str, np.ndarray], stance: Stance, name: str) -> Dots:
    """Show landmarks or markers on a thing, with their names."""
    size = float(np.linalg.norm(np.ptp(stance.extent, axis=0)))
    return Dots(np.array(list(places.values())), MARKER, size / 160, True, name=name, labels=tuple(places))


def from_camera(content: Content) -> Content:
    """Show a mesh seen by a depth camera from where the camera was."""
    body = content.shapes[0]
    assert isinstance(body, Solid)
    return replace(content, stance=replace(content.stance, seen=camera_before(body.mesh.vertices)))


def sizes(mesh: Mesh) -> str:
    """Return the number of vertices and triangles as text."""
    return f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles"


def body_shades(mesh: Mesh, part_of_face: np.ndarray, **more: Any) -> Solid:
    """Show a body in one colour, or coloured by parts."""
    return Solid(mesh, CLAY, shades={"parts": part_colors(part_of_face)}, **more)


def of_model(name: str, model: BodyModel) -> Content:
    """Show the mean body of a model, or its template, at rest."""
    body = at_rest(model)
    # 12% more room than the body at rest, as its limbs will move
    reach = (body.vertices - body.vertices.mean(axis=0)) * 1.12 + body.vertices.mean(axis=0)
    return Content(name, [body_shades(body, model.skeleton.part_of_face)],
                   replace(Stance.of(body), extent=_box(reach)),
                   f"{sizes(body)}, {len(model.skeleton.parents)} parts, {model.n_betas} betas", model=model)


def of_subject(name: str, subject: Subject) -> Content:
    """Show a body of fixed shape at rest."""
    body = subject.template.with_vertices(subject.vertices(np.zeros((len(subject.skeleton.parents), 3))),
                                          subject.template.up)
    return Content(name, [body_shades(body, subject.skeleton.part_of_face)], Stance.of(body), sizes(body))


def of_completion(name: str, completion: Completion) -> Content:
    """Show a completed body: what was seen, its expected error, and hidden at first the predicted body."""
    mesh = completion.completed
    shades: dict[str, np.ndarray | Heat] = {"seen": np.where(completion.seen[:, None], CLAY, (0.55, 0.66, 0.80))}
    if completion.expected_error is not None:
        error = np.asarray(completion.expected_error, dtype=float)
        shades["expected error"] = Heat(error, 0.0, max(float(np.nanpercentile(error, 98)), 1e-3), "expected error")
    if mesh.colors is not None:
        shades["plain"] = np.array(CLAY)
    shapes = [Solid(mesh, name="completed", shades=shades),
              Solid(completion.predicted, (0.55, 0.66, 0.80), name="predicted", visible=False)]
    return Content(name, shapes, Stance.of(mesh), str(completion.judgement))


def collect_warnings(make: Callable[[], Content]) -> Content:
    """Make a content; warnings on the way become its notes, and are repeated."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        content = make()
    texts = [str(w.message) for w in caught if issubclass(w.category, UserWarning)]
    for text in texts:
        warnings.warn(text, stacklevel=2)
    return replace(content, notes=(*texts, *content.notes))


def _box(points: np.ndarray) -> np.ndarray:
    """Return two corners (2, 3) of the box around finite points."""
    points = points[np.isfinite(points).all(axis=1)]
    return np.stack([points.min(axis=0), points.max(axis=0)])
