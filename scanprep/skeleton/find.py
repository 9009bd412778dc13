"""The skeleton of a body from its registered poses, and how it was found."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..batch.room import Step, run_uncached
from ..geometry.mesh import Mesh
from ..threads import one_thread
from .joints import Loop
from .parts import SkeletonConfig
from .restarts import SkeletonFinder
from .symmetry import Symmetry
from .tree import Skeleton

__all__ = ["SkeletonConfig", "find_skeleton", "search_skeleton"]


@dataclass(frozen=True)
class OpenedLoop:
    """A loop of parts that had to be opened for a tree."""

    parts: tuple[str, str]  # those that lie where it was opened; twice the same when they became one
    joined: bool  # whether they became one; else only the link between them was dropped
    length: int  # number of links that lay on loops


@dataclass(frozen=True, eq=False)
class SkeletonSearch:
    """A skeleton and how it was found."""

    skeleton: Skeleton
    loops: tuple[OpenedLoop, ...]
    symmetry: Symmetry               # the best mirror symmetry of the body, whether it holds or not
    symmetric: bool                  # left and right have the same parts by construction, only borders may differ
    energies: tuple[float, ...]      # of every restart, as a share of the squared size of the body
    parts: tuple[int, ...]           # number of parts that every restart ended with


def find_skeleton(template: Mesh, poses: np.ndarray, config: SkeletonConfig | None = None,
                  progress: Callable[[int, int], None] | None = None, step: Step = run_uncached) -> Skeleton:
    """Rigid parts, the tree over them, and the joints, from registered poses of one body.

    Parts that never move against each other in the poses cannot be told apart. Of a symmetric body left and right
    get the same parts. `search_skeleton` tells more of how they were found.

    Parameters
    ----------
    template : Mesh
    poses : (M, N, 3) float, metres
        The template's vertices in at least three poses.
    config : SkeletonConfig, optional
    progress : callable(done, total), optional
    step : callable, optional
        Keeps what was found on the way, as `scanprep.batch.room.Step`.

    Returns
    -------
    Skeleton
        Part 0 lies in the middle of the body.

    Raises
    ------
    ValueError
        A template that is not one connected manifold; poses of another shape, not finite, or too few; no tree of as
        many parts as asked for; a symmetric skeleton asked for where no part has a mirror image.

    [SCAPE] §3
    """
    return search_skeleton(template, poses, config, progress, step).skeleton


@one_thread()
def search_skeleton(template: Mesh, poses: np.ndarray, config: SkeletonConfig | None = None,
                    progress: Callable[[int, int], None] | None = None, step: Step = run_uncached) -> SkeletonSearch:
    """The skeleton of `find_skeleton`, with the loops, the symmetry and the restarts it came from.

    Arguments and errors are those of `find_skeleton`; `step` keeps every restart.

    [Articulated]
    """
    config = config or SkeletonConfig()
    finder = SkeletonFinder(template, poses, config, progress, step)
    best = finder.runs[0]
    skeleton, symmetric = finder.skeleton(best, config.parts)
    loops = tuple(_name_loop(loop, skeleton) for loop in best.loops)
    found = SkeletonSearch(skeleton, loops, finder.symmetry, symmetric,
                           tuple(run.energy for run in finder.runs), tuple(len(run.links) + 1 for run in finder.runs))
    if progress is not None:
        progress(config.restarts + 1, config.restarts + 1)
    return found


def skeleton_problem(found: SkeletonSearch, wanted: int | None) -> str | None:
    """Why a skeleton means nothing, with the likely cause; None where it does, also where `wanted` is one part."""
    if len(found.skeleton.parents) > 1 or wanted == 1:
        return None
    return "the body has one part and no joint; the meshes do not differ in pose, or are smaller than their unit says?"


def _name_loop(loop: Loop, skeleton: Skeleton) -> OpenedLoop:
    """A loop with the names of the parts that hold most of its two sides."""
    a, b = (skeleton.names[int(np.bincount(skeleton.part_of_face[side]).argmax())] for side in loop.sides)
    return OpenedLoop((a, b), loop.joined, loop.length)
