"""The skeleton of a body from its registered poses."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..batch.steps import Step, once
from ..geometry.mesh import Mesh
from ..threads import one_thread
from .parts import SkeletonConfig
from .search import search_skeleton
from .tree import Skeleton

__all__ = ["SkeletonConfig", "find_skeleton"]


@one_thread()
def find_skeleton(template: Mesh, poses: np.ndarray, config: SkeletonConfig | None = None,
                  progress: Callable[[int, int], None] | None = None, step: Step = once) -> Skeleton:
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
        Keeps what was found on the way, as `scanprep.batch.steps.Step`.

    Returns
    -------
    Skeleton
        Part 0 lies in the middle of the body.

    Raises
    ------
    ValueError
        A template that is not one connected manifold; poses of another shape, not finite, or too few; no tree of as
        many parts as asked for.

    [SCAPE] §3
    """
    return search_skeleton(template, poses, config, progress, step).skeleton
