"""Clean a raw scan: keep the body, remove floor, furniture and specks, and report every piece."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh, select_points, take_any_mesh
from ..geometry.places import spacing
from ..geometry.sanitise import sanitise
from ..geometry.sparse import label_components
from ..judgement import Judgement
from ..ranges import FLAG, Axis, Settings, direction_of
from .floor import Plane, find_plane, floor_points

LARGEST, LANDMARKS, NEAR = "the largest piece", "the piece with the landmarks", "near the body"
MUTUAL, SPARSE = 6, 3.0              # neighbours linked in sparse regions, and their largest distance in links
SPECK = 30                           # pieces with fewer points are specks: a scanned floor leaves hundreds
LINKED = 3.0                         # points closer than so many median spacings are linked, across lost rays
FLAT = 0.02                          # share of the points that a plane has which stays; both soles have 0.01
FAR, SPECKS, FLOOR = "apart from the body", "specks", "a plane with all on one side, and what is below it"


@dataclass(frozen=True)
class CleanScanConfig(Settings):
    """Settings of `clean_scan`.

    Attributes
    ----------
    gap : float, metres
        Pieces closer than this to the body, or to a piece that belongs to it, belong to it: hands and feet that the
        scanner saw separately. In a coarse scan at least five times its spacing.
    planes : int
        Largest number of floors and walls that are removed.
    floor_area : float, square metres
        A plane with less measured area is no floor; both soles together have about 0.04.
    up : 'x', '-x', 'y', '-y', 'z' or '-z', optional
        The axis of the scan that points up, where it is known: then only floors are taken off, and no walls.

    Examples
    --------
    >>> CleanScanConfig(planes=1).gap
    0.03
    """

    gap: float = 0.03
    planes: int = 3
    floor_area: float = 0.1
    up: Annotated[Axis | None, FLAG] = None


@dataclass(frozen=True)
class Component:
    """One piece of a scan."""

    points: int
    size: tuple[float, ...]     # extent along the axes, metres
    kept: bool
    reason: str                 # why it was kept or dropped


@dataclass(frozen=True, eq=False)
class CleanedScan:
    """The result of `clean_scan`."""

    scan: Mesh | np.ndarray                 # the body alone; a mesh or points, as the input
    kept: np.ndarray                        # (N,) bool: points of the raw scan that are kept
    label: np.ndarray                       # (N,) the index in `components` of every point of the raw scan
    components: tuple[Component, ...]       # planes, then pieces, largest first, then all specks together
    floor: Plane | None                     # on which the body stands
    flat: bool = False                      # a large plane was kept, as it is part of the largest piece

    @property
    def mesh(self) -> Mesh:
        """The body as a mesh; without triangles if the input was a point cloud."""
        return _as_mesh(self.scan)

    @property
    def judgement(self) -> Judgement:
        """Whether the body is alone now: "check" where a pedestal may be left, or a second person was dropped."""
        return Judgement.of(check=cleaning_doubts(self))


def cleaning_doubts(found: CleanedScan) -> list[str]:
    """Explain why a cleaned scan needs a look: a pedestal may be left, and a dropped piece may be a second person."""
    return second_person(found) + (["a large flat face was kept: a pedestal or furniture that touches the person?"]
                                   if found.flat else [])


def second_person(found: CleanedScan) -> list[str]:
    """Name a dropped piece that may be a second person."""
    body = max((max(piece.size) for piece in found.components if piece.kept), default=0.0)
    points = max((piece.points for piece in found.components if piece.kept), default=0)
    # a dropped piece with half of the body's extent, as a child has, and a quarter of its points may be a person
    second = (0.5, 0.25)
    others = [piece for piece in found.components if piece.reason == FAR
              and max(piece.size) >= second[0] * body and piece.points >= second[1] * points]
    return [f"a piece {max(piece.size):.2f} m large with {piece.points} points was left out: a second person?"
            for piece in others[:1]]


def take_clutter(scan: Mesh | np.ndarray) -> tuple[Mesh | np.ndarray, float]:
    """Remove clear clutter from a scan without supervision; return the scan and the removed share of its points.

    Nothing is removed if more than 20% would go, or if it may be a second person. The user should decide then.
    """
    try:
        # a piece within 45 cm is no clear clutter: where one camera did not see the upper arm, forearms and hands were
        # 32 to 38 cm from all else
        cleaned = clean_scan(scan, CleanScanConfig(gap=0.45))
    except ValueError:                 # nothing would be left
        return scan, 0.0
    removed = 1 - float(cleaned.kept.mean())
    # floor, chair and specks have about 0.1 of the points
    return (cleaned.scan, removed) if 0 < removed <= 0.2 and not second_person(cleaned) else (scan, 0.0)


@take_any_mesh
def clean_scan(scan: Mesh | np.ndarray, config: CleanScanConfig | None = None, landmarks: np.ndarray | None = None
               ) -> CleanedScan:
    """Keep the body of a raw scan and drop the floor, walls, furniture and specks.

    A floor is a large plane with everything else on one side. Points within its noise belong to the body inside the
    body's footprint, else to the floor. Of the rest the largest piece is the body, with the pieces that nearly touch
    it.

    Parameters
    ----------
    scan : Mesh or (N, 3) float, metres
        The raw scan; it may consist of several views.
    config : CleanScanConfig, optional
        Settings.
    landmarks : (L, 3) float, metres, optional
        Points on the body, to choose its piece; by default the largest piece is the body.

    Returns
    -------
    CleanedScan
        The body, which points (N,) were kept, and every piece with the reason.

    Raises
    ------
    ValueError
        A scan without points, or one of which nothing is left.

    Examples
    --------
    >>> body = np.random.default_rng(0).normal(size=(3000, 3)) * [0.05, 0.05, 0.2]
    >>> cleaned = clean_scan(np.vstack([body, [[3.0, 0.0, 0.0]]]))
    >>> bool(cleaned.kept[-1])
    False
    """
    config, rng = config or CleanScanConfig(), np.random.default_rng(0)
    scan = sanitise(scan) if isinstance(scan, Mesh) else scan
    mesh = _as_mesh(scan)
    points = mesh.vertices
    if not len(points):
        raise ValueError("scan: expected points, got none")
    step = spacing(points)
    link = max(0.012, LINKED * step)                       # at least 12 mm, about the spacing of a coarse scan
    # planes first; then the pieces of the rest, and which of them is the body
    label, planes, flat = _without_planes(mesh, link, config, landmarks, rng)
    rest = np.flatnonzero(label < 0)
    if not len(rest):
        raise ValueError("scan: nothing is left when planes are taken off; expected a body in front of them")
    piece = label_pieces(mesh, rest, link)
    main, why = _body_of(points[rest], piece, landmarks)
    # report all specks in one row: a scanned floor leaves hundreds
    size = np.bincount(piece)
    large = np.flatnonzero((size >= SPECK) | (np.arange(len(size)) == main))
    row_of = np.full(len(size), len(large))
    row_of[large] = np.arange(len(large))
    label[rest] = len(planes) + row_of[piece]
    # five spacings: steps of a depth camera on an oblique surface
    near = _near_pieces([points[rest[piece == number]] for number in large], int(np.flatnonzero(large == main)[0]),
                        max(config.gap, 5.0 * step))
    # one row per plane, per piece, and for all specks: reason, kept or not
    rows = []
    for number in range(int(label.max()) + 1):
        own = label == number
        old = number - len(planes) if len(planes) <= number < len(planes) + len(large) else None
        reason = (FLOOR if number < len(planes) else SPECKS if old is None else why if large[old] == main
                  else NEAR if near[old] else FAR)
        extent = tuple(np.ptp(points[own], axis=0).tolist()) if own.any() else (0.0, 0.0, 0.0)
        rows.append(Component(int(own.sum()), extent, reason in (why, NEAR), reason))
    kept = np.array([row.kept for row in rows])[label]
    floor = next((p for p in planes if p.height(points[rest[piece == main]]).min() <= config.gap), None)
    return CleanedScan(select_points(scan, kept), kept, label, tuple(rows), floor, flat)


def _as_mesh(scan: Mesh | np.ndarray) -> Mesh:
    """Return a scan as a mesh; points get no triangles."""
    return scan if isinstance(scan, Mesh) else Mesh(scan, np.zeros((0, 3), dtype=np.int64))


def _without_planes(mesh: Mesh, link: float, config: CleanScanConfig, landmarks: np.ndarray | None,
                    rng: np.random.Generator) -> tuple[np.ndarray, list[Plane], bool]:
    """Find floors and walls: the number of the plane of each vertex (N,), -1 for none, and the planes.

    Also tell whether there is a plane that was kept: one inside the footprint of the body, as the side of a pedestal.
    """
    points, planes, kept, own = mesh.vertices, list[Plane](), list[Plane](), list[Plane]()
    label = np.full(len(points), -1)
    most = 2 * config.planes        # of those that stay: a box-shaped head has six
    while len(planes) < config.planes and len(kept) + len(own) <= most and (label < 0).sum() > SPECK:
        rest = np.flatnonzero(label < 0)
        plane = find_plane(points[rest], config.floor_area, rng,
                           None if config.up is None else np.array(direction_of(config.up)), [*kept, *own])
        if plane is None:
            break
        # the body stands on the plane; its footprint is not removed
        standing = rest[plane.height(points[rest]) > plane.thickness]
        piece = label_pieces(mesh, standing, link)
        body = standing[piece == _body_of(points[standing], piece, landmarks)[0]] if len(standing) else standing
        off = rest[floor_points(points[rest], plane, points[body])]
        if _is_face_of_body(mesh, off):
            own.append(plane)
            continue
        (planes if len(off) else kept).append(plane)
        label[off] = len(planes) - 1
    # what is left of a pedestal went with its top
    left = points[label < 0]
    flat = any(np.mean(np.abs(plane.height(left)) <= plane.thickness) > FLAT for plane in kept)
    return label, planes, flat


def _is_face_of_body(mesh: Mesh, off: np.ndarray) -> bool:
    """Test whether points (n,) on a plane are a flat face of the body, as a sole or the side of a box-shaped head.

    Such a face goes on into the body all around. A floor and a pedestal touch it at the feet only, and floors end.
    """
    chosen = np.zeros(len(mesh.vertices), dtype=bool)
    chosen[off] = True
    inside = chosen[mesh.faces].all(axis=1)
    within = np.bincount(mesh.face_edges[inside].ravel(), minlength=len(mesh.edges))
    rim, ends = (float(mesh.edge_lengths[(within == 1) & shared].sum())
                 for shared in (mesh.edge_use > 1, mesh.edge_use == 1))
    # length of the rim in roots of its area: a square has 4, soles 4 to 6, the front of a box-shaped head 2.7, floors
    # and pedestals under people 0.3 to 1.7
    return rim > 2.2 * float(np.sqrt(mesh.face_areas[inside].sum())) and ends < 0.25 * rim


def label_pieces(mesh: Mesh, chosen: np.ndarray, link: float) -> np.ndarray:
    """Number the connected pieces of the chosen vertices (n,), largest piece 0.

    Vertices are linked by sides of triangles, or if they are closer than about `link` metres.
    """
    points = mesh.vertices[chosen]
    new = np.full(len(mesh.vertices), -1)
    new[chosen] = np.arange(len(chosen))
    sides = new[np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]])]
    sides = sides[(sides >= 0).all(axis=1)]
    # one point per small cell represents it, so that dense scans are fast
    place = np.floor((points - points.min(axis=0, initial=np.inf)) / (link / 2)).astype(np.int64)
    _, first, cell = np.unique(place, axis=0, return_index=True, return_inverse=True)
    near = np.concatenate([cKDTree(points[first]).query_pairs(link, output_type="ndarray"),
                           _sparse_links(points[first], link, SPARSE * link)])
    a = np.concatenate([sides[:, 0], first[near[:, 0]], np.arange(len(points))])
    b = np.concatenate([sides[:, 1], first[near[:, 1]], first[cell.reshape(-1)]])
    label = label_components(a, b, len(points))
    size = np.bincount(label[first])                    # in cells, as points are denser near the scanner
    rank = np.argsort(np.argsort(-size, kind="stable"), kind="stable")
    return np.asarray(rank[label])


def _sparse_links(points: np.ndarray, link: float, longest: float) -> np.ndarray:
    """Find pairs (n, 2) of mutual nearest neighbours in sparse regions, `link` to `longest` metres apart.

    A region is sparse if a point has less than `MUTUAL` others within a link. The pairs connect surface that was seen
    from afar, or by one view only. They hardly ever connect two surfaces.
    """
    if len(points) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    apart, near = cKDTree(points).query(points, min(2 * MUTUAL, len(points)), distance_upper_bound=longest)
    far = (apart > link) & (near < len(points)) & ((apart <= link).sum(axis=1, keepdims=True) <= MUTUAL)  # incl. itself
    far &= np.cumsum(far, axis=1) <= MUTUAL
    a, b = np.nonzero(far)[0], near[far]
    return np.stack([a, b], axis=1)[np.isin(a * len(points) + b, b * len(points) + a)]


def _body_of(points: np.ndarray, piece: np.ndarray, landmarks: np.ndarray | None) -> tuple[int, str]:
    """Choose the piece that is the body, and say why: by landmarks, else the largest."""
    if landmarks is None:
        return 0, LARGEST
    large = np.bincount(piece)[piece] >= SPECK
    if not large.any():
        large = np.ones(len(piece), dtype=bool)
    marked = piece[large][cKDTree(points[large]).query(np.reshape(landmarks, (-1, 3)))[1]]
    return int(np.bincount(marked).argmax()), LANDMARKS


def _near_pieces(clouds: list[np.ndarray], main: int, gap: float) -> np.ndarray:
    """Find pieces (n,) bool, each (m, 3), connected to the main one by a chain of gaps of at most `gap` metres."""
    near = np.arange(len(clouds)) == main
    last = near.copy()
    while last.any():
        tree = cKDTree(np.concatenate([clouds[i] for i in np.flatnonzero(last)]))
        last = np.array([not seen and _gap(tree, cloud) <= gap for seen, cloud in zip(near, clouds, strict=True)])
        near |= last
    return near


def _gap(body: cKDTree, points: np.ndarray) -> float:
    """Return the smallest distance; some points first, because distant queries are slow without a bound."""
    bound = float(body.query(points[::max(len(points) // 300, 1)])[0].min())
    return min(bound, float(body.query(points, distance_upper_bound=bound + 1e-12)[0].min()))
