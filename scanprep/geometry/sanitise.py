"""Clean the triangles of a scan: drop degenerate and duplicate ones, and orient them outward.

Only triangles change. Vertices keep their order, because masks, colours and landmark files refer to their numbers.
"""
from __future__ import annotations

import itertools
import warnings

import numpy as np
from scipy.spatial import cKDTree

from ..threads import search_threads
from ..words import number_of
from .mesh import Mesh
from .places import distinct_rows
from .sparse import label_components
from .surface import Rays

SAMPLES = 400            # triangles per patch that cast rays to the front and the back; enough for a clear vote


def sanitise(scan: Mesh, name: str = "scan") -> Mesh:
    """Drop bad triangles, and orient the others outward.

    Degenerate triangles, duplicates and flaps (a triangle and its reverse on an edge of their own) are dropped. Of a
    two-sided surface one side stays. Neighbours are oriented alike. Each patch faces the side where less of the scan
    occludes it, so an open shell is seen from outside.

    Parameters
    ----------
    scan : Mesh
        In any unit.
    name : str
        Name of the scan in the warning: its file, or the argument.

    Returns
    -------
    Mesh
        The same object if nothing was wrong. A UserWarning says in one line what was dropped and inverted.

    Examples
    --------
    >>> from scanprep.synthetic.people import SyntheticPerson
    >>> body = SyntheticPerson().mesh
    >>> sanitise(body) is body
    True
    """
    if not len(scan.faces):
        return scan
    place = distinct_rows(scan.vertices)
    one_place = scan if place is None else Mesh(scan.vertices, place[scan.faces])
    keep, notes = _surface_triangles(one_place)
    if not keep.any():
        return scan                          # only degenerate triangles: callers that need a surface raise
    kept = one_place if keep.all() else Mesh(scan.vertices, one_place.faces[keep])
    invert, patch = invert_against_neighbours(kept)
    invert ^= _inside_out(Mesh(kept.vertices, invert_triangles(kept.faces, invert)) if invert.any() else kept, patch)
    if invert.any():
        notes.append("all triangles faced inward and were turned" if invert.all() else
                     f"{invert.sum()} of {len(invert)} triangles faced inward and were turned")
    if not notes:
        return scan
    warnings.warn(f"{name}: {'; '.join(notes)}", stacklevel=2)
    return Mesh(scan.vertices, invert_triangles(scan.faces[keep], invert), scan.colors, scan.of_file)


def invert_triangles(faces: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Invert some triangles, (F,) bool, of (F, 3); their first corner stays."""
    return np.where(which[:, None], faces[:, [0, 2, 1]], faces)


def _surface_triangles(mesh: Mesh) -> tuple[np.ndarray, list[str]]:
    """Find triangles (F,) bool that are surface, and describe the others in words."""
    sides = mesh.corners - np.roll(mesh.corners, -1, axis=1)
    longest = np.einsum("fsd,fsd->fs", sides, sides).max(axis=1)
    # area over squared longest side: flatter triangles have no normal in float32 files
    flat = mesh.face_areas <= 1e-9 * longest
    notes = [f"{number_of(flat.sum(), 'triangle')} without area dropped"] if flat.any() else []
    group = distinct_rows(np.sort(mesh.faces, axis=1))
    if group is None:
        return ~flat, notes
    # of equal triangles the first stays; a reversed one makes its group two-sided
    a, b, c = mesh.faces.T
    odd = (a > b) ^ (b > c) ^ (a > c)
    keep = ~flat & (group == np.arange(len(group)))
    repeated = ~flat & ~keep
    two_sided = np.zeros(len(keep), dtype=bool)
    two_sided[group[repeated & (odd != odd[group])]] = True
    # a flap is attached at one vertex only, or at an edge that two other triangles share
    rest = Mesh(mesh.vertices, mesh.faces[keep])
    use = rest.edge_use[rest.face_edges]
    flap = np.zeros(len(keep), dtype=bool)
    flap[keep] = two_sided[keep] & ((use > 2).any(axis=1) | (use == 1).all(axis=1))
    reverse = repeated & (odd != odd[group])
    for one, what, which in (
            ("repeated triangle", "dropped", repeated & ~reverse),
            ("triangle", "of two-sided surfaces dropped, one of each pair", reverse & ~flap[group]),
            ("flap", "dropped, a triangle and its reverse each", flap)):
        if which.any():
            notes.append(f"{number_of(which.sum(), one)} {what}")
    return keep & ~flap, notes


def invert_against_neighbours(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Find triangles (F,) bool to invert so that neighbours face the same way, and the patch (F,) of each.

    In every patch most of the area stays as it is. Patches end at edges with more than two triangles. A one-sided
    patch, such as a Möbius strip, stays as it is.
    """
    count = len(mesh.faces)
    first, second = mesh.side_pairs.T
    a, b = first // 3, second // 3
    if mesh.is_edge_manifold:
        return np.zeros(count, dtype=bool), label_components(a, b, count)
    forward = (mesh.faces < np.roll(mesh.faces, -1, axis=1)).ravel()
    agree = forward[first] != forward[second]
    # graph with two nodes per triangle, as it is and inverted; links join nodes with the same orientation
    rows, columns = np.r_[a, a + count], np.r_[np.where(agree, b, b + count), np.where(agree, b + count, b)]
    patch = label_components(rows, columns, 2 * count)
    as_is, turned = patch[:count], patch[count:]
    area = np.bincount(as_is, mesh.face_areas, patch.max() + 1)     # of what a patch leaves as it is
    invert = area[turned] > area[as_is]
    invert |= (area[turned] == area[as_is]) & (turned < as_is)
    return invert, np.unique(np.minimum(as_is, turned), return_inverse=True)[1].reshape(-1)


def _inside_out(mesh: Mesh, patch: np.ndarray) -> np.ndarray:
    """Find triangles (F,) bool of patches (F,) whose front is occluded by the scan more often than their back.

    Rays from a body, or from a shell of one, to the outside leave; rays to the inside meet the far side.
    """
    rng = np.random.default_rng(0)
    # sample triangles of every patch at random; votes are weighted by area
    order = rng.permutation(len(patch))
    order = order[np.argsort(patch[order], kind="stable")]
    size = np.bincount(patch)
    rank = np.arange(len(order)) - np.repeat(np.cumsum(size) - size, size)
    # four rays per triangle, to either side
    sample = np.repeat(order[rank < SAMPLES], 4)
    # rays reach 15% of the diagonal: through a trunk, but not across a room
    around, reach = _directions(mesh.face_normals[sample], rng), 0.15 * float(np.linalg.norm(np.ptp(
        mesh.vertices, axis=0)))
    start, off = mesh.corners[sample].mean(axis=1), 1e-4 * reach * mesh.face_normals[sample]
    rays = Rays(mesh)
    vote = rays.test_occlusion(start + off, around, reach).astype(float) - rays.test_occlusion(start - off, -around,
                                                                                               reach)
    vote *= mesh.face_areas[sample]
    # compare the sum of votes with its standard deviation by chance
    total = np.bincount(patch[sample], vote, len(size))
    spread = np.sqrt(np.bincount(patch[sample], vote**2, len(size)))
    share = total / np.maximum(np.bincount(patch[sample], mesh.face_areas[sample], len(size)), 1e-300)
    # clear votes: more than 5% of the rays, and five standard deviations
    known = (np.abs(share) > 0.05) & (np.abs(total) > 5.0 * spread)
    turn = known & (total > 0)
    if turn.any() and not known.all():
        turn |= ~known & _against_nearest(mesh, patch, known, turn)
    if turn.any():
        turn = _agree_with_camera(mesh, rays, patch, turn)
    return turn[patch]


def _agree_with_camera(mesh: Mesh, rays: Rays, patch: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Correct which patches (P,) bool to invert if the whole scan was seen by one camera.

    Its noise and depth steps occlude the front as often as the back. But everything it saw faces it. So if the patches
    would not all face one way, they are oriented towards the camera, on the side that most of the scan faced.
    """
    # from which of 26 directions is nearly everything visible? Of a sheet also from behind, so the sign is open
    grid = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
    ways = grid[grid.any(axis=1)] / np.linalg.norm(grid[grid.any(axis=1)], axis=1, keepdims=True)
    sample = np.random.default_rng(0).permutation(len(patch))[:SAMPLES]
    middle, area = mesh.corners[sample].mean(axis=1), mesh.face_areas[sample]
    size = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    # rays start 0.2% of the diagonal above a triangle, farther than the noise of a depth camera
    sights = [np.average(~rays.test_occlusion(middle + 2e-3 * size * way, np.tile(way, (len(sample), 1)), size),
                         weights=area)
              for way in ways]
    # a single view has 0.89 and more, a whole body a half
    if max(sights) < 0.8:
        return turn
    along = mesh.face_areas * (mesh.face_normals @ ways[int(np.argmax(sights))])
    facing = np.where(turn[patch], -along, along)
    # already consistent: half views have 0.75 and more of the area facing one way
    if abs(facing.sum()) > 0.6 * np.abs(facing).sum():
        return turn
    return np.bincount(patch, along * np.sign(along.sum())) < 0


def _against_nearest(mesh: Mesh, patch: np.ndarray, known: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Find patches (P,) bool that face against the nearest triangles of patches with a known side.

    For small and flat patches, in a scan with triangles of both orientations.
    """
    middle, sure = mesh.corners.mean(axis=1), known[patch]
    asked = np.flatnonzero(~sure)
    near = np.flatnonzero(sure)[cKDTree(middle[sure]).query(middle[asked], workers=search_threads(len(asked)))[1]]
    outward = mesh.face_normals[near] * np.where(turn[patch[near]], -1, 1)[:, None]
    agree = np.einsum("fd,fd->f", mesh.face_normals[asked], outward)
    return np.bincount(patch[asked], mesh.face_areas[asked] * agree, len(known)) < 0


def _directions(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw unit vectors (n, 3) in the hemispheres of normals (n, 3), with cosine weighting."""
    around = rng.normal(size=normals.shape)
    around = normals + around / np.linalg.norm(around, axis=1, keepdims=True)
    length = np.linalg.norm(around, axis=1, keepdims=True)
    return np.where(length > 1e-6, around / np.maximum(length, 1e-6), normals)
