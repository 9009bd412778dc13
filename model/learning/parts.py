"""Choice of the number of parts by the error of left-out poses."""
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

QUICK = LearnConfig(prunings=(0.01,), ridges=(1e-3, 1e-2), refinements=1)    # models that are only compared
MORE, TRIES = 4, 3                   # parts added at each try, and most tries


@dataclass(frozen=True, eq=False)
class ChosenSkeleton:
    """A skeleton, and the errors of left-out poses, metres, by the number of parts."""

    skeleton: Skeleton
    errors: dict[int, float]


@one_thread()
def choose_skeleton(template: Mesh, poses: np.ndarray, progress: Progress | None = None, step: Step = run_uncached,
                    known: np.ndarray | None = None) -> ChosenSkeleton:
    """Find a skeleton with as many parts as help to predict left-out poses.

    The search for rigid parts stops where surfaces no longer meet in a joint. But trunk and shoulders bend without
    joints, and need more parts. So finer skeletons are found from the same restarts, and a model is learned with each
    on a coarse copy of the bodies. They are kept while the error of left-out poses falls, and while a person's parts
    can be named.

    Parameters
    ----------
    template : Mesh
        N vertices.
    poses : (M, N, 3) float, metres
        Bodies of one person.
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
    report_progress = progress or (lambda done, total: None)
    poses = np.asarray(poses, dtype=np.float64)
    settings = SkeletonConfig()
    whole = 1 + settings.restarts + TRIES
    shown = poses if known is None else np.concatenate([poses, known])
    finder = SkeletonFinder(template, shown, settings, lambda done, total: report_progress(done, whole), step)
    coarse_vertices = 2500  # of the coarse bodies on which models are compared: a model in seconds
    vertices, coarse = coarse_copy(template, coarse_vertices)

    def tried(parts: int | None) -> tuple[Skeleton, float] | None:
        name = "best parts" if parts is None else f"{parts} parts"
        return step(name, (template, poses, settings, parts, QUICK, coarse_vertices, known),
                    lambda: _try_parts(finder, parts, coarse, poses[:, vertices],
                                       None if known is None else known[:, vertices]))

    first = tried(None)
    assert first is not None, "what goes wrong without a count of parts is raised"
    best, least = first
    errors = {len(best.parents): least}
    for done in range(1, 1 + TRIES):
        wanted = len(best.parents) + MORE
        finer = tried(wanted)
        report_progress(settings.restarts + done, whole)
        if finer is None or (is_person(best) and not is_person(finer[0])):
            break                       # the pose prior of people needs the names of parts, which would be lost
        errors[wanted] = finer[1]
        # more parts must lower the left-out error by 3%, since they cost time and names
        if errors[wanted] > (1 - 0.03) * errors[len(best.parents)]:
            break
        best = finer[0]
    report_progress(whole, whole)
    return ChosenSkeleton(best, errors)


def _try_parts(finder: SkeletonFinder, parts: int | None, coarse: Mesh, poses: np.ndarray, known: np.ndarray | None
               ) -> tuple[Skeleton, float] | None:
    """Find a skeleton with `parts` parts and its error on coarse bodies (M, n, 3), with those of a prior (K, n, 3).

    None where there is no tree of so many parts, or parts are too small to compare.
    """
    try:
        skeleton = finder.skeleton(finder.runs[0] if parts is None else finder.first, parts)[0]
        if parts not in (None, len(skeleton.parents)):
            return None
        return skeleton, _leave_out_error(poses, coarse_skeleton(skeleton, finder.template, coarse), coarse, known)
    except ValueError:
        if parts is None:
            raise
        return None


def coarse_copy(template: Mesh, count: int) -> tuple[np.ndarray, Mesh]:
    """Choose about `count` of the template's vertices (n,), and build triangles over them."""
    if len(template.vertices) <= count:
        return np.arange(len(template.vertices)), template
    small = decimate(template, 2 * count)
    vertex = cKDTree(template.vertices).query(small.vertices)[1]
    kept, faces = np.unique(vertex[small.faces], return_inverse=True)
    faces = faces.reshape(-1, 3)
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return kept, Mesh(template.vertices[kept], faces[distinct])


def coarse_skeleton(skeleton: Skeleton, template: Mesh, coarse: Mesh) -> Skeleton:
    """Transfer the skeleton to a coarse copy: every triangle gets the part of the nearest one."""
    near = cKDTree(template.corners.mean(axis=1)).query(coarse.corners.mean(axis=1))[1]
    part, joints = skeleton.part_of_face[near], skeleton.joints.copy()
    lost = np.setdiff1d(np.arange(len(skeleton.parents)), part)
    if len(lost):
        raise ValueError(f"vertices: {len(coarse.vertices)} are too few, part {skeleton.names[lost[0]]} is lost")
    unplaced = Skeleton(part, skeleton.parents, joints)
    joints[0] = coarse.vertices[unplaced.part_of_vertex(coarse) == 0].mean(axis=0)
    return Skeleton(part, skeleton.parents, joints)


def _leave_out_error(poses: np.ndarray, skeleton: Skeleton, coarse: Mesh, known: np.ndarray | None) -> float:
    """Compute the mean vertex error, metres, of left-out poses (M, n, 3) of the coarse bodies."""
    parts, prior = BlendedTemplate(coarse, skeleton, rigid_weights(skeleton)), None
    if known is not None:
        prior = learn_pose(parts, np.concatenate([coarse.vertices[None], known]), QUICK, ProgressShares(None))
        if len(poses) == 1:
            return prior.design.left_out_error
    return learn_pose(parts, poses, QUICK, ProgressShares(None), prior=prior).design.left_out_error
