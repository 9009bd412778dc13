"""How many parts: as many as predict poses that were left out."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.batch.room import Step, once
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.coarse import VERTICES
from scanprep.skeleton.finder import SkeletonFinder
from scanprep.skeleton.parts import SkeletonConfig
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread

from ..blending import BlendedTemplate, rigid_weights
from .config import LearnConfig
from .scape import Progress, Work, learn_pose

QUICK = LearnConfig(prunings=(0.01,), ridges=(1e-3, 1e-2), refinements=1)
MORE, TRIES = 4, 3                   # parts more each time, and the largest number of times


@dataclass(frozen=True, eq=False)
class ChosenSkeleton:
    """A skeleton, and the errors of poses that were left out, metres, by the number of parts."""

    skeleton: Skeleton
    errors: dict[int, float]


@one_thread()
def choose_skeleton(template: Mesh, poses: np.ndarray, progress: Progress | None = None, step: Step = once
                    ) -> ChosenSkeleton:
    """A skeleton with as many parts as help to predict poses that were left out.

    The search for rigid parts stops where surfaces no longer meet in a joint. A trunk or a shoulder bends without
    one, and a model of it gains from more parts than that: so finer skeletons are sought on a coarse copy of the
    bodies, a model is learned with each, and they are kept while the error of left-out poses falls. The best is carried
    over to the bodies as they are.

    Parameters
    ----------
    template : Mesh
    poses : (M, N, 3) float, metres
        Of one person.
    progress : callable, optional
        Called with the skeletons done and their largest number.
    step : callable, optional
        Keeps every restart, skeleton and error, as `scanprep.batch.room.Step`.

    Raises
    ------
    ValueError
        As `find_skeleton`.
    """
    tell = progress or (lambda done, total: None)
    poses = np.asarray(poses, dtype=np.float64)
    settings = SkeletonConfig()
    whole = 1 + settings.restarts + TRIES
    finder = SkeletonFinder(template, poses, settings, lambda done, total: tell(done, whole), step)

    def tried(parts: int | None) -> tuple[Skeleton, float] | None:
        name = "best parts" if parts is None else f"{parts} parts"
        return step(name, (template, poses, settings, parts, QUICK, VERTICES), lambda: _tried(finder, poses, parts))

    first = tried(None)
    assert first is not None, "what goes wrong without a count of parts is raised"
    best, least = first
    errors = {len(best.parents): least}
    for done in range(1, 1 + TRIES):
        wanted = len(best.parents) + MORE
        finer = tried(wanted)
        tell(settings.restarts + done, whole)
        if finer is None:
            break
        errors[wanted] = finer[1]
        # share of the left-out error that more parts must save to be kept
        if errors[wanted] > (1 - 0.03) * errors[len(best.parents)]:
            break
        best = finer[0]
    chosen = finder.whole_skeleton(best)
    tell(whole, whole)
    return ChosenSkeleton(chosen, errors)


def _tried(finder: SkeletonFinder, poses: np.ndarray, parts: int | None) -> tuple[Skeleton, float] | None:
    """A skeleton on the coarse copy and its error; None where there is no tree of so many parts."""
    try:
        found = finder.coarse_skeleton(parts)[0]
    except ValueError:
        if parts is None:
            raise
        return None
    return found, _left_out_error(finder.copy.transfer(poses), found, finder.coarse.template)


def _left_out_error(poses: np.ndarray, skeleton: Skeleton, coarse: Mesh) -> float:
    """Mean distance in metres of the vertices of left-out poses (M, n, 3) of the coarse bodies."""
    parts = BlendedTemplate(coarse, skeleton, rigid_weights(skeleton))
    return learn_pose(parts, poses, QUICK, Work(None)).design.left_out_error
