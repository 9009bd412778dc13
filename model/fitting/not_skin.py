"""Hair and clothes of a scan, found by themselves: surface that lies farther out than naked people's skin does.

1. Every scan point has a distance from the predicted body, outward positive. These are smoothed over the body.
2. A connected piece of the body with a core that is far out carries hair or clothes.
3. The points on it are masked, and the body is fitted again inside, as with `--mask`.

What lies closer than the core, such as tights or short hair, is not told from skin.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.skeleton.roles import in_words, part_kind
from scanprep.skeleton.tree import Skeleton

from .bodies import FixedBody
from .scan import ScanPoints

# Metres: how far out the core of a piece is, the same at backs and backs of heads, and the rest of it. People differ in
# faces, bellies and breasts, little behind. Found with these: TODO
CORE, CORE_BEHIND, GROWN = 0.016, 0.012, 0.006
# Square metres: least area of a piece, and of its core.
PIECE, PIECE_CORE = 0.003, 0.0009
# Scanners close groins and armpits: there skin seems up to three times as far out; it falls off over 8 cm.
AT_FOLDS, FOLD = 2.0, 0.08


@dataclass(frozen=True, eq=False)
class NotSkin:
    """Hair and clothes on a body."""

    vertices: np.ndarray            # (N,) bool, of the body
    points: np.ndarray              # (n,) bool, of the scan, as in a mask
    places: tuple[str, ...]         # in words: "hair on chest and head", "clothes on thighs"


def find_not_skin(body: Mesh, person: FixedBody, cloud: ScanPoints, count: int) -> NotSkin | None:
    """Find hair and clothes on a scan of a person; None where there are none, or where the body is no person's.

    Parameters
    ----------
    body : Mesh
        The predicted body, metres.
    person : FixedBody
        Whose body it is. Three times its error on bodies that it was not learned from is no hair.
    cloud : ScanPoints
        Points of the scan.
    count : int
        Number n of all points of the scan, of which the cloud has some.
    """
    skeleton = person.skeleton
    kinds = np.array([part_kind(name) for name in skeleton.names])
    if not {"thigh", "upper_arm", "foot"} <= set(kinds):
        return None
    part, near = skeleton.part_of_vertex(body), Surface(body).closest(cloud.points)
    # how far each point lies out of the body
    off = cloud.points - np.einsum("nk,nkd->nd", near.bary, body.corners[near.faces])
    out_of = np.where(np.einsum("nd,nd->n", off, body.face_normals[near.faces]) > 0, near.distances, -near.distances)
    out = smooth_distances(body, cloud, near.faces, near.bary, out_of)
    # fists and toes differ on everybody, and where skin faces skin nobody sees how far out it is
    silent = np.isin(kinds, ["hand", "foot"])[part] | find_facing_skin(body)
    folds = SurfaceGraph(body).nearest(np.flatnonzero(find_limb_roots(body, skeleton, part, kinds)))[0]
    out = np.where(silent, np.nan, out / (1 + AT_FOLDS * np.exp(-folds / FOLD)))
    behind, scalp = find_backs(person.template, part, kinds)
    core = np.where(behind, CORE_BEHIND, CORE)
    pieces = find_pieces(body, out, np.maximum(core, 3 * (person.left_out_error or 0.0)))
    if not pieces:
        return None
    pieces = reach_the_waist(reach_the_crown(pieces, scalp), part, kinds, folds)
    loose = np.any(pieces, axis=0)
    # its points, and those as far out that hang together with them, such as the hem of a skirt; feet below do not
    on_it = np.einsum("nk,nk->n", near.bary, loose[body.faces[near.faces]]) > 0.5
    points = np.zeros(count, dtype=bool)
    points[cloud.index[on_it | find_joined(cloud, on_it, out_of > CORE)]] = True
    return NotSkin(loose, points, _in_words(body, skeleton, part, pieces))


def find_backs(template: Mesh, part: np.ndarray, kinds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the vertices (N,) bool of trunk and head that look backwards, away from where feet point, and the scalp."""
    foot, shin, chest = (template.vertices[(kinds == kind)[part]].mean(axis=0) for kind in ("foot", "shin", "chest"))
    up = (chest - shin) / np.linalg.norm(chest - shin)
    forward = foot - shin - up * (up @ (foot - shin))
    ahead, above = template.vertex_normals @ (forward / np.linalg.norm(forward)), template.vertex_normals @ up
    head = (kinds == "head")[part]
    trunk_or_head = np.isin(kinds, ["head", "neck", "chest", "abdomen", "pelvis"])[part]
    return trunk_or_head & (ahead < 0), head & ((ahead < 0) | ((above > 0.3) & (ahead < 0.5)))


def reach_the_crown(pieces: list[np.ndarray], scalp: np.ndarray) -> list[np.ndarray]:
    """Add the rest of the scalp (N,) bool to hair on a fifth of it: it grows everywhere there, however close."""
    return [piece | scalp if piece[scalp].mean() > 0.2 else piece for piece in pieces]


def reach_the_waist(pieces: list[np.ndarray], part: np.ndarray, kinds: np.ndarray, folds: np.ndarray
                    ) -> list[np.ndarray]:
    """Add hips and pelvis to clothes on both thighs: skirts and trousers hang from the waist, however close there.

    `folds` (N,), metres, is how far each vertex is from groins and armpits.
    """
    thighs, covered = np.flatnonzero(kinds == "thigh"), np.any(pieces, axis=0)
    if min(covered[part == thigh].mean() for thigh in thighs) < 0.1:
        return pieces
    pelvis = (kinds[part] == "pelvis") | ((kinds[part] == "thigh") & (folds < 1.5 * FOLD))
    first = next(k for k, piece in enumerate(pieces) if np.isin(part[piece], thighs).any())
    return [piece | pelvis if k == first else piece for k, piece in enumerate(pieces)]


def find_joined(cloud: ScanPoints, some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Find the points (n,) bool among `others` that a chain of others, no wider than a gap, joins to `some`."""
    ids = np.flatnonzero(some | others)
    gap = max(0.01, 3 * cloud.spacing)
    apart, near = cKDTree(cloud.points[ids]).query(cloud.points[ids], min(9, len(ids)), distance_upper_bound=gap)
    row, joined = np.broadcast_to(np.arange(len(ids))[:, None], near.shape), np.isfinite(apart)
    graph = csr_array((np.ones(joined.sum()), (row[joined], near[joined])), shape=(len(ids), len(ids)))
    label = connected_components(graph, directed=False)[1]
    out = np.zeros(len(some), dtype=bool)
    out[ids] = np.isin(label, label[some[ids]])
    return out


def smooth_distances(body: Mesh, cloud: ScanPoints, faces: np.ndarray, bary: np.ndarray, out_of: np.ndarray
                     ) -> np.ndarray:
    """Smooth how far out the scan lies over the body: (N,), metres, NaN without points that face the same way.

    `faces` and `bary` are the nearest places of the body, `out_of` (n,) how far each point lies out of it, metres.
    """
    valid = (np.einsum("nd,nd->n", body.face_normals[faces], cloud.normals) > 0.2) & (np.abs(out_of) < 0.25)
    corners, weights, N = body.faces[faces[valid]].ravel(), bary[valid].ravel(), len(body.vertices)
    total = np.bincount(corners, weights * np.repeat(out_of[valid], 3), N)
    weight = np.bincount(corners, weights, N)
    # half of a vertex, half of its neighbours, six times
    neighbours = csr_array(body.vertex_adjacency).astype(float)
    average = 0.5 * (diags_array(np.ones(N)) + diags_array(1 / np.maximum(neighbours.sum(axis=1), 1)) @ neighbours)
    for _ in range(6):
        total, weight = average @ total, average @ weight
    return np.where(weight > 1e-3, total / np.maximum(weight, 1e-9), np.nan)


def find_facing_skin(body: Mesh, reach: float = 0.06) -> np.ndarray:
    """Find the vertices (N,) with other skin before them: from `reach` metres out the body is nearer than they are."""
    return Surface(body).closest(body.vertices + reach * body.vertex_normals).distances < 0.8 * reach


def find_limb_roots(body: Mesh, skeleton: Skeleton, part: np.ndarray, kinds: np.ndarray) -> np.ndarray:
    """Find the vertices (N,) at groin and armpits: where thighs and upper arms meet other parts."""
    hangs = np.isin(kinds, ["thigh", "upper_arm"])
    at_root = np.zeros(len(body.vertices), dtype=bool)
    for one, other in (body.edges.T, body.edges.T[::-1]):
        a, b = part[one], part[other]
        meets = hangs[a] & (a != b) & (hangs[b] | (np.asarray(skeleton.parents)[a] == b))
        at_root[np.concatenate([one[meets], other[meets]])] = True
    return at_root


def find_pieces(body: Mesh, out: np.ndarray, core: np.ndarray) -> list[np.ndarray]:
    """Find connected pieces (N,) bool of the body that lie far out, the largest first.

    `out` (N,) is how far, `core` (N,) from where on it is a core, metres.
    """
    ids = np.flatnonzero(np.nan_to_num(out, nan=-1.0) > GROWN)
    if not len(ids):
        return []
    label = connected_components(csr_array(body.vertex_adjacency)[ids][:, ids], directed=False)[1]
    areas = np.bincount(label, body.vertex_areas[ids])
    cores = np.bincount(label, body.vertex_areas[ids] * (out[ids] > core[ids]))
    chosen = [k for k in np.argsort(-areas) if areas[k] > PIECE and cores[k] > PIECE_CORE]
    return [np.isin(np.arange(len(out)), ids[label == k]) for k in chosen]


def _in_words(body: Mesh, skeleton: Skeleton, part: np.ndarray, pieces: Sequence[np.ndarray]) -> tuple[str, ...]:
    """Name pieces: "hair on chest and head", "clothes on thighs and left shin"."""
    found: dict[str, set[int]] = {}
    for piece in pieces:
        # the parts that carry more than a little of it
        areas = np.bincount(part, body.vertex_areas * piece, len(skeleton.names))
        parts = set(np.flatnonzero(areas > max(0.002, 0.2 * areas.max())).tolist())
        kinds = {part_kind(skeleton.names[p]) for p in parts}
        legs, head = kinds & {"thigh", "shin"}, "head" in kinds
        what = "hair and clothes" if legs and head else "clothes" if legs else "hair" if head else "hair or clothes"
        found[what] = found.get(what, set()) | parts
    return tuple(f"{what} on {_parts_in_words([skeleton.names[p] for p in sorted(parts)])}"
                 for what, parts in found.items())


def _parts_in_words(names: Sequence[str]) -> str:
    """Join names of parts, both sides of a limb as one: "thighs and left shin"."""
    kinds = [part_kind(name) for name in names]
    words = list(dict.fromkeys(f"{in_words(kind)}s" if kinds.count(kind) > 1 else in_words(name)
                               for kind, name in zip(kinds, names, strict=True)))
    return " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
