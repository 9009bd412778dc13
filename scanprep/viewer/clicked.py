"""A body whose landmarks are clicked: its surface, its landmarks, and the file that they are saved to."""
from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from ..alignment.icp import landmark_motion
from ..depth_camera.picture import is_picture, read_depth
from ..geometry.files import UNITS, name_of, read_scan
from ..geometry.landmarks import landmarks_beside, read_landmarks, write_landmarks
from ..geometry.mesh import Mesh
from ..geometry.surface import Surface
from ..pictures.camera import Camera, guess_upright
from ..pictures.scene import Pane
from ..pictures.shading import CLAY, Dots, Shape, Solid
from ..pictures.thinning import thin_solid
from .surface_clicks import Clickable

KEPT = ".before"                     # ending of the copy of a landmark file as it was found

Places = dict[str, np.ndarray]


@dataclass(eq=False)
class Clicked:
    """A mesh or cloud with the landmarks that are on it and the file that they are saved to."""

    path: Path
    file: Path
    unit: str | None = None
    places: Places = field(default_factory=dict)
    predicted: Places = field(default_factory=dict)
    surface: Clickable | None = None
    _shown: Shape | None = None
    _saved: bool = False                 # by now

    @classmethod
    def load(cls, path: Path, ending: str, unit: str | None = None, file: Path | None = None) -> Clicked:
        """With the landmarks of its file, or of that of its name beside it; else one of this ending will be written."""
        file = file or landmarks_beside(path)
        one = cls(path, file or path.with_name(name_of(path) + ending), unit)
        if file is not None:
            one.places = one._read(file)
        return one

    def _read(self, file: Path) -> Places:
        """The landmarks of a file; the mesh is read for them only if they need it, as a folder may be large."""
        if not file.name.endswith((".mrk.json", ".fcsv")):       # which may be in another frame: the mesh tells
            with contextlib.suppress(ValueError):
                return read_landmarks(file, None, self.unit)
        places = read_landmarks(file, self.body.shape, self.unit)
        self.forget()
        return places

    @property
    def body(self) -> Clickable:
        """What is clicked on; read when it is first shown."""
        if self.surface is None:
            self.surface = Clickable(read_shown_surface(self.path, self.unit))
        return self.surface

    def forget(self) -> None:
        """Let go of the surface, not of the landmarks; it is read again when it is shown."""
        self.surface = self._shown = None

    def save(self) -> None:
        """Write all landmarks, or remove the file when there are none; what was found in its place is kept, once."""
        kept = self.file.with_name(self.file.name + KEPT)
        if self.file.exists() and not self._saved and not kept.exists():
            shutil.copyfile(self.file, kept)
        self._saved = True
        if self.places:
            write_landmarks(self.file, self.places, self.unit)
        else:                                                    # no reader takes a file without landmarks
            self.file.unlink(missing_ok=True)

    def pane(self, label: str) -> Pane:
        """Its surface as the browser gets it."""
        camera = camera_before(self.body.points) if is_picture(self.path) else camera_of(self.body.shape)
        return Pane([self.shown], camera, label)

    @property
    def shown(self) -> Shape:
        """What is drawn of it: no more triangles or points than one can see."""
        if self._shown is None:
            shape, points = self.body.shape, self.body.points
            # a cloud of more points is no clearer, and slow to turn
            self._shown = thin_solid(Solid(shape)) if isinstance(shape, Mesh) and self.body.has_surface else \
                Dots(points[::max(1, len(points) // 150_000)], CLAY, 0.004)
        return self._shown


def read_shown_surface(path: Path, unit: str | None = None) -> Mesh | np.ndarray:
    """The mesh, or points (n, 3), metres, of a file; of a depth picture, in millimetres unless told, what it gives."""
    if not is_picture(path):
        return read_scan(path, unit)
    picture = read_depth(path, UNITS[unit or "mm"])
    try:
        return picture.without_flying_pixels().mesh()
    except ValueError as problem:
        raise ValueError(f"{path}: {problem}") from None


def camera_before(points: np.ndarray) -> Camera:
    """What a depth camera in the origin, that looks along z with y down, saw of points (n, 3), as it saw them.

    One turns about what stands in the middle of the picture.
    """
    across = points[:, :2] / points[:, 2:]
    low, high = across.min(axis=0), across.max(axis=0)
    middle = (np.abs(across - (low + high) / 2) <= (high - low) / 6).all(axis=1)
    away = float(np.quantile(points[middle if middle.any() else slice(None), 2], 0.25))
    width, height = 2 * away * np.abs(across).max(axis=0)
    return Camera(np.array([0, 0, away]), np.diag([1.0, -1, -1]), np.array([0, -1.0, 0]), width, height, away)


def camera_of(shape: Mesh | np.ndarray) -> Camera:
    """A view of a body from its front, as far as that can be seen from its outline."""
    body = shape if isinstance(shape, Mesh) else Mesh(shape, np.zeros((0, 3), dtype=np.int64))
    up, front = guess_upright(body)
    return Camera.around(body.vertices, front, up=up)


def camera_like(first: Camera, template: np.ndarray, body: Mesh | np.ndarray,
                landmarks: tuple[np.ndarray, np.ndarray] | None) -> Camera:
    """A view of a body from the side from which a camera sees a template, points (n, 3).

    By landmarks (L, 3) of both, at least three; else by the turn about the vertical in which both lie nearest.
    """
    own = camera_of(body)
    points = body.vertices if isinstance(body, Mesh) else body
    if landmarks is not None:
        R_body_template = landmark_motion(*landmarks)[:3, :3]
        side = R_body_template @ first.axes[2]
        return Camera.from_side(points, side, own.vertical) if abs(side @ own.vertical) < 0.9 else own

    def seen(camera: Camera, all_points: np.ndarray, turn: float = 0.0) -> np.ndarray:
        """Some points, right, up and towards the camera that is turned, as shares of their height."""
        flat = camera.axes[2] - (camera.axes[2] @ camera.vertical) * camera.vertical
        flat = flat / np.linalg.norm(flat)
        right = np.cross(camera.vertical, flat)
        back, across = np.cos(turn) * flat + np.sin(turn) * right, np.cos(turn) * right - np.sin(turn) * flat
        # points of a body by which it is turned as another
        few = all_points[np.random.default_rng(0).permutation(len(all_points))[:1500]]
        found = few @ np.stack([across, camera.vertical, back]).T
        return np.asarray((found - np.median(found, axis=0)) / max(float(np.ptp(found[:, 1])), 1e-12))

    target = cKDTree(seen(first, template))
    turns = np.radians(np.arange(0, 360, 15))
    best = min(turns, key=lambda turn: float(target.query(seen(own, points, turn))[0].mean()))
    right = np.cross(own.vertical, own.axes[2])
    return Camera.from_side(points, np.cos(best) * own.axes[2] + np.sin(best) * right, own.vertical)


def predict_landmarks(template: Mesh, on_template: Mapping[str, np.ndarray], body: Clickable,
                      on_scan: Mapping[str, np.ndarray], progress: Callable[[int, int], None] | None = None) -> Places:
    """Where all landmarks of a template should be on a body of which some are known: by registration.

    Points (3,), metres. ValueError for fewer than three in common.
    """
    from ..registration.nonrigid import register
    from ..registration.schedule import RegistrationConfig

    common = [name for name in on_template if name in on_scan]
    nearest = Surface(template).closest(np.array(list(on_template.values())))
    corners = template.faces[nearest.faces]
    vertices = corners[np.arange(len(corners)), nearest.bary.argmax(axis=1)]
    of_name = dict(zip(on_template, vertices.tolist(), strict=True))
    fit = register(template, body.shape, (np.array([of_name[name] for name in common]),
                                          np.array([on_scan[name] for name in common])),
                   RegistrationConfig.quick(), progress)
    moved = nearest.transfer(fit.mesh.vertices, template.faces)
    return {name: body.nearest(place) for name, place in zip(on_template, moved, strict=True)}
