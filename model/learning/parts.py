"""How many parts: as many as predict poses that were left out."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from scanprep.batch.room import Step, run_uncached
from scanprep.decimation.decimate import decimate
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.parts import SkeletonConfig
from scanprep.skeleton.restarts import SkeletonFinder
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread

from ..blending import BlendedTemplate, rigid_weights
from ..human_poses import is_person
from .config import LearnConfig
from .scape import Progress, ProgressShares, learn_pose

QUICK = LearnConfig(prunings=(0.01,), ridges=(1e-3, 1e-2), refinements=1)
MORE, TRIES = 4, 3                   # parts more each time, and the largest number of times
VERTICES = 2500                      # of the coarse copies on which the models are learned that are compared


@dataclass(frozen=True, eq=False)
class ChosenSkeleton:
    """A skeleton, and the errors of poses that were left out, metres, by the number of parts."""

    skeleton: Skeleton
    errors: dict[int, float]


@one_thread()
def choose_skeleton(template: Mesh, poses: np.ndarray, progress: Progress | None = None, step: Step = run_uncached,
                    known: np.ndarray | None = None) -> ChosenSkeleton:
    """A skeleton with as many parts as help to predict poses that were left out.

    The search for rigid parts stops where surfaces no longer meet in a joint. A trunk or a shoulder bends without
    one, and a model of it gains from more parts than that: so finer skeletons are sought from the same restarts, a
    model is learned with each on a coarse copy of the bodies, and they are kept while the error of left-out poses
    falls, and while a person's parts can be named.

    Parameters
    ----------
    template : Mesh
    poses : (M, N, 3) float, metres
        Of one person.
    progress : callable, optional
        Called with the skeletons done and their largest number.
    step : callable, optional
        Keeps every restart, skeleton and error, as `scanprep.batch.room.Step`.
    known : (K, N, 3) float, metres, optional
        The same person as a prior moves them. They show joints that no pose bends; how many parts there are is chosen
        by the left-out poses alone, which are predicted with the prior as `learn_scape` does. Of a single pose none can
        be left out: then the prior's are.

    Returns
    -------
    ChosenSkeleton

    Raises
    ------
    ValueError
        As `find_skeleton`; a part that is too small for the coarse copies.
    """
    tell = progress or (lambda done, total: None)
    poses = np.asarray(poses, dtype=np.float64)
    settings = SkeletonConfig()
    whole = 1 + settings.restarts + TRIES
    shown = poses if known is None else np.concatenate([poses, known])
    finder = SkeletonFinder(template, shown, settings, lambda done, total: tell(done, whole), step)
    vertices, coarse = coarse_copy(template, VERTICES)

    def tried(parts: int | None) -> tuple[Skeleton, float] | None:
        name = "best parts" if parts is None else f"{parts} parts"
        return step(name, (template, poses, settings, parts, QUICK, VERTICES, known),
                    lambda: _try_parts(finder, parts, coarse, poses[:, vertices],
                                       None if known is None else known[:, vertices]))

    first = tried(None)
    assert first is not None, "what goes wrong without a count of parts is raised"
    best, least = first
    errors = {len(best.parents): least}
    for done in range(1, 1 + TRIES):
        wanted = len(best.parents) + MORE
        finer = tried(wanted)
        tell(settings.restarts + done, whole)
        if finer is None or (is_person(best) and not is_person(finer[0])):
            break                       # the pose prior of people goes by the names of parts, which are lost
        errors[wanted] = finer[1]
        # share of the left-out error that more parts must save to be kept
        if errors[wanted] > (1 - 0.03) * errors[len(best.parents)]:
            break
        best = finer[0]
    tell(whole, whole)
    return ChosenSkeleton(best, errors)


def _try_parts(finder: SkeletonFinder, parts: int | None, coarse: Mesh, poses: np.ndarray, known: np.ndarray | None
               ) -> tuple[Skeleton, float] | None:
    """A skeleton and its error on coarse bodies (M, n, 3), with those of a prior (K, n, 3).

    None where there is no tree of so many parts, or parts are too small to compare.
    """
    try:
        found = finder.skeleton(finder.runs[0] if parts is None else finder.first, parts)[0]
        return found, _leave_out_error(poses, coarse_skeleton(found, finder.template, coarse), coarse, known)
    except ValueError:
        if parts is None:
            raise
        return None


def coarse_copy(template: Mesh, count: int) -> tuple[np.ndarray, Mesh]:
    """About `count` of the template's vertices (n,), and triangles over them alone."""
    if len(template.vertices) <= count:
        return np.arange(len(template.vertices)), template
    small = decimate(template, 2 * count)
    vertex = cKDTree(template.vertices).query(small.vertices)[1]
    kept, faces = np.unique(vertex[small.faces], return_inverse=True)
    faces = faces.reshape(-1, 3)
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return kept, Mesh(template.vertices[kept], faces[distinct])


def coarse_skeleton(skeleton: Skeleton, template: Mesh, coarse: Mesh) -> Skeleton:
    """The skeleton on a coarse copy: every triangle has the part of the nearest one."""
    near = cKDTree(template.corners.mean(axis=1)).query(coarse.corners.mean(axis=1))[1]
    part, joints = skeleton.part_of_face[near], skeleton.joints.copy()
    lost = np.setdiff1d(np.arange(len(skeleton.parents)), part)
    if len(lost):
        raise ValueError(f"vertices: {len(coarse.vertices)} are too few, part {skeleton.names[lost[0]]} is lost")
    unplaced = Skeleton(part, skeleton.parents, joints)
    joints[0] = coarse.vertices[unplaced.part_of_vertex(coarse) == 0].mean(axis=0)
    return Skeleton(part, skeleton.parents, joints)


def _leave_out_error(poses: np.ndarray, skeleton: Skeleton, coarse: Mesh, known: np.ndarray | None) -> float:
    """Mean distance in metres of the vertices of left-out poses (M, n, 3) of the coarse bodies."""
    parts, prior = BlendedTemplate(coarse, skeleton, rigid_weights(skeleton)), None
    if known is not None:
        prior = learn_pose(parts, np.concatenate([coarse.vertices[None], known]), QUICK, ProgressShares(None))
        if len(poses) == 1:
            return prior.design.left_out_error
    return learn_pose(parts, poses, QUICK, ProgressShares(None), prior=prior).design.left_out_error
