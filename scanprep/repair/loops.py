"""Group borders into holes, and triangulate closed loops of points [Liepa]."""
from __future__ import annotations

import heapq

import numpy as np

from ..geometry.mesh import Mesh
from ..geometry.sparse import label_components


def group_loops(mesh: Mesh, loops: list[np.ndarray]) -> list[list[np.ndarray]]:
    """Group borders that face each other, as the two ends where a limb was cut through; in the order of `loops`."""
    large = [number for number, loop in enumerate(loops) if len(loop) >= 6]    # smaller ones are pinholes
    label = np.arange(len(loops))
    if len(large) > 1:
        points = np.concatenate([mesh.vertices[loops[number]] for number in large])
        owner = np.repeat(large, [len(loops[number]) for number in large])
        ahead = np.concatenate([_outward(mesh, loops[number]) for number in large])
        facing = np.array([_facing_shares(points, owner, ahead, number, len(loops)) for number in large])
        both = np.zeros((len(loops), len(loops)), dtype=bool)
        both[large] = facing > 0.6            # most vertices of one border must see the other, and vice versa
        a, b = np.nonzero(both & both.T)
        label = label_components(a, b, len(loops))
    return [[loops[k] for k in np.flatnonzero(label == label[number])]
            for number in np.unique(label, return_index=True)[1]]


def join_polygons(vertices: np.ndarray, loops: list[np.ndarray]) -> np.ndarray:
    """Join several loops into one polygon (m,), with cuts along the shortest lines between them.

    The vertices at the ends of a cut appear twice. All loops run in the direction of the border triangles' sides.
    """
    polygon = loops[0]
    rest = list(loops[1:])
    while rest:
        apart = [np.linalg.norm(vertices[polygon][:, None] - vertices[loop], axis=2) for loop in rest]
        nearest = int(np.argmin([a.min() for a in apart]))
        i, k = np.unravel_index(apart[nearest].argmin(), apart[nearest].shape)
        other = np.roll(rest.pop(nearest), -int(k))
        polygon = np.concatenate([polygon[:i + 1], other, other[:1], polygon[i:]])
    return polygon


def _outward(mesh: Mesh, loop: np.ndarray) -> np.ndarray:
    """Estimate unit directions (n, 3) in which the surface would continue at the vertices of a border."""
    v = mesh.vertices[loop]
    along = np.roll(v, -1, axis=0) - np.roll(v, 1, axis=0)
    out = np.cross(along, mesh.vertex_normals[loop])
    for _ in range(3):                                        # smooth, as jagged borders point everywhere
        out = out + np.roll(out, 1, axis=0) + np.roll(out, -1, axis=0)
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-30))


def _facing_shares(points: np.ndarray, owner: np.ndarray, ahead: np.ndarray, number: int, count: int) -> np.ndarray:
    """Compute for one border the shares (count,) of its vertices that face each other border.

    A vertex faces the nearest border ahead of it, within 45 degrees and closer than its own border is wide.
    """
    own = owner == number
    apart = points[None] - points[own][:, None]
    far = np.linalg.norm(apart, axis=2)
    width = np.linalg.norm(np.ptp(points[own], axis=0))
    straight = np.einsum("abd,ad->ab", apart, ahead[own]) > 0.7 * far
    far = np.where(straight & (far > 0) & (far < width), far, np.inf)
    next_one = far.argmin(axis=1)
    faced = owner[next_one][np.isfinite(far.min(axis=1))]
    shares = np.bincount(faced, minlength=count) / own.sum()
    shares[number] = 0
    return np.asarray(shares)


def triangulate_loop(points: np.ndarray, rim_normals: np.ndarray, forbidden: np.ndarray,
                     price: np.ndarray | None = None) -> np.ndarray | None:
    """Find the triangulation (n - 2, 3) of a loop (n, 3) that bends least and, if nothing bends, has the smallest area.

    An edge of length l between triangles whose normals have the cosine c costs l (1 - c)². So a few sharp bends cost
    more than many soft ones. A crease along the bottom of an armpit costs less than a web across it, which bends
    sharply along both of its sides. Dynamic programming covers all triangulations in O(n³). Longer loops lose ears
    first.

    The loop runs in the direction of the new triangles. `rim_normals` (n, 3) are those of the surface beyond each edge
    i, i + 1. Pairs that are `forbidden` (n, n), because they have an edge already, get none. A new edge also costs
    `price` (n, n), metres. Returns None when every triangulation needs a forbidden edge.

    [Liepa] hole triangulation
    """
    kept, ears = _cut_ears(points, rim_normals, forbidden)
    normals = _chord_normals(points, rim_normals, kept, ears) if ears else rim_normals
    price = np.zeros((len(points), len(points))) if price is None else price
    inner = _least_weight(points[kept], normals, forbidden[np.ix_(kept, kept)], price[np.ix_(kept, kept)])
    return None if inner is None else np.concatenate([np.asarray(ears, dtype=int).reshape(-1, 3), kept[inner]])


def _least_weight(p: np.ndarray, rim: np.ndarray, forbidden: np.ndarray, price: np.ndarray) -> np.ndarray | None:
    """Find the least-cost triangulation by dynamic programming over spans of the loop; None if all are forbidden."""
    n = len(p)
    cost = np.full((n, n), np.inf)
    normal, choice = np.zeros((n, n, 3)), np.zeros((n, n), dtype=np.int64)
    apart = np.linalg.norm(p[:, None] - p, axis=2)
    # small weight of the area, per size of the loop: it decides where everything is flat
    per_area = 0.01 / max(float(np.linalg.norm(p - p.mean(axis=0), axis=1).mean()), 1e-30)
    first = np.arange(n - 1)
    cost[first, first + 1] = 0
    normal[first, first + 1] = rim[:-1]

    def bend(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray((1 - np.einsum("...d,...d", a, b)) ** 2)

    for span in range(2, n):
        # for every span i..k and every tip m: both sub-spans, the area, and the bends across i m and m k
        i = np.arange(n - span)[:, None]
        k = i + span
        m = i + np.arange(1, span)[None]
        across = np.cross(p[m] - p[i], p[k] - p[i])
        size = np.linalg.norm(across, axis=-1)
        across /= np.maximum(size, 1e-30)[..., None]
        total = cost[i, m] + cost[m, k] + per_area * size / 2
        total += apart[i, m] * bend(across, normal[i, m]) + apart[m, k] * bend(across, normal[m, k])
        if span == n - 1:
            total += apart[i, k] * bend(across, rim[-1])
        # keep the best tip; a forbidden chord makes the span impossible
        best = total.argmin(axis=1)
        row = np.arange(n - span)
        i, k = i[:, 0], k[:, 0]
        closed = forbidden[i, k] & (span < n - 1)
        cost[i, k] = np.where(closed, np.inf, total[row, best] + price[i, k])
        normal[i, k], choice[i, k] = across[row, best], best + i + 1
    if not np.isfinite(cost[0, n - 1]):
        return None
    # read the triangles back from the choices
    triangles, stack = [], [(0, n - 1)]
    while stack:
        start, end = stack.pop()
        if end - start >= 2:
            tip = int(choice[start, end])
            triangles.append((start, tip, end))
            stack += [(start, tip), (tip, end)]
    return np.array(triangles)


def _cut_ears(points: np.ndarray, rim: np.ndarray, forbidden: np.ndarray
              ) -> tuple[np.ndarray, list[tuple[int, int, int]]]:
    """Cut convex corners (ears), shortest new edge first, until at most 120 vertices remain; return both."""
    n = len(points)
    after, before = (np.arange(n) + 1) % n, np.arange(n) - 1
    before[0] = n - 1
    normal = rim + np.roll(rim, 1, axis=0)
    alive, ears = np.ones(n, dtype=bool), []

    def entry(i: int) -> tuple[float, int, int, int] | None:
        """Return the queue entry of corner i, or None if it must not be cut."""
        a, b = int(before[i]), int(after[i])
        across = np.cross(points[i] - points[a], points[b] - points[a])
        if forbidden[a, b] or across @ normal[i] <= 0.2 * np.linalg.norm(across) * np.linalg.norm(normal[i]):
            return None
        return float(np.linalg.norm(points[a] - points[b])), i, a, b

    largest = 120  # longer loops would make the O(n³) dynamic programming slow
    heap = [e for e in map(entry, range(n)) if e] if n > largest else []
    heapq.heapify(heap)
    remaining = n
    while heap and remaining > largest:
        _, i, a, b = heapq.heappop(heap)
        if not alive[i] or before[i] != a or after[i] != b:
            continue
        ears.append((a, i, b))
        alive[i], after[a], before[b], remaining = False, b, a, remaining - 1
        for fresh in filter(None, map(entry, (a, b))):
            heapq.heappush(heap, fresh)
    return np.flatnonzero(alive), ears


def _chord_normals(points: np.ndarray, rim: np.ndarray, kept: np.ndarray, ears: list[tuple[int, int, int]]
                   ) -> np.ndarray:
    """Return the normals beyond the edges of the loop after cutting ears."""
    of_edge = {(i, (i + 1) % len(points)): rim[i] for i in range(len(points))}
    for a, i, b in ears:
        across = np.cross(points[i] - points[a], points[b] - points[a])
        of_edge[a, b] = across / max(np.linalg.norm(across), 1e-30)
    return np.array([of_edge[int(a), int(b)] for a, b in zip(kept, np.roll(kept, -1), strict=True)])
