"""Rigid motions of sets of vertices over all poses, from sums that add up when sets are joined.

For a weighted set of vertices the best rotation, translation and residual of every pose depend only on a few sums over
the set. The sums of a union are the sums of both sets, so its cost is found without touching the vertices again. Sets
are joined greedily, the cheapest union first.
"""
from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_array, csr_array

from ..geometry.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Moments:
    """Weighted sums over P sets of vertices, in M poses."""

    w: np.ndarray  # (P,) float: Σ w
    x: np.ndarray  # (P, 3) float: Σ w x, x on the template
    y: np.ndarray  # (P, M, 3) float: Σ w y, y in the pose
    yx: np.ndarray  # (P, M, 3, 3) float: Σ w y xᵀ
    xx: np.ndarray  # (P,) float: Σ w |x|²
    yy: np.ndarray  # (P,) float: Σ w |y|² over all poses

    def each(self) -> tuple[np.ndarray, ...]:
        """Return all sums, arrays of P rows."""
        return self.w, self.x, self.y, self.yx, self.xx, self.yy

    def __getitem__(self, sets: np.ndarray | slice) -> Moments:
        """Return the sums of some of the sets."""
        return Moments(*(a[sets] for a in self.each()))

    def __add__(self, other: Moments) -> Moments:
        """Return the sums of the unions, set by set."""
        return Moments(*(a + b for a, b in zip(self.each(), other.each(), strict=True)))

    def gather(self, label: np.ndarray) -> Moments:
        """Add the sums of all sets (P,) with the same label."""
        into = csr_array((np.ones(len(label)), (label, np.arange(len(label)))))
        return Moments(*((into @ a.reshape(len(label), -1)).reshape(-1, *a.shape[1:]) for a in self.each()))

    def absorb(self, a: int, b: int) -> None:
        """Add set b to set a, in place."""
        for array in self.each():
            array[a] += array[b]


@dataclass(frozen=True, eq=False)
class Motions:
    """Best rigid motions of P sets in M poses."""

    R: np.ndarray  # (P, M, 3, 3) float
    t: np.ndarray  # (P, M, 3) float, metres: `y ≈ R x + t`, in the centred coordinates of `PosedSurface`
    cost: np.ndarray  # (P,) float, square metres: Σ w |R x + t - y|², mean over the poses


def fit_motions(moments: Moments) -> Motions:
    """Fit the rigid motion of each set in every pose (Procrustes), and compute its residual."""
    m = moments
    cx, cy = m.x / m.w[:, None], m.y / m.w[:, None, None]
    H = m.yx - m.y[..., :, None] * cx[:, None, None, :]
    # R from the SVD of the cross-covariance; a reflection is turned into the best rotation
    U, s, Vt = np.linalg.svd(H)
    proper = np.where(np.linalg.det(U) * np.linalg.det(Vt) < 0, -1.0, 1.0)
    U[..., :, 2] *= proper[..., None]
    s[..., 2] *= proper
    R = U @ Vt
    spread = (m.xx - np.einsum("pi,pi->p", m.x, cx)) * H.shape[1] + m.yy - np.einsum("pmi,pmi->p", m.y, cy)
    cost = np.maximum(spread - 2 * s.sum(axis=(1, 2)), 0) / H.shape[1]
    return Motions(R, cy - np.einsum("pmij,pj->pmi", R, cx), cost)


def rigid_costs(moments: Moments) -> np.ndarray:
    """Compute the costs (P,) of `fit_motions`, square metres, without the motions: several times faster."""
    m = moments
    cx, cy = m.x / m.w[:, None], m.y / m.w[:, None, None]
    H = m.yx - m.y[..., :, None] * cx[:, None, None, :]
    spread = (m.xx - np.einsum("pi,pi->p", m.x, cx)) * H.shape[1] + m.yy - np.einsum("pmi,pmi->p", m.y, cy)
    return np.maximum(spread - 2 * _best_trace(H).sum(axis=1), 0) / H.shape[1]


def _best_trace(H: np.ndarray) -> np.ndarray:
    """Compute the largest trace(RᵀH) over all rotations R, for matrices (..., 3, 3).

    It is e = s1 + s2 ± s3, the singular values with the sign of the determinant d. With a = Σ s² and b = Σ s²s² it is
    the largest root of (e² - a)² / 4 = b + 2 d e, which Newton's method reaches from above.
    """
    # determinant d, a = Σ s² (sum of squares) and b = Σ s²s² (sum of 2 × 2 minors of HᵀH)
    c0, c1, c2 = H[..., 0], H[..., 1], H[..., 2]
    cross = np.stack([c0[..., 1] * c1[..., 2] - c0[..., 2] * c1[..., 1],
                      c0[..., 2] * c1[..., 0] - c0[..., 0] * c1[..., 2],
                      c0[..., 0] * c1[..., 1] - c0[..., 1] * c1[..., 0]], axis=-1)
    d = (cross * c2).sum(axis=-1)
    n0, n1, n2 = ((c * c).sum(axis=-1) for c in (c0, c1, c2))
    d01, d12, d02 = (c0 * c1).sum(axis=-1), (c1 * c2).sum(axis=-1), (c0 * c2).sum(axis=-1)
    a = n0 + n1 + n2
    b = np.maximum(n0 * n1 - d01**2, 0) + np.maximum(n1 * n2 - d12**2, 0) + np.maximum(n0 * n2 - d02**2, 0)
    e = np.sqrt(3 * a)
    for _ in range(60):                              # a few suffice unless the points of a set lie on a line
        over = e * e - a
        slope = over * e - 2 * d
        step = (over * over / 4 - b - 2 * d * e) / np.where(slope > 0, slope, np.inf)
        e = e - np.maximum(step, 0)
        if (step <= 1e-13 * e).all():
            break
    return e


def union_costs(moments: Moments, pairs: np.ndarray) -> np.ndarray:
    """Compute the cost (n,), square metres, of one rigid motion for both sets of each pair (n, 2)."""
    return rigid_costs(moments[pairs[:, 0]] + moments[pairs[:, 1]])


class PosedSurface:
    """A template and its poses (M, N, 3), centred and laid out for sums over vertices.

    The weight of a vertex is its share of the surface area.
    """

    def __init__(self, template: Mesh, poses: np.ndarray) -> None:
        self.mesh = template
        self.area = float(template.face_areas.sum())
        self.face_weights = template.face_areas / self.area
        weights = template.vertex_areas / self.area
        self.origin = weights @ template.vertices
        self.pose_origins = np.einsum("n,mni->mi", weights, poses)
        self.x = template.vertices - self.origin
        self.y = np.ascontiguousarray((poses - self.pose_origins[:, None]).transpose(1, 0, 2))
        self._yy = np.einsum("nmi,nmi->n", self.y, self.y)
        self.pairs = template.face_pairs
        self.pair_lengths = template.edge_lengths[template.edge_use == 2]

    def moments(self, label: np.ndarray, face_weights: np.ndarray | None = None) -> Moments:
        """Compute the sums over the triangles of every label; each corner has a third of its triangle's weight."""
        weights = self.face_weights if face_weights is None else face_weights
        rows, columns = np.repeat(label, 3), self.mesh.faces.ravel()
        W = csr_array(coo_array((np.repeat(weights / 3, 3), (rows, columns)),
                                shape=(label.max() + 1, len(self.x))))
        n, M = self.y.shape[:2]
        flat, x1 = self.y.reshape(n, -1), np.c_[self.x, np.ones(n)]
        # Σ w y xᵀ and Σ w y in one product, as x has a fourth column of ones
        yx1 = np.empty((W.shape[0], 3 * M, 4))
        for p, (start, end) in enumerate(pairwise(W.indptr)):
            corners = W.indices[start:end]
            yx1[p] = flat[corners].T @ (W.data[start:end, None] * x1[corners])
        yx1 = yx1.reshape(-1, M, 3, 4)
        return Moments(np.asarray(W.sum(axis=1)).ravel(), W @ self.x, yx1[..., 3].copy(), yx1[..., :3].copy(),
                       W @ np.einsum("ni,ni->n", self.x, self.x), W @ self._yy)

    def core_motions(self, label: np.ndarray) -> Motions:
        """Fit rigid motions of parts (F,) to the triangles inside them, with robust weights.

        At a border the surface follows both parts, and skin far from a bone slides over it: the waist moves with the
        thighs. A part that is mostly border is fitted as a whole. Weights are those of Geman-McClure, scaled by the
        median residual of the part.
        """
        corner = self.mesh.faces
        low, high = np.full(len(self.x), label.max()), np.zeros(len(self.x), dtype=np.int64)
        for c in corner.T:
            np.minimum.at(low, c, label)
            np.maximum.at(high, c, label)
        # core: triangles all of whose corners belong to one part only
        core = np.where((low == high)[corner].all(axis=1), self.face_weights, 0)
        share = np.bincount(label, core) / np.bincount(label, self.face_weights)
        # with less than 0.3 of its area inside, the whole part is used
        core = np.where((share > 0.3)[label], core, self.face_weights)
        sets = [np.flatnonzero((label == p) & (core > 0)) for p in range(label.max() + 1)]
        motions = fit_motions(self.moments(label, core))
        for _ in range(3):
            off = self.face_costs(motions)[np.arange(len(label)), label] / self.face_weights
            # residuals below 1e-5 of the square root of the area are rounding
            typical = np.array([np.median(off[inside]) for inside in sets]) + 1e-5**2 * self.area
            motions = fit_motions(self.moments(label, core / (1 + off / typical[label])**2))
        return motions

    def face_costs(self, motions: Motions) -> np.ndarray:
        """Compute the cost (F, P), square metres, of each triangle under each motion, mean over the poses.

        |A x - y|² is expanded, so that the sum over the poses is one matrix product.
        """
        P, M = motions.t.shape[:2]
        A = np.concatenate([motions.R, motions.t[..., None]], axis=-1)
        x1 = np.c_[self.x, np.ones(len(self.x))]
        gram = np.einsum("pmia,pmib->pab", A, A)
        cross = self.y.reshape(len(x1), -1) @ A.transpose(1, 2, 0, 3).reshape(3 * M, 4 * P)
        cost = self._yy[:, None] - 2 * np.einsum("npa,na->np", cross.reshape(-1, P, 4), x1)
        for p in range(P):
            cost[:, p] += np.einsum("na,na->n", x1 @ gram[p], x1)
        corners = np.maximum(cost, 0)[self.mesh.faces].mean(axis=1)
        return corners * (self.face_weights / M)[:, None]


def agglomerate(moments: Moments, contacts: np.ndarray, count: int, partner: np.ndarray | None = None) -> np.ndarray:
    """Join sets that touch, the cheapest union first, down to `count`; return the new number (P,) of every set.

    A set and its mirror image, its `partner` (P,), are joined alike and count as one.
    """
    moments = moments[np.arange(len(moments.w))]
    cost = rigid_costs(moments)
    owner = np.arange(len(cost))
    partner = owner.copy() if partner is None else partner.copy()
    tied = bool((partner != owner).any())
    union: dict[tuple[int, int], float] = {}

    def measure(pairs: list[tuple[int, int]]) -> None:
        if pairs:
            extra = union_costs(moments, np.array(pairs)) - cost[np.array(pairs)].sum(axis=1)
            union.update(zip(pairs, extra.tolist(), strict=True))

    def price(pair: tuple[int, int]) -> float:
        a, b = int(partner[pair[0]]), int(partner[pair[1]])
        return union[pair] + union.get((min(a, b), max(a, b)), union[pair]) if tied else union[pair]

    # keep the extra cost of every union of touching sets; take the cheapest, then update the unions it changed
    measure([(int(a), int(b)) for a, b in contacts])
    remaining = int((partner >= owner).sum())
    while remaining > count and union:
        a, b = min(union, key=price)
        sets = closure(a, b, partner)
        # join on both sides: moments, owners, costs and partners
        gone = {c for together in sets for c in together[1:]}
        remaining -= len({min(c, int(partner[c])) for together in sets for c in together}) - 1
        for together in sets:
            for c in together[1:]:
                moments.absorb(together[0], c)
                owner[owner == c] = together[0]
            cost[together[0]] = rigid_costs(moments[np.array(together[:1])])[0]
        for together, other in zip(sets, sets[::-1], strict=True):
            partner[together[0]] = other[0]
        # unions with a joined set are measured anew
        kept = {together[0] for together in sets}
        touched = [pair for pair in union if not kept.isdisjoint(pair) or not gone.isdisjoint(pair)]
        for pair in touched:
            del union[pair]
        now = {(int(owner[c]), int(owner[d])) for c, d in touched}
        measure(sorted({(min(pair), max(pair)) for pair in now if pair[0] != pair[1]}))
    return np.unique(owner, return_inverse=True)[1]


def halve(moments: Moments, contacts: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Join the sets of many groups (P,) side by side, each down to two, as `agglomerate` does for one group.

    Contacts (n, 2) are between sets of the same group. Returns the surviving set (P,) of each set. Each group ends with
    two sets, or with its number of disconnected pieces.
    """
    moments = moments[np.arange(len(moments.w))]
    cost, owner, pairs = rigid_costs(moments), np.arange(len(group)), contacts
    left = np.bincount(group)
    extra = union_costs(moments, pairs) - cost[pairs].sum(axis=1) if len(pairs) else np.zeros(0)
    while True:
        # groups with more than two sets join their cheapest pair, all groups at once
        open_ = left[group[pairs[:, 0]]] > 2
        pairs, extra = pairs[open_], extra[open_]
        if not len(pairs):
            return owner
        order = np.lexsort((extra, group[pairs[:, 0]]))
        first = np.r_[True, np.diff(group[pairs[order, 0]]) > 0]
        kept, gone = pairs[order[first]].T
        left[group[kept]] -= 1
        for array in moments.each():
            array[kept] += array[gone]
        cost[kept] = rigid_costs(moments[kept])
        into = np.arange(len(group))
        into[gone] = kept
        owner = into[owner]
        # unions with a joined set are measured anew
        touched = np.isin(pairs, np.r_[kept, gone]).any(axis=1)
        now = np.sort(into[pairs[touched]], axis=1)
        now = np.unique(now[now[:, 0] != now[:, 1]], axis=0)
        fresh = union_costs(moments, now) - cost[now].sum(axis=1) if len(now) else np.zeros(0)
        pairs, extra = np.concatenate([pairs[~touched], now]), np.r_[extra[~touched], fresh]


def closure(a: int, b: int, partner: np.ndarray) -> list[list[int]]:
    """Return the sets of labels that are merged when a and b are: one set, or two that are mirror images."""
    one, other = {int(a), int(b)}, {int(partner[a]), int(partner[b])}
    return [sorted(one | other)] if one & other else [sorted(one), sorted(other)]
