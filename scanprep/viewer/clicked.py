"""A body on which landmarks are clicked: its surface, its landmarks, and the file they are saved to."""
from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..alignment.icp import landmark_motion
from ..depth_camera.picture import is_picture, read_depth
from ..geometry.files import UNITS, name_of, read_scan
from ..geometry.landmark_writing import is_written
from ..geometry.landmarks import landmarks_beside, read_landmarks, write_landmarks
from ..geometry.mesh import Mesh
from ..geometry.storage import keep_former
from ..geometry.surface import Surface
from ..pictures.camera import Camera, guess_upright, outer_side
from ..pictures.scene import Pane
from ..pictures.shading import CLAY, Dots, Shape, Solid
from ..pictures.thinning import thin_solid
from .surface_clicks import Clickable

MOST_ASIDE = 60                      # degrees from the middle of its outside, at which a one-sided scan is shown first

Places = dict[str, np.ndarray]


@dataclass(eq=False)
class Clicked:
    """A mesh or point cloud with its landmarks and the file that they are saved to."""

    path: Path
    file: Path
    unit: str | None = None
    places: Places = field(default_factory=dict)
    predicted: Places = field(default_factory=dict)
    surface: Clickable | None = None
    opacity: float = 1.0                 # as it is drawn
    _shown: Shape | None = None
    _saved: bool = False                 # by this program
    _order: tuple[str, ...] = ()         # names in the order of the file, also of those taken away, which may come back

    @classmethod
    def load(cls, path: Path, ending: str, unit: str | None = None, file: Path | None = None) -> Clicked:
        """Load the landmarks of `file`, or of that beside the body.

        Without one, or beside one whose format is only read, a file with this ending is written later.
        """
        file = file or landmarks_beside(path)
        saved = file if file and is_written(file) else (file or path).with_name(name_of(path) + ending)
        one = cls(path, saved, unit)
        if file is not None:
            one.places = one._read(file)
            one._order = tuple(one.places)
        return one

    def _read(self, file: Path) -> Places:
        """Read landmarks; the mesh is read only for formats that need it, as a folder may hold many."""
        if not file.name.endswith((".mrk.json", ".fcsv")):   # 3D Slicer's may be in another frame
            with contextlib.suppress(ValueError):
                return read_landmarks(file, None, self.unit)
        places = read_landmarks(file, self.body.shape, self.unit)
        self.forget()
        return places

    @property
    def body(self) -> Clickable:
        """Return the surface that is clicked on; it is read when it is first shown."""
        if self.surface is None:
            self.surface = Clickable(read_shown_surface(self.path, self.unit))
        return self.surface

    def forget(self) -> None:
        """Release the surface, not the landmarks; it is read again when it is shown."""
        self.surface = self._shown = None

    def save(self) -> None:
        """Write all landmarks, or remove the file when there are none; a file from before is backed up once."""
        if self.file.exists() and not self._saved:
            keep_former(self.file)
        self._saved, self._order = True, tuple(dict.fromkeys([*self._order, *self.places]))
        if self.places:
            write_landmarks(self.file, {name: self.places[name] for name in self._order if name in self.places},
                            self.unit)
        else:                                                    # a file without landmarks could not be read again
            self.file.unlink(missing_ok=True)

    def pane(self, label: str) -> Pane:
        """Return the surface as the browser gets it."""
        camera = camera_before(self.body.points) if is_picture(self.path) else camera_of(self.body.shape)
        return Pane([self.shown], camera, label)

    @property
    def shown(self) -> Shape:
        """Return what is drawn: no more triangles or points than one can see."""
        if self._shown is None:
            shape, points = self.body.shape, self.body.points
            # 150,000 points of 4 mm look dense; more are slow to turn
            self._shown = thin_solid(Solid(shape, opacity=self.opacity)) if isinstance(shape, Mesh) and \
                self.body.has_surface else Dots(points[::max(1, len(points) // 150_000)], CLAY, 0.004)
        return self._shown


def read_shown_surface(path: Path, unit: str | None = None) -> Mesh | np.ndarray:
    """Read a mesh, or points (n, 3), metres; a depth picture (in millimetres unless told) gives a mesh."""
    if not is_picture(path):
        return read_scan(path, unit)
    picture = read_depth(path, UNITS[unit or "mm"])
    try:
        return picture.without_flying_pixels().mesh()
    except ValueError as problem:
        raise ValueError(f"{path}: {problem}") from None


def camera_before(points: np.ndarray) -> Camera:
    """Return the view of a depth camera at the origin, looking along z with y down, of points (n, 3) that it saw.

    The view turns about what is in the middle of the picture.
    """
    across = points[:, :2] / points[:, 2:]
    low, high = across.min(axis=0), across.max(axis=0)
    # the distance at which to turn: the nearer points in the middle third of the picture
    middle = (np.abs(across - (low + high) / 2) <= (high - low) / 6).all(axis=1)
    away = float(np.quantile(points[middle if middle.any() else slice(None), 2], 0.25))
    width, height = 2 * away * np.abs(across).max(axis=0)
    return Camera(np.array([0, 0, away]), np.diag([1.0, -1, -1]), np.array([0, -1.0, 0]), width, height, away)


def camera_of(shape: Mesh | np.ndarray) -> Camera:
    """Return a view of a body from its front, as far as its outline shows where that is."""
    body = as_mesh(shape)
    up, front = guess_upright(body)
    return Camera.around(body.vertices, front, up=up)


def as_mesh(shape: Mesh | np.ndarray) -> Mesh:
    """Return a mesh as it is, and points (n, 3) as one without triangles."""
    return shape if isinstance(shape, Mesh) else Mesh(shape, np.zeros((0, 3), dtype=np.int64))


def camera_like(first: Camera, body: Mesh | np.ndarray, landmarks: tuple[np.ndarray, np.ndarray] | None) -> Camera:
    """Return a view of a body from the side from which a camera sees a template, by landmarks (L, 3) of both.

    Without landmarks, at least three, it is the body's own front. A one-sided scan is never seen from its inside.
    """
    own_view = camera_of(body)
    if landmarks is None:
        return own_view
    # turn the template's view like the body; a view from above or below is not helpful
    points, outward = as_mesh(body).vertices, outer_side(as_mesh(body), int(np.abs(own_view.vertical).argmax()))
    side = landmark_motion(*landmarks)[:3, :3] @ first.axes[2]
    outside = outward is None or side @ outward > np.cos(np.radians(MOST_ASIDE))
    return Camera.from_side(points, side, own_view.vertical) \
        if outside and abs(side @ own_view.vertical) < 0.9 else own_view


def predict_landmarks(template: Mesh, on_template: Mapping[str, np.ndarray], body: Clickable,
                      on_scan: Mapping[str, np.ndarray], progress: Callable[[int, int], None] | None = None) -> Places:
    """Predict where all landmarks of a template are on a body, from some known ones, by registration.

    Points are (3,), metres. ValueError for fewer than three in common.
    """
    from ..registration.nonrigid import register
    from ..registration.schedule import RegistrationConfig

    common = [name for name in on_template if name in on_scan]
    # registration needs vertices: the nearest corner of the triangle that a landmark lies on
    nearest = Surface(template).closest(np.array(list(on_template.values())))
    corners = template.faces[nearest.faces]
    vertices = corners[np.arange(len(corners)), nearest.bary.argmax(axis=1)]
    of_name = dict(zip(on_template, vertices.tolist(), strict=True))
    fit = register(template, body.shape, (np.array([of_name[name] for name in common]),
                                          np.array([on_scan[name] for name in common])),
                   RegistrationConfig.quick(), progress)
    # then move the exact places with the registered template, and onto the body
    moved = nearest.transfer(fit.mesh.vertices, template.faces)
    return {name: body.nearest(place) for name, place in zip(on_template, moved, strict=True)}
