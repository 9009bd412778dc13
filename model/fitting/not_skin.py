"""Hair and clothes of a scan, found by themselves: surface that lies farther out than naked people's skin does.

1. Every scan point has a distance from the predicted body, outward positive. These are smoothed over the body.
2. A connected piece of the body with a core that is far out carries hair or clothes; so does what ends in `hems`.
3. They reach as far as the scan is out of the body that bare parts tell of (`inside`).
4. The points on them are masked, and the body is fitted again inside, as with `--mask`.

A suit as close as skin is found by its cuffs only, and nothing tells where skin is inside: it is fitted as skin, with
wider errors. What is closer than the core and has neither hems nor cuffs, such as short hair, is not told from skin.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface, SurfacePoints
from scanprep.skeleton.roles import in_words, part_kind
from scanprep.skeleton.tree import Skeleton

from .bodies import FixedBody
from .hems import find_hems, has_cuffs
from .scan import ScanPoints

# Metres: how far out the core of a piece is, the same at backs and backs of heads, and the rest of it. People differ in
# faces, bellies and breasts, little behind. Found with these: none of 112 naked people of 15 seeds and of 57 real men
# seen from all sides, one of 30 seen from one side; all of 7 skirts, and 17 of 20 people with hair. With a core of
# 11.5 mm behind it is one of the men and one person with hair more, with 14 mm before two naked people and 7 men.
CORE, CORE_BEHIND, GROWN = 0.016, 0.012, 0.006
# In front of the trunk: a pregnant woman's belly is up to 25 mm out of the built-in people, bags 100 and more.
CORE_BELLY = 0.030
# Square metres: least area of a piece, and of its core.
PIECE, PIECE_CORE = 0.003, 0.0009
# Scanners close groins and armpits: there skin seems up to three times as far out; it falls off over 8 cm.
AT_FOLDS, FOLD = 2.0, 0.08
BORDER = 0.03                        # metres: beside what was not seen, where scanners and smoothing are less exact
CLOSE = "clothes as close as skin"


@dataclass(frozen=True, eq=False)
class NotSkin:
    """Hair and clothes on a body; no vertices and no points under clothes that are as close as skin."""

    vertices: np.ndarray            # (N,) bool, of the body
    points: np.ndarray              # (n,) bool, of the scan, as in a mask
    places: tuple[str, ...]         # in words: "hair on chest and head", "clothes on thighs"
    sewn: np.ndarray                # (N,) bool, of the body: under clothes that end in hems

    def with_more(self, more: NotSkin, body: Mesh, skeleton: Skeleton) -> NotSkin:
        """Add what was found later."""
        vertices, sewn = self.vertices | more.vertices, self.sewn | more.sewn
        close = (CLOSE,) if CLOSE in self.places + more.places else ()
        return NotSkin(vertices, self.points | more.points, (*describe(body, skeleton, vertices, sewn), *close), sewn)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """How a scan lies around a body."""

    body: Mesh
    cloud: ScanPoints

    @cached_property
    def near(self) -> SurfacePoints:
        """The place of the body that is nearest to each point."""
        return Surface(self.body).closest(self.cloud.points)

    @cached_property
    def out_of(self) -> np.ndarray:
        """(n,) metres: how far each point lies out of the body, negative inside."""
        body, near = self.body, self.near
        off = self.cloud.points - np.einsum("nk,nkd->nd", near.bary, body.corners[near.faces])
        outside = np.einsum("nd,nd->n", off, body.face_normals[near.faces]) > 0
        return np.where(outside, near.distances, -near.distances)

    @cached_property
    def aligned(self) -> np.ndarray:
        """(n,) bool: points that face as the body does."""
        return np.einsum("nd,nd->n", self.body.face_normals[self.near.faces], self.cloud.normals) > 0.2

    @cached_property
    def out(self) -> np.ndarray:
        """(N,) metres: how far the scan lies out over each vertex, smoothed; NaN where no points face as it."""
        body, near = self.body, self.near
        valid = self.aligned & (np.abs(self.out_of) < 0.25)
        corners, weights, N = body.faces[near.faces[valid]].ravel(), near.bary[valid].ravel(), len(body.vertices)
        total = np.bincount(corners, weights * np.repeat(self.out_of[valid], 3), N)
        weight = np.bincount(corners, weights, N)
        # half of a vertex, half of its neighbours, six times
        neighbours = csr_array(body.vertex_adjacency).astype(float)
        average = 0.5 * (diags_array(np.ones(N)) + diags_array(1 / np.maximum(neighbours.sum(axis=1), 1)) @ neighbours)
        for _ in range(6):
            total, weight = average @ total, average @ weight
        return np.where(weight > 1e-3, total / np.maximum(weight, 1e-9), np.nan)

    def points_on(self, vertices: np.ndarray) -> np.ndarray:
        """Find the points (n,) bool over vertices (N,) bool."""
        return np.einsum("nk,nk->n", self.near.bary, vertices[self.body.faces[self.near.faces]]) > 0.5


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
    if not {"thigh", "upper_arm", "foot", "hand"} <= set(kinds):
        return None
    part, around = skeleton.part_of_vertex(body), Surroundings(body, cloud)
    graph = SurfaceGraph(body)
    # fists and toes differ on everybody; where skin faces skin, and beside what was not seen, how far out is uncertain
    silent = np.isin(kinds, ["hand", "foot"])[part] | find_facing_skin(body)
    if (unseen := np.isnan(around.out)).any():
        silent |= graph.nearest(np.flatnonzero(unseen))[0] < BORDER
    folds = graph.nearest(np.flatnonzero(find_limb_roots(body, skeleton, part, kinds)))[0]
    out = np.where(silent, np.nan, around.out / (1 + AT_FOLDS * np.exp(-folds / FOLD)))
    behind, belly, scalp = find_backs(person.template, part, kinds)
    crude = person.left_out_error or 0.0
    core = np.where(behind, CORE_BEHIND, np.where(belly, CORE_BELLY, CORE))
    far = find_pieces(body, out, np.maximum(core, 3 * crude))
    ends = (person.template, skeleton, kinds, around.near.faces, around.near.bary,
            np.where(around.aligned, around.out_of, np.nan), 1.5 * crude)
    sewn, boots = find_hems(*ends)
    # sleeves that end in hems are no close suit
    close = (CLOSE,) if not sewn[kinds[part] == "upper_arm"].any() and has_cuffs(*ends) else ()
    if not (far | sewn | boots).any():
        return NotSkin(far, np.zeros(count, dtype=bool), close, sewn) if close else None
    loose = reach_the_waist(reach_the_crown(far | sewn | boots, scalp), part, kinds, folds)
    # its points, and those as far out that hang together with them, such as the hem of a skirt; feet below do not
    on_it = around.points_on(loose)
    points = np.zeros(count, dtype=bool)
    points[cloud.index[on_it | find_joined(cloud, on_it, around.out_of > CORE)]] = True
    return NotSkin(loose, points, (*describe(body, skeleton, loose, sewn), *close), sewn)


def find_backs(template: Mesh, part: np.ndarray, kinds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the vertices (N,) bool of the back of trunk and head, away from where feet point, of belly and of scalp."""
    if not {"foot", "shin", "chest"} <= set(kinds[part]):
        nothing = np.zeros(len(part), dtype=bool)
        return nothing, nothing, nothing
    foot, shin, chest = (template.vertices[(kinds == kind)[part]].mean(axis=0) for kind in ("foot", "shin", "chest"))
    up = (chest - shin) / np.linalg.norm(chest - shin)
    forward = foot - shin - up * (up @ (foot - shin))
    ahead, above = template.vertex_normals @ (forward / np.linalg.norm(forward)), template.vertex_normals @ up
    head, trunk = np.isin(kinds, ["head", "neck"])[part], np.isin(kinds, ["chest", "abdomen", "pelvis"])[part]
    scalp = (kinds == "head")[part] & ((ahead < 0) | ((above > 0.3) & (ahead < 0.5)))
    return (trunk | head) & (ahead < 0), trunk & (ahead > 0.4), scalp


def reach_the_crown(covered: np.ndarray, scalp: np.ndarray) -> np.ndarray:
    """Add the rest of the scalp (N,) bool to hair on a fifth of it: it grows everywhere there, however close."""
    return covered | scalp if covered[scalp].sum() > 0.2 * scalp.sum() else covered


def reach_the_waist(covered: np.ndarray, part: np.ndarray, kinds: np.ndarray, folds: np.ndarray) -> np.ndarray:
    """Add hips and pelvis to clothes on both thighs: skirts and trousers hang from the waist, however close there.

    `covered` (N,) bool is what was found; `folds` (N,), metres, is how far each vertex is from groins and armpits.
    """
    if min(covered[part == thigh].mean() for thigh in np.flatnonzero(kinds == "thigh")) < 0.1:
        return covered
    return covered | (kinds[part] == "pelvis") | ((kinds[part] == "thigh") & (folds < 1.5 * FOLD))


def find_joined(cloud: ScanPoints, some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Find the points (n,) bool among `others` that a chain of others, no wider than a gap, joins to `some`."""
    if not some.any():
        return some
    ids = np.flatnonzero(some | others)
    gap = max(0.01, 3 * cloud.spacing)
    # a list of ranks, as a single one would give arrays of another shape
    apart, near = cKDTree(cloud.points[ids]).query(cloud.points[ids], list(range(1, min(9, len(ids)) + 1)),
                                                   distance_upper_bound=gap)
    row, joined = np.broadcast_to(np.arange(len(ids))[:, None], near.shape), np.isfinite(apart)
    graph = csr_array((np.ones(joined.sum()), (row[joined], near[joined])), shape=(len(ids), len(ids)))
    label = connected_components(graph, directed=False)[1]
    out = np.zeros(len(some), dtype=bool)
    out[ids] = np.isin(label, label[some[ids]])
    return out


def find_facing_skin(body: Mesh) -> np.ndarray:
    """Find the vertices (N,) with other skin before them: from 6 cm out the body is nearer than they are."""
    return Surface(body).closest(body.vertices + 0.06 * body.vertex_normals).distances < 0.8 * 0.06


def find_limb_roots(body: Mesh, skeleton: Skeleton, part: np.ndarray, kinds: np.ndarray) -> np.ndarray:
    """Find the vertices (N,) at groin and armpits: where thighs and upper arms meet other parts."""
    hangs = np.isin(kinds, ["thigh", "upper_arm"])
    at_root = np.zeros(len(body.vertices), dtype=bool)
    for one, other in (body.edges.T, body.edges.T[::-1]):
        a, b = part[one], part[other]
        meets = hangs[a] & (a != b) & (hangs[b] | (np.asarray(skeleton.parents)[a] == b))
        at_root[np.concatenate([one[meets], other[meets]])] = True
    return at_root


def find_pieces(body: Mesh, out: np.ndarray, core: np.ndarray) -> np.ndarray:
    """Find connected pieces of the body that lie far out, (N,) bool.

    `out` (N,) is how far, `core` (N,) from where on it is a core, metres.
    """
    areas, found = body.vertex_areas, np.zeros(len(out), dtype=bool)
    for piece in split_pieces(body, np.nan_to_num(out, nan=-1.0) > GROWN):
        if areas[piece].sum() > PIECE and areas[piece & (out > core)].sum() > PIECE_CORE:
            found |= piece
    return found


def split_pieces(body: Mesh, vertices: np.ndarray) -> list[np.ndarray]:
    """Split vertices (N,) bool into pieces (N,) bool that edges of the body connect, the largest first."""
    ids = np.flatnonzero(vertices)
    label = connected_components(csr_array(body.vertex_adjacency)[ids][:, ids], directed=False)[1]
    areas = np.bincount(label, body.vertex_areas[ids])
    return [np.isin(np.arange(len(vertices)), ids[label == k]) for k in np.argsort(-areas) if areas[k] > 0]


def describe(body: Mesh, skeleton: Skeleton, vertices: np.ndarray, sewn: np.ndarray) -> tuple[str, ...]:
    """Name what lies on vertices (N,) bool of a body: "hair on chest and head", "clothes on thighs and left shin".

    `sewn` (N,) bool lies under clothes for certain, as they end in hems.
    """
    part, found = skeleton.part_of_vertex(body), dict[str, set[int]]()
    for piece in split_pieces(body, vertices):
        # the parts that carry more than a little of it
        areas = np.bincount(part, body.vertex_areas * piece, len(skeleton.names))
        parts = set(np.flatnonzero(areas > max(0.002, 0.2 * areas.max())).tolist())
        kinds = {part_kind(skeleton.names[p]) for p in parts}
        clothes, head = bool(kinds & {"thigh", "shin"}) or bool((piece & sewn).any()), "head" in kinds
        what = "hair and clothes" if clothes and head else "clothes" if clothes else "hair" if head else \
            "hair or clothes"
        if parts:
            found[what] = found.get(what, set()) | parts
    return tuple(f"{what} on {_parts_in_words([skeleton.names[p] for p in sorted(parts)])}"
                 for what, parts in found.items())


def _parts_in_words(names: Sequence[str]) -> str:
    """Join names of parts, both sides of a limb as one: "thighs and left shin"."""
    kinds = [part_kind(name) for name in names]
    words = list(dict.fromkeys(f"{in_words(kind)}s" if kinds.count(kind) > 1 else in_words(name)
                               for kind, name in zip(kinds, names, strict=True)))
    return " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
