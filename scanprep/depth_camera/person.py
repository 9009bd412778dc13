"""Segment the person in a depth picture: remove floor and walls, and require exactly one person."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from ..geometry.sparse import label_components
from .picture import JUMP, NOISE, SMOOTHED, DepthPicture

# Lengths are in body sizes, the root of its surface area (1.36 m for a man); areas in squares of it.
LEAST_AREA, LEAST_RADIUS = 0.075, 0.08  # visible area, and radius of the largest circle in it; a leg has less
THICK, SIGMAS, PARALLEL = 0.012, 3.0, 0.9    # on a plane: metres, plus noise deviations, and cosine of normals


@dataclass(frozen=True, eq=False)
class PicturedPerson:
    """A person in a depth picture.

    Attributes
    ----------
    picture : DepthPicture
        The whole picture, without flying pixels.
    mask : (h, w) bool
        Pixels of the person.
    """

    picture: DepthPicture
    mask: np.ndarray

    def alone(self) -> DepthPicture:
        """Return the picture with only the person's pixels."""
        return replace(self.picture, depth=np.where(self.mask, self.picture.depth, np.nan))

    def points_and_normals(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return points (n, 3), metres, normals (n, 3) towards the camera, and which points (n,) are at an edge.

        Pixels near a jump in depth are left out, as neither they nor their normals are reliable.
        """
        alone, reach = self.alone(), np.ones((2 * SMOOTHED + 1,) * 2)
        points, normals = alone.points(), alone.normals()
        smooth = ndimage.binary_erosion(_one_surface(alone) | ~self.mask, reach, border_value=1)
        valid = self.mask & smooth & np.isfinite(normals).all(axis=2)
        edge = ~ndimage.binary_erosion(valid, np.ones((3, 3)), border_value=0)
        return points[valid], normals[valid], edge[valid]


def segment_person(picture: DepthPicture, size: float, marks: np.ndarray | None = None) -> PicturedPerson:
    """Find the one person in a picture, at half its resolution; ValueError with the reason if there is not exactly one.

    `size`, metres, is the root of the body's surface area. `marks` (L, 3), metres, are points on the person.
    """
    # remove planes of the room; of the other pieces, people are large and thick enough
    small = picture.without_flying_pixels().halve()
    pieces = _pieces(small, small.seen & ~room_planes(small, size), size)
    shown = [_area_and_radius(small, mask, size) for mask in pieces]
    people = [mask for mask, (area, radius) in zip(pieces, shown, strict=True)
              if area >= LEAST_AREA and radius >= LEAST_RADIUS]
    if not people:
        raise ValueError(f"picture: {_nobody(shown, size)}")
    if marks is not None and len(marks):
        people = [min(people, key=lambda mask: np.median(cKDTree(small.points()[mask]).query(marks)[0]))]
    if len(people) > 1:
        raise ValueError(f"picture: {len(people)} people, or things as large, are in it; one is expected: set the "
                         "depth of all else to 0, or give landmarks on the person")
    # smaller pieces within 0.15 sizes (20 cm) belong to the person, such as an arm behind the body
    points, mask = small.points(), people[0].copy()
    tree = cKDTree(points[people[0]][::3])
    for piece in pieces:
        if piece is not people[0] and tree.query(points[piece][::3])[0].min() < 0.15 * size:
            mask |= piece
    area = _area_and_radius(small, mask, size)[0]
    # one person shows at most half of the body; two people who touch show more
    if area > 0.5:
        raise ValueError(f"picture: what stands in it shows {area * size**2:.1f} m², more than a person does: two "
                         "people who touch, or a wall that was not recognised; set the depth of all else to 0")
    return PicturedPerson(small, mask)


def room_planes(picture: DepthPicture, size: float) -> np.ndarray:
    """Find pixels (h, w) bool on planes too large and flat for a body: floor, walls, doors, tables.

    `size`, metres, of the body.
    """
    points, normals = picture.points(), picture.normals()
    open_, rng = picture.seen & np.isfinite(normals).all(axis=2), np.random.default_rng(0)
    removed = np.zeros(open_.shape, dtype=bool)
    # at most eight planes, each by RANSAC over tangent planes
    for _ in range(8):
        p, n = points[open_], normals[open_]
        if len(p) < 100:
            break
        sample = rng.choice(len(p), min(4000, len(p)), replace=False)
        area = _areas(picture, p[sample], n[sample]) * len(p) / len(sample)
        guesses = [(area[_on(p[sample], n[sample], n[i], n[i] @ p[i])].sum(), i)
                   for i in rng.choice(len(p), min(300, len(p)), replace=False)]
        _, best = max(guesses)
        normal, offset = n[best], n[best] @ p[best]
        for _ in range(3):
            on_plane = _on(p, n, normal, offset)
            if on_plane.sum() < 100:
                break
            centre = p[on_plane].mean(axis=0)
            normal = np.linalg.eigh(np.cov(p[on_plane].T))[1][:, 0]
            normal = normal * np.sign(-normal @ centre)
            offset = normal @ centre
        on_plane = _on(p, n, normal, offset)
        behind = np.mean(points[picture.seen] @ normal - offset < -2 * _thickness(points[picture.seen]))
        # a plane with something behind it must be larger, 0.6 size², than two backs; floors and walls 0.2 size²
        if _areas(picture, p[on_plane], n[on_plane]).sum() < (0.6 if behind > 0.02 else 0.2) * size**2:
            break
        removed[picture.seen] |= np.abs(points[picture.seen] @ normal - offset) < _thickness(points[picture.seen])
        open_ &= ~removed
    return removed


def _thickness(points: np.ndarray) -> np.ndarray:
    """Return the distance (n,), metres, within which points are on a plane; noise grows with depth squared."""
    return THICK + SIGMAS * NOISE * points[..., 2]**2


def _on(p: np.ndarray, n: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray:
    """Test which points (n,) with normals lie on a plane and face the same way."""
    return (np.abs(p @ normal - offset) < _thickness(p)) & (n @ normal > PARALLEL)


def _areas(picture: DepthPicture, p: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Compute the surface area (n,), square metres, that each pixel shows; grazing pixels are capped."""
    slope = np.abs(np.einsum("nd,nd->n", n, p)) / np.linalg.norm(p, axis=1)
    return p[:, 2]**2 / (picture.intrinsics[0, 0] * picture.intrinsics[1, 1]) / np.maximum(slope, 0.15)


def _one_surface(picture: DepthPicture) -> np.ndarray:
    """Find pixels (h, w) bool whose measured neighbours are all on the same surface."""
    filled = np.where(picture.seen, picture.depth, np.inf)
    low = ndimage.minimum_filter(filled, 3)
    high = ndimage.maximum_filter(np.where(picture.seen, picture.depth, -np.inf), 3)
    return picture.seen & (high - low < 2 * picture.jump())


def _pieces(picture: DepthPicture, mask: np.ndarray, size: float) -> list[np.ndarray]:
    """Find the masks (h, w) of pieces connected in space, largest first."""
    # neighbouring pixels are linked if their depths differ by less than 1.5 jumps
    across, down = (np.abs(np.diff(picture.depth, axis=a)) < 1.5 * JUMP * np.maximum(
        np.nan_to_num(picture.depth[:, 1:] if a else picture.depth[1:]), 1) for a in (1, 0))
    number = _label_pieces(mask, across, down)
    count = np.bincount(number[mask])
    area = np.bincount(number[mask], weights=picture.depth[mask]**2) / np.prod(np.diag(picture.intrinsics)[:2])
    # smaller pieces are noise: 0.3% of the size squared, 55 cm² on a man
    kept = [i for i in np.argsort(-area) if area[i] > 0.003 * size**2 and count[i] > 20]
    points = picture.points()
    pieces = [number == i for i in kept]
    trees = [cKDTree(points[piece & mask][::3]) for piece in pieces]
    group = list(range(len(kept)))
    apart = 0.08  # sizes (11 cm): closer pieces are one, such as an arm in front of the body
    for i in range(len(kept)):
        for j in range(i):
            if group[i] != group[j] and trees[i].query(trees[j].data, distance_upper_bound=apart * size)[0].min() \
                    < apart * size:
                group = [group[j] if g == group[i] else g for g in group]
    merged = [np.any([pieces[i] for i in range(len(kept)) if group[i] == g], axis=0) & mask for g in sorted(set(group))]
    return sorted(merged, key=lambda piece: -float((picture.depth[piece]**2).sum()))


def _label_pieces(mask: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Number the connected pieces (h, w) of a mask, linked `across` (h, w - 1) and `down` (h - 1, w)."""
    index = np.arange(mask.size).reshape(mask.shape)
    right, below = across & mask[:, 1:] & mask[:, :-1], down & mask[1:] & mask[:-1]
    a = np.concatenate([index[:, :-1][right], index[:-1][below]])
    b = np.concatenate([index[:, 1:][right], index[1:][below]])
    return label_components(a, b, mask.size).reshape(mask.shape)


def _area_and_radius(picture: DepthPicture, mask: np.ndarray, size: float) -> tuple[float, float]:
    """Return the area of a piece and the radius of its largest circle, in sizes; it may extend beyond the picture."""
    z = np.where(mask, np.nan_to_num(picture.depth), 0.0)
    fx, fy = np.diag(picture.intrinsics)[:2]
    # close small gaps; pad by repetition, so that the border of the picture is no edge
    closed = ndimage.binary_closing(np.pad(mask, 2, mode="edge"), np.ones((3, 3)), iterations=2)
    reach = ndimage.distance_transform_edt(np.pad(closed, max(mask.shape), mode="edge"))
    cut = max(mask.shape) + 2
    radius = (reach[cut:-cut, cut:-cut] * z / np.sqrt(fx * fy)).max()
    return float((z**2).sum() / (fx * fy)) / size**2, float(radius) / size


def _nobody(shown: list[tuple[float, float]], size: float) -> str:
    """Explain why the picture has no person."""
    if not shown:
        return "nobody is in it: nothing stands in front of floor and walls"
    area, radius = max(shown)
    return (f"only a part of a body is in it, or nobody: the largest thing in front of floor and walls shows "
            f"{area * size**2:.2f} m² and is {2 * radius * size:.2f} m thick, a person from hips to head more than "
            f"{LEAST_AREA * size**2:.2f} m² and {2 * LEAST_RADIUS * size:.2f} m")
