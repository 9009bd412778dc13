"""Find the skeleton of a body from its registered poses."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..geometry.mesh import Mesh
from ..threads import one_thread
from .parts import SkeletonConfig
from .restarts import SkeletonFinder
from .symmetry import Symmetry
from .tree import Skeleton

__all__ = ["SkeletonConfig", "find_skeleton", "search_skeleton"]


@dataclass(frozen=True, eq=False)
class SkeletonSearch:
    """A skeleton with the facts of its search."""

    skeleton: Skeleton
    symmetry: Symmetry               # the best mirror symmetry of the body, whether it holds or not
    symmetric: bool                  # left and right have the same parts by construction; borders may differ
    energies: tuple[float, ...]      # of every restart, as a share of the squared size of the body
    parts: tuple[int, ...]           # number of parts that every restart ended with


def find_skeleton(template: Mesh, poses: np.ndarray, config: SkeletonConfig | None = None,
                  progress: Callable[[int, int], None] | None = None) -> Skeleton:
    """Find rigid parts, the tree over them, and the joints, from registered poses of one body.

    Parts that never move against each other in the poses cannot be separated. A symmetric body gets the same parts left
    and right. `search_skeleton` also returns the facts of the search.

    Parameters
    ----------
    template : Mesh
        One connected manifold component.
    poses : (M, N, 3) float, metres
        The template's vertices in at least three poses.
    config : SkeletonConfig, optional
        Settings.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Skeleton
        Part 0, the root, is the part nearest to the rest of the body.

    Raises
    ------
    ValueError
        A template that is not one connected manifold; poses of another shape, not finite, or fewer than three; a
        symmetric skeleton requested of a body without two sides.

    Examples
    --------
    >>> z, turn = np.meshgrid(np.linspace(-1, 1, 21), np.arange(12) * np.pi / 6, indexing="ij")      # a tube
    >>> x = np.stack([0.2 * np.cos(turn), 0.2 * np.sin(turn), z], axis=-1).reshape(-1, 3)
    >>> a, b = np.arange(252).reshape(21, 12), np.roll(np.arange(252).reshape(21, 12), -1, axis=1)
    >>> faces = np.stack([a[:-1], b[:-1], b[1:], a[:-1], b[1:], a[1:]], axis=-1).reshape(-1, 3)
    >>> bend = [[np.r_[p[0], p[1] - k * max(p[2], 0), p[2] - 0.3 * k * max(p[2], 0)] for p in x] for k in (0, 0.3, 0.6)]
    >>> find_skeleton(Mesh(x, faces), np.array(bend), SkeletonConfig(parts=2, restarts=1)).joints.shape
    (2, 3)

    [SCAPE] §3
    """
    return search_skeleton(template, poses, config, progress).skeleton


@one_thread()
def search_skeleton(template: Mesh, poses: np.ndarray, config: SkeletonConfig | None = None,
                    progress: Callable[[int, int], None] | None = None) -> SkeletonSearch:
    """Find a skeleton as `find_skeleton` does, and return it with its symmetry and restarts.

    Arguments and errors are those of `find_skeleton`.

    [Articulated]
    """
    config = config or SkeletonConfig()
    finder = SkeletonFinder(template, poses, config, progress)
    # the restart with the best score; its tree is adapted to the requested number of parts
    best = finder.runs[0]
    skeleton, symmetric = finder.skeleton(best, config.parts)
    search = SkeletonSearch(skeleton, finder.symmetry, symmetric,
                            tuple(run.energy for run in finder.runs), tuple(len(run.links) + 1 for run in finder.runs))
    if progress is not None:
        progress(config.restarts + 1, config.restarts + 1)
    return search


def skeleton_problem(found: SkeletonSearch, wanted: int | None) -> str | None:
    """Explain why a skeleton is meaningless, with the likely cause; None where it is not, or one part was requested."""
    if len(found.skeleton.parents) > 1 or wanted == 1:
        return None
    return "the body has one part and no joint; the meshes do not differ in pose, or are smaller than their unit says?"
