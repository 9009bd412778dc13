"""Depth pictures: remove flying pixels, and convert to points with normals or a mesh."""
from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from ..geometry import storage
from ..geometry.images import open_image
from ..geometry.mesh import Mesh

NOISE = 0.002                        # metres at one metre, times the squared distance; typical of depth cameras
JUMP = 0.02                          # metres, or share of the distance: neighbours farther apart are different surfaces
SMOOTHED = 2                         # normals are estimated from so many pixels on each side
LARGEST = 4096                       # pixels a side: the finest depth cameras have 2,816; it takes 0.5 GB of memory
CAMERA = ".camera.json"              # ending of the file beside a picture


@dataclass(frozen=True, eq=False)
class DepthPicture:
    """A picture of distances along the optical axis. The camera is at the origin and looks along z; x right, y down.

    Attributes
    ----------
    depth : (h, w) float, metres
        NaN where nothing was measured.
    intrinsics : (3, 3) float, pixels
        Focal lengths on the diagonal, the optical centre in the last column.

    Examples
    --------
    >>> picture = DepthPicture.of(np.full((8, 8), 1.5), np.array([[10, 0, 3.5], [0, 10, 3.5], [0, 0, 1]]))
    >>> picture.points().shape
    (8, 8, 3)
    """

    depth: np.ndarray
    intrinsics: np.ndarray

    @staticmethod
    def of(depth: np.ndarray, intrinsics: np.ndarray) -> DepthPicture:
        """Make a picture from distances that are zero, infinite or negative where nothing was measured.

        `depth` (h, w), metres; `intrinsics` (3, 3), pixels. ValueError for other shapes, and for depths that cannot be
        metres.
        """
        depth, intrinsics = np.asarray(depth, dtype=np.float64), np.asarray(intrinsics, dtype=np.float64)
        if depth.ndim != 2 or min(depth.shape) < 8:
            raise ValueError(f"depth: expected a picture of distances (h, w), got shape {depth.shape}")
        if intrinsics.shape != (3, 3) or not np.isfinite(intrinsics).all() or min(np.diag(intrinsics)) <= 0:
            raise ValueError(f"intrinsics: expected (3, 3) with focal lengths in pixels, got {intrinsics.tolist()}")
        depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
        if not (known := depth[np.isfinite(depth)]).size:
            raise ValueError("depth: nothing was measured anywhere in the picture")
        if not 0.1 < float(np.median(known)) < 30:
            raise ValueError(f"depth: its median is {np.median(known):.3g} m; expected metres, 0.1 to 30")
        return DepthPicture(depth, intrinsics)

    @property
    def seen(self) -> np.ndarray:
        """(h, w) bool: where something was measured."""
        return np.isfinite(self.depth)

    def points(self) -> np.ndarray:
        """Return the points (h, w, 3), metres; NaN where nothing was measured."""
        row, column = pixels(self.depth.shape)
        return self.depth[..., None] * self.directions(column, row)

    def directions(self, column: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Return the rays (..., 3) of pixels, with length one along the optical axis."""
        K = self.intrinsics
        return np.stack([(column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1], np.ones(np.shape(column))], axis=-1)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Project points (..., 3), metres: row and column (...) of their pixels, and whether they are inside."""
        K, (h, w) = self.intrinsics, self.depth.shape
        ahead = points[..., 2] > 1e-6
        z = np.where(ahead, points[..., 2], 1.0)
        column = np.rint(K[0, 0] * points[..., 0] / z + K[0, 2])
        row = np.rint(K[1, 1] * points[..., 1] / z + K[1, 2])
        inside = ahead & (row >= 0) & (row < h) & (column >= 0) & (column < w)
        return (np.where(inside, row, 0).astype(np.int64), np.where(inside, column, 0).astype(np.int64), inside)

    def jump(self) -> np.ndarray:
        """Return by how much (h, w), metres, neighbours on one surface may differ."""
        return JUMP * np.maximum(np.nan_to_num(self.depth), 1.0)

    def without_flying_pixels(self) -> DepthPicture:
        """Remove flying pixels, which hang between two surfaces.

        A pixel stays if at least half of its eight neighbours are about as far away.
        """
        alike, there = np.zeros(self.depth.shape), np.zeros(self.depth.shape)
        padded, jump, (h, w) = np.pad(self.depth, 1, constant_values=np.nan), self.jump(), self.depth.shape
        for i in range(3):
            for j in range(3):
                other = padded[i:i + h, j:j + w]
                there += np.isfinite(other)
                alike += np.abs(other - self.depth) < jump
        return replace(self, depth=np.where((alike - 1 >= 0.5 * 8) & (there > 4), self.depth, np.nan))

    def normals(self, smoothed: int = SMOOTHED) -> np.ndarray:
        """Estimate unit normals (h, w, 3) towards the camera by planes of inverse depth; NaN where unknown.

        A plane in space is linear in inverse depth over the picture: 1/z = a·ray, and a is its normal.
        """
        size = 2 * smoothed + 1
        row, column = pixels(self.depth.shape)
        rays, known = self.directions(column, row), self.seen
        inverse = np.where(known, 1 / np.where(known, self.depth, 1.0), 0.0)

        def over(values: np.ndarray) -> np.ndarray:
            """Average known values over the window."""
            return np.asarray(ndimage.uniform_filter(values * known, size, mode="constant"))

        # normal equations of a per pixel, summed over a window by box filters; 40% of the window must have data
        A, b = np.zeros((*self.depth.shape, 3, 3)), np.zeros((*self.depth.shape, 3))
        for i in range(3):
            b[..., i] = over(rays[..., i] * inverse)
            for j in range(i, 3):
                A[..., i, j] = A[..., j, i] = over(rays[..., i] * rays[..., j])
        enough = known & (over(np.ones(self.depth.shape)) > 0.4)
        out = np.full((*self.depth.shape, 3), np.nan)
        n = -np.linalg.solve(A[enough] + 1e-12 * np.eye(3), b[enough][..., None])[..., 0]
        out[enough] = n / np.maximum(np.linalg.norm(n, axis=1), 1e-12)[:, None]
        return out

    def mesh(self) -> Mesh:
        """Mesh neighbouring pixels on one surface, facing the camera; ValueError without any triangle."""
        number = np.arange(self.depth.size).reshape(self.depth.shape)
        a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
        faces = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])
        depth = self.depth.ravel()[faces]
        with np.errstate(invalid="ignore"):
            faces = faces[np.ptp(depth, axis=1) < self.jump().ravel()[faces[:, 0]]]
        if not len(faces):
            raise ValueError("depth: no two neighbouring pixels are on one surface")
        used, index = np.unique(faces, return_inverse=True)
        return Mesh(self.points().reshape(-1, 3)[used], index.reshape(-1, 3))

    def halve(self) -> DepthPicture:
        """Halve the resolution; each new pixel is the mean of those of its four that are on the nearest surface."""
        h, w = (n // 2 * 2 for n in self.depth.shape)
        blocks = self.depth[:h, :w].reshape(h // 2, 2, w // 2, 2).transpose(0, 2, 1, 3).reshape(h // 2, w // 2, 4)
        nearest = np.nanmin(np.where(np.isfinite(blocks), blocks, np.inf), axis=2)[..., None]
        near = np.isfinite(blocks) & (blocks - nearest < JUMP * np.maximum(nearest, 1.0))
        count = near.sum(axis=2)
        mean = np.where(near, blocks, 0).sum(axis=2) / np.maximum(count, 1)
        # new pixel centres lie between old ones: (c - 0.5) / 2 = c / 2 - 0.25
        K = self.intrinsics.copy()
        K[:2] /= 2
        K[:2, 2] -= 0.25
        return DepthPicture(np.where(count > 0, mean, np.nan), K)


def pixels(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return row and column (h, w) of every pixel."""
    row, column = np.indices(shape)
    return np.asarray(row), np.asarray(column)


def is_picture(path: Path) -> bool:
    """Test whether a file name is that of a depth picture."""
    return path.suffix.lower() == ".png"


def is_camera(path: Path) -> bool:
    """Test whether a file name is that of a depth picture's camera."""
    return path.name.lower().endswith(CAMERA)


def camera_file(picture: Path) -> Path:
    """Return the path of the camera file beside a picture."""
    return picture.with_name(picture.stem + CAMERA)


def read_depth(path: str | Path, metres: float = 0.001) -> DepthPicture:
    """Read a depth picture from a 16-bit PNG file.

    The camera is read from `NAME.camera.json` beside it: `{"fx", "fy", "cx", "cy"}` in pixels, or
    `{"intrinsic_matrix": [...]}` column by column, as Open3D writes it.

    Parameters
    ----------
    path : str or Path
        PNG file with one channel of 16 bits, 0 where nothing was measured.
    metres : float
        Length of one unit of the file.

    Returns
    -------
    DepthPicture
        Depth (h, w), metres, and intrinsics (3, 3), pixels.

    Raises
    ------
    ValueError
        Another kind of file, no camera beside it, or depths that cannot be metres.

    Examples
    --------
    >>> from pathlib import Path
    >>> from PIL import Image
    >>> Image.fromarray(np.full((8, 8), 1500, dtype=np.uint16)).save("a.png")
    >>> _ = Path("a.camera.json").write_text('{"fx": 10, "fy": 10, "cx": 3.5, "cy": 3.5}')
    >>> float(read_depth("a.png").depth[0, 0])
    1.5
    """
    path = Path(path)
    values = read_distances(path)
    try:
        return DepthPicture.of(metres * values, read_camera(camera_file(path)))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def read_distances(path: Path) -> np.ndarray:
    """Read distances (h, w) of a PNG file, in its own unit; ValueError for another kind of picture."""
    with open_image(path, "a depth picture in a PNG file", side=LARGEST) as image:
        values = np.array(image)
    if values.ndim != 2 or values.dtype == np.uint8:
        raise ValueError(f"{path}: expected distances, one channel of 16 bits, got {values.dtype} {values.shape}")
    return values


def read_camera(path: Path) -> np.ndarray:
    """Read intrinsics (3, 3), pixels, from a JSON file; ValueError where it is missing or incomplete."""
    if not path.exists():
        raise ValueError(f"expected its camera in {path}, as {{\"fx\": 589, \"fy\": 589, \"cx\": 319.5, "
                         "\"cy\": 239.5}, pixels; there is none")
    try:
        stored = storage.read_json(path, "the camera of a depth picture")
        if "intrinsic_matrix" in stored:
            return np.array(stored["intrinsic_matrix"], dtype=np.float64).reshape(3, 3).T
        fx, fy, cx, cy = (float(stored[name]) for name in ("fx", "fy", "cx", "cy"))
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected fx, fy, cx and cy, or intrinsic_matrix ({error!r})") from None
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
