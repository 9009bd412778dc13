"""The fast path of a whole SCAPE body: the stitching system condensed onto the borders of the parts.

Inside a part, triangles follow few rotations and few features. So the stitched inside is a small table, once the
vertices on the part's border are known. With Eq. 2's normal matrix L = GᵀG, inner vertices i and border vertices b:

    y_i = U_p + H_p y_b          U_p = L_ii⁻¹ G_iᵀ e_p,    H_p = -L_ii⁻¹ L_ib
    y_b = A Σ_p (G_b + G_i H_p)ᵀ e_p                       A = S⁻¹ of the Schur complement S = L_bb + Σ_p L_bi H_p

The edges e_p are linear in betas and in products of features and rotations; so are U_p and the loads on the border.
A body with new betas is one product of betas and tables: no system is solved again. A pose reads a third of the numbers
that the equivalent products of all vertices hold (`Products`).

[SCAPE] Eq. 2, Eq. 9
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csc_array, csr_array, eye_array, sparray

from scanprep.geometry.sparse import Factored, gatherer
from scanprep.skeleton.tree import Skeleton

from .bilinear import ShapedPoints
from .linear import PointOperator, find_single_rows
from .products import Products, ShapedProducts, Terms
from .stitching import edge_operator

AT_ONCE = 96                         # coordinates made together: more would leave the cache, fewer waste the products
MANY = 10                            # beyond a tenth of the vertices all products are made (77 ms for 12,500), not some


@dataclass(frozen=True, eq=False)
class PartSystem:
    """The stitching system of one part, with its border held.

    `faces` (f,) are its triangles, `inside` (i,) its inner vertices, `places` (b,) its border among all border
    vertices. `loads` are the same places; part 0 has one more, for the root's joint. `spread` is H (i, b).
    `edge_operator` (2f, i + b) gives the edges of the triangles.
    """

    faces: np.ndarray
    inside: np.ndarray
    places: np.ndarray
    loads: np.ndarray
    spread: np.ndarray
    edge_operator: csc_array
    root_weights: np.ndarray
    factored: Factored | None

    def table(self, edges: np.ndarray) -> np.ndarray:
        """Solve for the inside and the loads on the border, (i + loads, k), that wanted edges (2f, k) bring about."""
        load, i = self.edge_operator.T @ edges, len(self.inside)
        U = load[:0] if self.factored is None else self.factored.solve(load[:i])
        rows = [U, load[i:] + self.spread.T @ load[:i]]
        if len(self.loads) > len(self.places):
            rows.append((self.root_weights @ U)[None])
        return np.concatenate(rows)


@dataclass(eq=False)
class Condensation:
    """The stitching system of a triangulation, condensed once onto the n `border` vertices where parts meet.

    Parameters
    ----------
    faces : (F, 3) int
    part_of_face : (F,) int
    root_weights : (N,) float
        Weights of the vertices whose mean is the root's joint.
    """

    faces: np.ndarray
    part_of_face: np.ndarray
    root_weights: np.ndarray

    def __post_init__(self) -> None:
        self.n_vertices, J = len(self.root_weights), self.part_of_face.max() + 1
        # border vertices belong to triangles of more than one part
        touches = np.zeros((self.n_vertices, J), dtype=bool)
        touches[self.faces, self.part_of_face[:, None]] = True
        on_border = touches.sum(axis=1) > 1
        on_border[0] |= not on_border.any()                     # one part alone is held at a vertex
        self.border, root = np.flatnonzero(on_border), self.root_weights
        n, G = len(self.border), edge_operator(self.faces, self.n_vertices).tocsr()

        # the Schur complement, and how the root's joint follows the border, both part by part
        S, follow = np.zeros((n, n)), root[self.border].copy()
        self.parts: list[PartSystem] = []
        for p in range(J):
            faces = np.flatnonzero(self.part_of_face == p)
            inside, border = (np.flatnonzero(touches[:, p] & chosen) for chosen in (~on_border, on_border))
            places, i = np.searchsorted(self.border, border), len(inside)
            own = csc_array(G[(2 * faces[:, None] + np.arange(2)).ravel()][:, np.r_[inside, border]])
            L = csc_array(own.T @ own)
            factored = Factored(csc_array(L[:i, :i])) if i else None
            spread = -factored.solve(L[:i, i:].toarray()) if factored is not None else np.zeros((0, len(border)))
            S[np.ix_(places, places)] += L[i:, i:].toarray() + L[i:, :i] @ spread
            follow[places] += spread.T @ root[inside]
            loads = np.r_[places, n] if p == 0 else places
            self.parts.append(PartSystem(faces, inside, places, loads, spread, own, root[inside], factored))

        # edges do not fix the place; loads sum to zero, so one more entry fixes it and changes nothing else
        S[0, 0] += 1
        self.factored, self.follow = Factored(csc_array(S)), follow
        self._spreads: dict[Any, list[np.ndarray]] = {}

        # vertices are worked on in the order of the parts' insides, then the border; `place_of` finds each there
        self.inside = slices([len(part.inside) for part in self.parts])
        order = np.concatenate([*[part.inside for part in self.parts], self.border])
        self.place_of = np.argsort(order)

        # sums of all loads, and the border vertices around the parts, one part after the other
        self.scatter = gatherer(np.concatenate([part.loads for part in self.parts]), n + 1)
        self.all_places = np.concatenate([part.places for part in self.parts])
        self.places_of = slices([len(part.places) for part in self.parts])

    def __reduce__(self) -> tuple[type[Condensation], tuple[np.ndarray, ...]]:
        return Condensation, (self.faces, self.part_of_face, self.root_weights)      # factors are made anew on reading

    @cached_property
    def answer(self) -> np.ndarray:
        """A (n, n + 1): the border positions by the loads; the last load is that of the root's joint.

        The root's joint is in the origin.
        """
        A = self.factored.solve(np.eye(len(self.border)) - self.follow[:, None]).T
        return np.concatenate([A, -np.ones((len(A), 1))], axis=1)

    def reach(self, ids: np.ndarray) -> np.ndarray:
        """Compute the shift (n + 1, L) of vertices (L,) by a unit load on each border vertex and the root's joint."""
        place, answer = self.place_of[ids], self.answer.T
        out = np.empty((len(answer), len(ids)))
        of_border = place - (self.n_vertices - len(self.border))          # negative for vertices inside a part
        out[:, of_border >= 0] = answer[:, of_border[of_border >= 0]]
        for part, inside in zip(self.parts, self.inside, strict=True):
            inner = np.flatnonzero((place >= inside.start) & (place < inside.stop))
            if len(inner):
                out[:, inner] = answer[:, part.places] @ part.spread[place[inner] - inside.start].T
        return out

    def spreads(self, dtype: Any) -> list[np.ndarray]:
        """Return Hᵀ (b, i) of every part, contiguous, in a number type."""
        if dtype not in self._spreads:
            self._spreads[dtype] = [np.ascontiguousarray(part.spread.T, dtype=dtype) for part in self.parts]
        return self._spreads[dtype]


@dataclass(frozen=True, eq=False)
class Condensed(PointOperator):
    """The fast path of all vertices of a body of fixed shape.

    Parameters
    ----------
    system : Condensation
    terms : Terms
        Products of features and rotations, in the order of the parts of the triangles that they shape.
    tables : J arrays (M_p, 3, i_p + loads_p), metres
        What each product of a part contributes to the vertices inside it and to the loads on its border.
    origin : (3,) float, metres
        The root's joint when trans is zero.
    """

    system: Condensation
    terms: Terms
    tables: tuple[np.ndarray, ...]
    origin: np.ndarray

    @property
    def skeleton(self) -> Skeleton:
        return self.terms.skeleton

    @property
    def count(self) -> int:
        return self.system.n_vertices

    @property
    def load(self) -> int:
        return self.terms.count + 4 * len(self.skeleton.parents)

    def relative_positions(self, pose: np.ndarray) -> np.ndarray:
        dtype = self.tables[0].dtype
        W = np.moveaxis(self.terms.weights(pose).astype(dtype, copy=False), -3, -2)        # (..., i, m, j)
        W = W.reshape(-1, self.terms.count, 3)
        # a few coordinates at a time: products of a part times its table, then the parts are joined
        y = np.empty((len(W), self.count), dtype=dtype)
        for start in range(0, len(W), AT_ONCE):
            batch = W[start:start + AT_ONCE]
            y[start:start + AT_ONCE] = assemble_vertices(self.system, [
                multiply_rows(batch[:, products].reshape(len(batch), -1), table.reshape(-1, table.shape[2]))
                for products, table in zip(self.products_of_part, self.tables, strict=True)])
        return y.reshape(*pose.shape[:-2], 3, self.count)

    @cached_property
    def products_of_part(self) -> list[slice]:
        """The products of each part, by number among all."""
        return slices([len(table) for table in self.tables])

    def columns(self, pose: np.ndarray, trans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.products.columns(pose, trans)

    @cached_property
    def products(self) -> Products:
        """The same body as products of all vertices; derivatives by the pose need these."""
        return self.of_vertices(np.arange(self.count))

    def of_vertices(self, ids: np.ndarray) -> Products:
        """Build the fast path of some vertices (L,) as products."""
        system, tables = self.system, [table.reshape(-1, table.shape[2]) for table in self.tables]
        dtype, rows = tables[0].dtype, slices([len(table) for table in tables])
        # where the vertices stand among insides and border
        place, n = system.place_of[ids], len(system.border)
        of_border = place - (system.n_vertices - n)                       # negative for vertices inside a part
        of_part = [np.flatnonzero((place >= run.start) & (place < run.stop)) for run in system.inside]

        # vertices on the border first; those inside follow it by H, and have the table of their own part
        around = self._around
        T = np.empty((rows[-1].stop, len(ids)), dtype=dtype)
        T[:, of_border >= 0] = around[:, of_border[of_border >= 0]]
        for p, (run, chosen) in enumerate(zip(rows, of_part, strict=True)):
            if len(chosen):
                at = place[chosen] - system.inside[p].start
                T[:, chosen] = around[:, system.parts[p].places] @ system.spreads(dtype)[p][:, at]
                T[run, chosen] += tables[p][:, at]
        return Products(self.terms, T.reshape(self.terms.count, 3, len(ids)), self.origin)

    @cached_property
    def _around(self) -> np.ndarray:
        """(3M, n) the border positions that every product brings about."""
        answer = self.system.answer.T.astype(self.tables[0].dtype, copy=False)
        return np.concatenate([table.reshape(-1, table.shape[2])[:, len(part.inside):] @ answer[part.loads]
                               for part, table in zip(self.system.parts, self.tables, strict=True)])

    def combine(self, weights: np.ndarray | sparray) -> Products:
        used, mixed = find_needed_vertices(weights)
        # a fit matches other vertices in every round: beyond a tenth of them, products of all are made and kept
        if "products" in self.__dict__ or len(used) * MANY > self.count:
            return self.products.combine(weights)
        some = self.of_vertices(used)
        return some if mixed is None else some.combine(mixed)

    def plus(self, factor: float, other: PointOperator) -> Condensed:
        assert isinstance(other, Condensed), "of the same kind of model"
        tables = tuple(a + a.dtype.type(factor) * b for a, b in zip(self.tables, other.tables, strict=True))
        return replace(self, tables=tables, origin=self.origin + factor * other.origin)

    def scale_by(self, factor: float) -> Condensed:
        return replace(self, tables=tuple((factor * table).astype(table.dtype) for table in self.tables))

    def astype(self, dtype: Any) -> Condensed:
        return replace(self, tables=tuple(table.astype(dtype, copy=False) for table in self.tables))


def find_needed_vertices(weights: np.ndarray | sparray) -> tuple[np.ndarray, csr_array | None]:
    """Find the vertices (n,) that combinations (L, N) need, and the weights (L, n) of these.

    The weights are None where each combination is a single vertex.
    """
    rows = find_single_rows(weights)
    if rows is not None:
        return np.asarray(rows), None
    sparse = csr_array(weights)
    used, place = np.unique(sparse.indices, return_inverse=True)
    return used, csr_array((sparse.data, place, sparse.indptr), shape=(sparse.shape[0], len(used)))


def assemble_vertices(system: Condensation, local: list[np.ndarray]) -> np.ndarray:
    """Join the parts: all vertices (k, N) from insides and loads (k, i_p + loads_p), k coordinates at once.

    [SCAPE] Eq. 2
    """
    k, dtype, n = len(local[0]), local[0].dtype, len(system.border)
    # border: sum the loads of all parts, solve the Schur complement, and put the root's joint in the origin
    left = np.concatenate([rows[:, some.stop - some.start:] for rows, some in zip(local, system.inside, strict=True)],
                          axis=1)
    loads = system.scatter @ left.T
    around = system.factored.solve(loads[:n]).T
    around = np.ascontiguousarray(around - (around @ system.follow + loads[n])[:, None], dtype=dtype)

    # insides: y_i = U_p + H_p y_b
    y, by_part = np.empty((k, system.n_vertices), dtype=dtype), around[:, system.all_places]
    y[:, -n:] = around
    for some, places, spread, rows in zip(system.inside, system.places_of, system.spreads(dtype), local, strict=True):
        np.add(multiply_rows(by_part[:, places], spread), rows[:, :some.stop - some.start], out=y[:, some])
    return np.take(y, system.place_of, axis=1)


def multiply_rows(rows: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Multiply `rows @ matrix`; up to three rows go one by one, which BLAS does in two thirds of the time."""
    return (rows[:, None] @ matrix)[:, 0] if len(rows) <= 3 else rows @ matrix


def slices(lengths: list[int]) -> list[slice]:
    """Return the slices of parts with these lengths that stand one after the other."""
    ends = np.cumsum(lengths).tolist()
    return [slice(end - length, end) for end, length in zip(ends, lengths, strict=True)]


@dataclass(frozen=True, eq=False)
class ShapedCondensed(ShapedPoints):
    """All vertices of a body with unknown betas: tables of the template's own body, the mean person, and each beta.

    `flat` (K, n) holds the change of all tables by each beta, table after table in the order of `mean.tables`.
    """

    own: Condensed
    mean: Condensed
    flat: np.ndarray

    @property
    def skeleton(self) -> Skeleton:
        return self.mean.skeleton

    @property
    def count(self) -> int:
        return self.mean.count

    @property
    def n_betas(self) -> int:
        return len(self.flat)

    @property
    def load(self) -> int:
        return self.mean.load

    def operator(self, betas: np.ndarray | None = None) -> Condensed:
        if betas is None:
            return self.own
        betas = self._check_betas(betas)
        flat = betas @ self.flat[:len(betas)]
        tables = tuple(mean + flat[chosen].reshape(mean.shape) for chosen, mean in
                       zip(self._slices, self.mean.tables, strict=True))
        return replace(self.mean, tables=tables)

    def bodies(self, poses: np.ndarray, betas: np.ndarray) -> np.ndarray:
        """Compute the vertices (B, N, 3), metres, of poses (B, J, 3) and betas (B, k), each body with its own.

        The template's root joint is in the origin.
        """
        mean, W = self.mean, np.moveaxis(self.mean.terms.weights(poses), -3, -2)                # (B, i, m, j)
        out = np.empty((len(poses), self.count, 3))
        for start in range(0, len(poses), AT_ONCE // 3):
            # tables of every person, times the products of the person's pose, part by part
            batch = slice(start, start + AT_ONCE // 3)
            flat, local = betas[batch] @ self.flat[:betas.shape[1]], []
            for products, chosen, table in zip(mean.products_of_part, self._slices, mean.tables, strict=True):
                tables = (flat[:, chosen] + table.ravel()).reshape(len(flat), 3 * len(table), table.shape[2])
                rows = W[batch][:, :, products].reshape(len(flat), 3, -1) @ tables
                local.append(rows.reshape(-1, table.shape[2]))
            out[batch] = np.swapaxes(assemble_vertices(mean.system, local).reshape(len(flat), 3, -1), 1, 2)
        return out

    @cached_property
    def _slices(self) -> list[slice]:
        return slices([table.size for table in self.mean.tables])

    def shape_jacobian(self, pose: np.ndarray) -> np.ndarray:
        pose = np.asarray(pose, dtype=np.float64)
        K, terms = self.n_betas, self.mean.terms
        W = np.moveaxis(terms.weights(pose), -3, -2).reshape(-1, terms.count, 3)
        # the same products as for a body, times the change of the tables by each beta
        local = []
        for products, flat, table in zip(self.mean.products_of_part, self._slices, self.mean.tables, strict=True):
            change = self.flat[:, flat].reshape(K, 3 * len(table), table.shape[2])
            rows = W[:, products].reshape(len(W), 1, 1, -1) @ change                            # (B 3, K, 1, rows)
            local.append(rows.reshape(-1, table.shape[2]))
        y = assemble_vertices(self.mean.system, local).reshape(*pose.shape[:-2], 3, K, self.count)
        return np.moveaxis(y, -1, -3)

    def combine(self, weights: np.ndarray | sparray) -> ShapedProducts:
        used, mixed = find_needed_vertices(weights)
        system, L, basis = self.mean.system, len(used), []
        reach, place = system.reach(used), system.place_of[used]
        # of every part, the tables of both bodies and of all betas are rows of one product: border, then inside
        for part, inside, chosen, own, mean in zip(system.parts, system.inside, self._slices, self.own.tables,
                                                   self.mean.tables, strict=True):
            rows = np.concatenate([own.reshape(1, -1), mean.reshape(1, -1), self.flat[:, chosen]])
            rows = rows.reshape(-1, mean.shape[2])
            moved = rows[:, len(part.inside):] @ reach[part.loads]
            inner = np.flatnonzero((place >= inside.start) & (place < inside.stop))
            moved[:, inner] += rows[:, place[inner] - inside.start]
            basis.append(moved.reshape(2 + self.n_betas, len(mean), 3, L))
        T = np.concatenate(basis, axis=1)
        points = ShapedProducts(self.mean.terms, T[0], T[1], T[2:], self.mean.origin)
        return points if mixed is None else points.combine(mixed)

    def concatenate(self, other: ShapedPoints) -> ShapedProducts:
        return self.combine(eye_array(self.count, format="csr")).concatenate(other)

    def along(self, directions: np.ndarray) -> ShapedCondensed:
        return replace(self, flat=directions @ self.flat)

    def first(self, n_betas: int) -> ShapedCondensed:
        return replace(self, flat=self.flat[:n_betas])
