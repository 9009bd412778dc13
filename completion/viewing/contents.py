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
from scanprep.viewer.clicked import camera_before

from ..partial.completion import Completion

SHOWN_OFF = 0.03                     # metres: residual of a marker that is darkest
MARKER = (0.85, 0.25, 0.2)
AXES = {f"{sign}{axis}": s * np.eye(3)[i] for sign, s in (("", 1.0), ("-", -1.0)) for i, axis in enumerate("xyz")}


@dataclass(frozen=True, eq=False)
class Stance:
    """Where a thing is, and how it stands: extent (n, 3) metres, the axis that is up and where the front is."""

    extent: np.ndarray
    up: np.ndarray
    front: np.ndarray
    seen: Camera | None = None           # the first view, where one is given

    @staticmethod
    def of(mesh: Mesh, poses: np.ndarray | None = None) -> Stance:
        """As far as it can be told from the outline of a body; `poses` (T, J, 3) are what it does."""
        return Stance(_box(mesh.vertices), *stance(mesh, None if poses is None else rotations.exp(poses[:, 0])))

    def around(self, points: np.ndarray) -> Stance:
        """The same way up, at other places (..., 3)."""
        return replace(self, extent=_box(points.reshape(-1, 3)))

    def camera(self, up: np.ndarray | None = None) -> Camera:
        """A view from beside the front, 20 degrees to its side and 8 above, this way up."""
        if self.seen is not None:
            return self.seen
        up = self.up if up is None else up
        front = self.front if np.linalg.norm(np.cross(self.front, up)) > 0.1 else np.roll(up, 1)
        flat = front - (front @ up) * up
        side = np.cos(np.radians(20)) * flat + np.sin(np.radians(20)) * np.cross(up, flat)
        return Camera.from_side(self.extent, side, up, 8.0)


@dataclass(frozen=True, eq=False)
class MarkersTold:
    """Residuals (T, L) metres of markers that are dots of one of the shapes, NaN where they were not seen."""

    shape: int
    labels: tuple[str, ...]
    residuals: np.ndarray

    def colors(self) -> dict[str, Any]:
        """The distance shown darkest, and the colours up to it with that of no value last."""
        ramp = Heat(np.append(np.linspace(0, 1, NO_INDEX), np.nan), 0, 1).colors()
        return {"high": SHOWN_OFF, "palette": np.round(255 * ramp).astype(np.uint8).tobytes().hex()}


@dataclass(frozen=True, eq=False)
class Content:
    """One thing, as it is shown: its first shape is a model's body, or a statue's surface, where there is one.

    `start` is the stance in the first frame of a motion, for a view that goes along with it.
    """

    name: str
    shapes: Sequence[Shape | Moving]
    stance: Stance
    about: str = ""
    start: Stance | None = None
    model: BodyModel | None = None
    statue: Statue | None = None
    markers: MarkersTold | None = None
    notes: tuple[str, ...] = ()


def of_mesh(name: str, shape: Mesh | np.ndarray, landmarks: dict[str, np.ndarray] | None = None) -> Content:
    """A mesh, or points (n, 3), with landmarks; not more of it than a browser turns smoothly."""
    mesh = shape if isinstance(shape, Mesh) else Mesh(shape, np.zeros((0, 3), dtype=np.int64))
    stands = Stance.of(mesh)
    marks = [mark_places(landmarks, stands, "landmarks")] if landmarks else []
    if not len(mesh.faces):
        size, every = float(np.linalg.norm(np.ptp(stands.extent, axis=0))), max(1, len(mesh.vertices) // 150_000)
        return Content(name, [Dots(mesh.vertices[::every], CLAY, size / 500), *marks], stands,
                       f"{len(mesh.vertices):,} points")
    shown = thin_solid(Solid(mesh, shades={"plain": np.array(CLAY)} if mesh.colors is not None else {}), 120_000)
    few = len(shown.mesh.faces) < len(mesh.faces)
    notes = (f"{name}: shown with fewer than its {len(mesh.faces):,} triangles",) * few
    return Content(name, [shown, *marks], stands, sizes(mesh), notes=notes)


def mark_places(places: Mapping[str, np.ndarray], stands: Stance, name: str) -> Dots:
    """Landmarks or markers on a thing, with their names."""
    size = float(np.linalg.norm(np.ptp(stands.extent, axis=0)))
    return Dots(np.array(list(places.values())), MARKER, size / 160, True, name=name, labels=tuple(places))


def from_camera(content: Content) -> Content:
    """A mesh that a depth camera saw, from where that was."""
    body = content.shapes[0]
    assert isinstance(body, Solid)
    return replace(content, stance=replace(content.stance, seen=camera_before(body.mesh.vertices)))


def sizes(mesh: Mesh) -> str:
    """How many vertices and triangles."""
    return f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles"


def body_shades(mesh: Mesh, part_of_face: np.ndarray, **more: Any) -> Solid:
    """A body in one colour, or by its parts."""
    return Solid(mesh, CLAY, shades={"parts": part_colors(part_of_face)}, **more)


def of_model(name: str, model: BodyModel) -> Content:
    """A model's mean body, or its template's own, at rest."""
    body = at_rest(model)
    reach = (body.vertices - body.vertices.mean(axis=0)) * 1.12 + body.vertices.mean(axis=0)
    return Content(name, [body_shades(body, model.skeleton.part_of_face)],
                   replace(Stance.of(body), extent=_box(reach)),
                   f"{sizes(body)}, {len(model.skeleton.parents)} parts, {model.n_betas} betas", model=model)


def of_subject(name: str, subject: Subject) -> Content:
    """A body of fixed shape at rest."""
    body = subject.template.with_vertices(subject.vertices(np.zeros((len(subject.skeleton.parents), 3))))
    return Content(name, [body_shades(body, subject.skeleton.part_of_face)], Stance.of(body), sizes(body))


def of_completion(name: str, done: Completion) -> Content:
    """The completed body, with what was seen and how far it may be off, and the predicted one to be shown too."""
    mesh = done.completed
    shades: dict[str, np.ndarray | Heat] = {"seen": np.where(done.seen[:, None], CLAY, (0.55, 0.66, 0.80))}
    if done.expected_error is not None:
        error = np.asarray(done.expected_error, dtype=float)
        shades["expected error"] = Heat(error, 0.0, max(float(np.nanpercentile(error, 98)), 1e-3), "expected error")
    if mesh.colors is not None:
        shades["plain"] = np.array(CLAY)
    shapes = [Solid(mesh, name="completed", shades=shades),
              Solid(done.predicted, (0.55, 0.66, 0.80), name="predicted", visible=False)]
    return Content(name, shapes, Stance.of(mesh), str(done.judgement))


def collect_warnings(make: Callable[[], Content]) -> Content:
    """What is made, with the warnings on the way as its notes; they are given again."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        content = make()
    mine = [str(w.message) for w in caught if issubclass(w.category, UserWarning)]
    for text in mine:
        warnings.warn(text, stacklevel=2)
    return replace(content, notes=(*mine, *content.notes))


def _box(points: np.ndarray) -> np.ndarray:
    points = points[np.isfinite(points).all(axis=1)]
    return np.stack([points.min(axis=0), points.max(axis=0)])
