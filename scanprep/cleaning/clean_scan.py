"""The body out of a raw scan: floor, furniture and specks removed, and an account of every piece."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from ..geometry.places import spacing
from ..geometry.sanitise import sanitise
from ..geometry.sparse import label_components
from ..ranges import Settings
from .floor import Plane, find_plane, floor_points

LARGEST, LANDMARKS, NEAR = "the largest piece", "the piece with the landmarks", "near the body"
MUTUAL, SPARSE = 6, 3.0              # neighbours of a point where points are few, and how far off, in links
FAR, SPECKS, FLOOR = "apart from the body", "specks", "a plane with all on one side"


@dataclass(frozen=True)
class CleanScanConfig(Settings):
    """Settings of `clean_scan`.

    Attributes
    ----------
    gap : float, metres
        Pieces closer than this to the body, or to one that belongs to it, belong to it too: hands and feet that the
        scanner saw apart. Of a coarse scan at least `STEPS` times its spacing.
    min_points : int
        Smaller pieces are specks, wherever they are.
    planes : int
        Most floors and walls that are taken off.
    floor_area : float, square metres
        A plane on which less is measured is no floor; both soles together have about 0.04.
    spacings : float
        Points closer than this many times the median distance between neighbouring places belong together.
    """

    gap: float = 0.03
    min_points: int = 30
    planes: int = 3
    floor_area: float = 0.1
    spacings: float = 3.0


@dataclass(frozen=True)
class Component:
    """One piece of a scan."""

    points: int
    area: float                 # of its triangles, square metres; NaN in a point cloud
    size: tuple[float, ...]     # extent along the axes, metres
    gap: float                  # to the body, metres; 0 for the body itself
    kept: bool
    reason: str                 # why it was kept or dropped


@dataclass(frozen=True, eq=False)
class CleanedScan:
    """A scan after `clean_scan`."""

    scan: Mesh | np.ndarray                 # the body alone, of the same kind as what was given
    kept: np.ndarray                        # (N,) bool, which points of the raw scan are in it
    label: np.ndarray                       # (N,) the row in `components` of every point of the raw scan
    components: tuple[Component, ...]       # planes first, then pieces, largest first, then all specks as one
    floor: Plane | None                     # on which the body stands

    @property
    def mesh(self) -> Mesh:
        """The body as a mesh; without triangles when a point cloud was given."""
        return _as_mesh(self.scan)


def cleaning_doubts(found: CleanedScan) -> list[str]:
    """Why a cleaned scan is to be looked at: a piece that may be a second person was taken for furniture."""
    body = max((max(piece.size) for piece in found.components if piece.kept), default=0.0)
    points = max((piece.points for piece in found.components if piece.kept), default=0)
    # a piece left out that is so large against the body, and has so many of its points, may be a person: a child has
    # half
    second = (0.5, 0.25)
    others = [piece for piece in found.components if piece.reason == FAR
              and max(piece.size) >= second[0] * body and piece.points >= second[1] * points]
    return [f"a piece {max(piece.size):.2f} m large with {piece.points} points was left out: a second person?"
            for piece in others[:1]]


def take_clutter(scan: Mesh | np.ndarray) -> tuple[Mesh | np.ndarray, float]:
    """A scan that nobody looked at, without what is clearly not the body; and the share of its points taken off.

    Where more than `LITTLE` would go, or what may be a second person, nothing does: whoever knows may decide.
    """
    try:
        cleaned = clean_scan(scan)
    except ValueError:                 # nothing would be left
        return scan, 0.0
    removed = 1 - float(cleaned.kept.mean())
    # share of a scan that may be taken off unasked: floor, chair and specks have 0.1
    return (cleaned.scan, removed) if 0 < removed <= 0.2 and not cleaning_doubts(cleaned) else (scan, 0.0)


def clean_scan(scan: Mesh | np.ndarray, config: CleanScanConfig | None = None, landmarks: np.ndarray | None = None,
               rng: np.random.Generator | None = None) -> CleanedScan:
    """Keep the body of a raw scan and drop the floor, walls, furniture and specks.

    A floor is a large plane that has everything else on one side. What lies within its noise belongs to the body
    inside the outline in which the body meets it, and to the floor elsewhere. Of the rest the largest piece is the
    body, with the pieces that nearly touch it.

    Parameters
    ----------
    scan : Mesh or (N, 3) float, metres
        Views may lie side by side.
    config : CleanScanConfig, optional
    landmarks : (L, 3) float, metres, optional
        Points on the body, which then is the piece that most of them are nearest to.
    rng : numpy.random.Generator, optional
        Draws where planes are tried.

    Returns
    -------
    CleanedScan

    Raises
    ------
    ValueError
        A scan without points, or one of which nothing is left.
    """
    config, rng = config or CleanScanConfig(), rng or np.random.default_rng(0)
    scan = sanitise(scan) if isinstance(scan, Mesh) else scan
    mesh = _as_mesh(scan)
    points = mesh.vertices
    if not len(points):
        raise ValueError("scan: expected points, got none")
    step = spacing(points)
    link = max(0.012, config.spacings * step)                       # whether triangles join them or not
    label, planes = _without_planes(mesh, link, config, landmarks, rng)
    rest = np.flatnonzero(label < 0)
    if not len(rest):
        raise ValueError("scan: nothing is left when planes are taken off; expected a body in front of them")
    piece = label_pieces(mesh, rest, link)
    main, why = _body_of(points[rest], piece, config, landmarks)
    # All specks together are one row: a scanned floor leaves hundreds.
    size = np.bincount(piece)
    large = np.flatnonzero((size >= config.min_points) | (np.arange(len(size)) == main))
    row_of = np.full(len(size), len(large))
    row_of[large] = np.arange(len(large))
    label[rest] = len(planes) + row_of[piece]
    body = cKDTree(points[rest[piece == main]])
    # spacings between the steps of a depth camera on a surface that it sees slantwise
    near = _near_pieces([points[rest[piece == number]] for number in large], int(np.flatnonzero(large == main)[0]),
                        max(config.gap, 5.0 * step))
    rows = []
    for number in range(int(label.max()) + 1):
        mine = label == number
        old = number - len(planes) if len(planes) <= number < len(planes) + len(large) else None
        reason = (FLOOR if number < len(planes) else SPECKS if old is None else why if large[old] == main
                  else NEAR if near[old] else FAR)
        gap = 0.0 if reason == why else _gap(body, points[mine])
        rows.append(_component(mesh, mine, gap, reason in (why, NEAR), reason))
    kept = np.array([row.kept for row in rows])[label]
    floor = next((p for p in planes if p.height(body.data).min() <= config.gap), None)
    return CleanedScan(_only(scan, kept), kept, label, tuple(rows), floor)


def _as_mesh(scan: Mesh | np.ndarray) -> Mesh:
    return scan if isinstance(scan, Mesh) else Mesh(scan, np.zeros((0, 3), dtype=np.int64))


def _without_planes(mesh: Mesh, link: float, config: CleanScanConfig, landmarks: np.ndarray | None,
                    rng: np.random.Generator) -> tuple[np.ndarray, list[Plane]]:
    """The number of the plane that each vertex (N,) lies on, -1 for none, and the planes."""
    points, planes = mesh.vertices, list[Plane]()
    label = np.full(len(points), -1)
    while len(planes) < config.planes and (label < 0).sum() > config.min_points:
        rest = np.flatnonzero(label < 0)
        plane = find_plane(points[rest], config.floor_area, rng)
        if plane is None:
            break
        standing = rest[plane.height(points[rest]) > plane.thickness]
        piece = label_pieces(mesh, standing, link)
        body = standing[piece == _body_of(points[standing], piece, config, landmarks)[0]] if len(standing) else standing
        label[rest[floor_points(points[rest], plane, points[body])]] = len(planes)
        planes.append(plane)
    return label, planes


def label_pieces(mesh: Mesh, chosen: np.ndarray, link: float) -> np.ndarray:
    """Number of the piece that each of the chosen vertices (n,) belongs to, largest piece 0.

    Vertices hang together when a side of a triangle joins them or when they are closer than about `link` metres.
    """
    points = mesh.vertices[chosen]
    new = np.full(len(mesh.vertices), -1)
    new[chosen] = np.arange(len(chosen))
    sides = new[np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])]
    sides = sides[(sides >= 0).all(axis=1)]
    # One point of every small cell stands for all of it, so that dense scans do not take long.
    place = np.floor((points - points.min(axis=0, initial=np.inf)) / (link / 2)).astype(np.int64)
    _, first, cell = np.unique(place, axis=0, return_index=True, return_inverse=True)
    near = np.concatenate([cKDTree(points[first]).query_pairs(link, output_type="ndarray"),
                           _sparse_links(points[first], link, SPARSE * link)])
    a = np.concatenate([sides[:, 0], first[near[:, 0]], np.arange(len(points))])
    b = np.concatenate([sides[:, 1], first[near[:, 1]], first[cell.reshape(-1)]])
    label = label_components(a, b, len(points))
    size = np.bincount(label[first])                    # by cells, not by points, which crowd near the scanner
    rank = np.argsort(np.argsort(-size, kind="stable"), kind="stable")
    return np.asarray(rank[label])


def _sparse_links(points: np.ndarray, link: float, longest: float) -> np.ndarray:
    """Pairs (n, 2) of points farther apart than `link` and up to `longest` metres that are among each other's nearest.

    Only where points are few: with less than `MUTUAL` others within a link, which do not count among the nearest. The
    pairs join a side that was seen from afar, or by one view where others overlap, to itself; two surfaces hardly.
    """
    if len(points) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    apart, near = cKDTree(points).query(points, min(2 * MUTUAL, len(points)), distance_upper_bound=longest)
    far = (apart > link) & (near < len(points)) & ((apart <= link).sum(axis=1, keepdims=True) <= MUTUAL)   # with itself
    far &= np.cumsum(far, axis=1) <= MUTUAL
    a, b = np.nonzero(far)[0], near[far]
    return np.stack([a, b], axis=1)[np.isin(a * len(points) + b, b * len(points) + a)]


def _body_of(points: np.ndarray, piece: np.ndarray, config: CleanScanConfig, landmarks: np.ndarray | None
             ) -> tuple[int, str]:
    """The piece that is the body, and why."""
    if landmarks is None:
        return 0, LARGEST
    large = np.bincount(piece)[piece] >= config.min_points
    if not large.any():
        large = np.ones(len(piece), dtype=bool)
    found = piece[large][cKDTree(points[large]).query(np.reshape(landmarks, (-1, 3)))[1]]
    return int(np.bincount(found).argmax()), LANDMARKS


def _near_pieces(clouds: list[np.ndarray], main: int, gap: float) -> np.ndarray:
    """(n,) bool: pieces (m, 3) that a chain of pieces, each within `gap` metres of the next, joins to the main one."""
    near = np.arange(len(clouds)) == main
    last = near.copy()
    while last.any():
        tree = cKDTree(np.concatenate([clouds[i] for i in np.flatnonzero(last)]))
        last = np.array([not seen and _gap(tree, cloud) <= gap for seen, cloud in zip(near, clouds, strict=True)])
        near |= last
    return near


def _gap(body: cKDTree, points: np.ndarray) -> float:
    """The least distance; a few points first, because far queries take long without a bound."""
    bound = float(body.query(points[::max(len(points) // 300, 1)])[0].min())
    return min(bound, float(body.query(points, distance_upper_bound=bound + 1e-12)[0].min()))


def _component(mesh: Mesh, mine: np.ndarray, gap: float, kept: bool, reason: str) -> Component:
    points = mesh.vertices[mine]
    area = float(mesh.face_areas[mine[mesh.faces].all(axis=1)].sum()) if len(mesh.faces) else float("nan")
    size = tuple(np.ptp(points, axis=0).tolist()) if len(points) else (0.0, 0.0, 0.0)
    return Component(len(points), area, size, gap, kept, reason)


def _only(scan: Mesh | np.ndarray, kept: np.ndarray) -> Mesh | np.ndarray:
    if not isinstance(scan, Mesh):
        return np.asarray(scan)[kept]
    if not len(scan.faces):
        return Mesh(scan.vertices[kept], scan.faces, None if scan.colors is None else scan.colors[kept])
    return scan.submesh(kept[scan.faces].all(axis=1))[0]
