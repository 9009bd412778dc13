"""Sums over groups, unique integers, graphs, and sparse symmetric positive definite systems."""
from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from scipy.linalg import solveh_banded
from scipy.sparse import coo_array, csc_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.sparse.linalg import splu


def gatherer(index: np.ndarray, count: int) -> csr_array:
    """Build the matrix (count, n) that sums values by index (n,)."""
    n = len(index)
    return csr_array(coo_array((np.ones(n), (index, np.arange(n))), shape=(count, n)))


def sum_groups(gather: csr_array, values: np.ndarray) -> np.ndarray:
    """Sum values (n, ...) by groups with a `gatherer` into (count, ...)."""
    return (gather @ values.reshape(len(values), math.prod(values.shape[1:]))).reshape(-1, *values.shape[1:])


def unique_integers(numbers: np.ndarray) -> np.ndarray:
    """Return the unique integers (k,), ascending.

    By sorting: NumPy's `unique` hashes integers since 2.3, which takes 25 times as long for a million of them.

    Examples
    --------
    >>> unique_integers(np.array([[3, 1], [1, 2]])).tolist()
    [1, 2, 3]
    """
    ordered = np.sort(numbers, axis=None)
    first = np.ones(len(ordered), dtype=bool)
    first[1:] = ordered[1:] != ordered[:-1]
    return np.asarray(ordered[first])


def label_components(a: np.ndarray, b: np.ndarray, count: int) -> np.ndarray:
    """Label the connected components (count,) of `count` nodes with links from a (n,) to b (n,).

    Examples
    --------
    >>> label_components(np.array([0, 3]), np.array([1, 1]), 4).tolist()
    [0, 0, 1, 0]
    """
    links = coo_array((np.ones(len(a), dtype=bool), (a, b)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1])


def factor(matrix: csc_array) -> Callable[[np.ndarray], np.ndarray]:
    """Factor a sparse symmetric positive definite matrix with SuperLU; return the solver for (n,) or (n, k).

    Symmetric mode without pivoting: default pivoting makes far too much fill-in on the larger systems here. ValueError
    for a singular matrix or one that is not finite.
    """
    try:
        lu = splu(csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                  options={"SymmetricMode": True})
    except RuntimeError as error:
        raise ValueError(f"matrix: the system has no unique solution ({error})") from None
    return lu.solve


class Factored:
    """A factored SPD system for many right-hand sides (CHOLMOD-class supernodal Cholesky from cholespy).

    Slower to factor than `factor`, but several times faster to solve with three or more columns. Pickling stores the
    matrix, which is factored again on loading. ValueError as for `factor`, and for an empty matrix.
    """

    LIMIT = 128                      # most columns that cholespy takes in one call

    def __init__(self, matrix: csc_array) -> None:
        from cholespy import CholeskySolverD, MatrixType

        self._matrix = matrix
        entries = coo_array(matrix)
        self.size = entries.shape[0]
        if not self.size or not np.isfinite(entries.data).all():
            raise ValueError(f"matrix: expected finite entries, got a {self.size} x {self.size} matrix without")
        try:
            self._solver = CholeskySolverD(self.size, entries.row.astype(np.int32), entries.col.astype(np.int32),
                                           entries.data.astype(np.float64), MatrixType.COO)
        except ValueError as error:
            raise ValueError(f"matrix: the system has no unique solution ({error})") from None

    def __reduce__(self) -> tuple[type[Factored], tuple[csc_array]]:
        return Factored, (self._matrix,)

    def solve(self, rhs: np.ndarray) -> np.ndarray:
        """Solve for (n,) or (n, k) right-hand sides."""
        columns = np.ascontiguousarray(rhs.reshape(self.size, -1), dtype=np.float64)
        out = np.empty_like(columns)
        for start in range(0, columns.shape[1], self.LIMIT):
            part = np.ascontiguousarray(columns[:, start:start + self.LIMIT])
            x = np.zeros_like(part)
            self._solver.solve(part, x)
            out[:, start:start + self.LIMIT] = x
        return out.reshape(rhs.shape)


def harmonic(near: csr_array, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Interpolate values (N, k) harmonically from the known ones (N,) bool: each is the mean of its neighbours.

    So none exceeds the known ones. A component without known values keeps its values. `near` (N, N), symmetric, are the
    weights of neighbours.
    """
    _, piece = connected_components(near, directed=False)
    free, fixed = np.flatnonzero(~known & np.isin(piece, np.unique(piece[known]))), np.flatnonzero(known)
    out = np.array(values, dtype=np.float64)
    if len(free):
        L = csr_array(diags_array(near.sum(axis=1)) - near)[free]
        out[free] = factor(csc_array(L[:, free]))(-L[:, fixed] @ out[fixed])
    return out


def solve_smooth(blocks: np.ndarray, stiffness: np.ndarray | float, rhs: np.ndarray) -> np.ndarray:
    """Solve for frames x (T, P) coupled by second differences: `blocks[t] x[t] + stiffness (D₂ᵀ D₂ x)[t] = rhs[t]`.

    `blocks` (T, P, P) are symmetric and positive semidefinite, `stiffness` is (P,) or one number, T at least 3. One
    banded Cholesky factorisation of width 2 P solves all right-hand sides (T, P, m).
    """
    T, P = rhs.shape[:2]
    lower = np.zeros((2 * P + 1, T * P))
    for k in range(P):                               # entries k below the diagonal, inside the blocks
        lower[k].reshape(T, P)[:, :P - k] = np.einsum("tii->ti", blocks[:, k:, :P - k])
    # add the band of D₂ᵀ D₂, and a tiny ridge for unknowns without data
    D = np.array([1.0, -2.0, 1.0])
    for i in range(3):
        for j in range(i, 3):
            lower[(j - i) * P].reshape(T, P)[i:T - 2 + i] += D[i] * D[j] * stiffness
    lower[0] += 1e-9 * lower[0].max()
    return np.asarray(solveh_banded(lower, rhs.reshape(T * P, *rhs.shape[2:]), overwrite_ab=True, lower=True,
                                    check_finite=False).reshape(rhs.shape))


def overlapping_windows(count: int, size: int, overlap: int) -> Iterator[tuple[slice, slice, slice]]:
    """Yield windows over `count` frames, at least 3, for `solve_smooth`: frames to solve, which to keep, and where.

    Neighbouring windows overlap by `overlap` frames, more than the influence of a frame reaches.
    """
    for start in range(0, count, size):
        near = slice(max(0, min(start - overlap, count - 3)), min(count, start + size + overlap))
        end = min(start + size, count)
        yield near, slice(start - near.start, end - near.start), slice(start, end)


def conjugate_gradients(apply: Callable[[np.ndarray], np.ndarray], force: np.ndarray,
                        precondition: Callable[[np.ndarray], np.ndarray], iterations: int = 40,
                        tolerance: float = 1e-4) -> np.ndarray:
    """Solve `apply(d) = force` for arrays of any shape, with a symmetric positive definite `apply`."""
    d, r = np.zeros_like(force), force.copy()
    z = precondition(r)
    p, rz = z, float(np.sum(r * z))
    first = rz
    for _ in range(iterations):
        if rz <= tolerance**2 * first or not rz:
            break
        Ap = apply(p)
        a = rz / float(np.sum(p * Ap))
        d, r = d + a * p, r - a * Ap
        z = precondition(r)
        rz, last = float(np.sum(r * z)), rz
        p = z + rz / last * p
    return d


def spanning_tree(i: np.ndarray, j: np.ndarray, lengths: np.ndarray, n: int) -> csr_array:
    """Find a minimum spanning tree of n points, or a forest if the edges do not connect all.

    Parameters
    ----------
    i, j : (E,) int
        Ends of the edges, in one direction or in both.
    lengths : (E,) float
        Above 0.
    n : int
        Number of points.

    Returns
    -------
    (n, n) csr_array
        Lengths of the edges of the tree.
    """
    # SciPy 1.15, the last for Python 3.10, takes 32-bit indices only
    edges = coo_array((lengths, (i.astype(np.int32), j.astype(np.int32))), shape=(n, n))
    return csr_array(minimum_spanning_tree(edges.tocsr()))
