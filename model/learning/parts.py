"""Choice of the number of parts by the error of left-out poses."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from scanprep.batch.room import Step, run_uncached
from scanprep.decimation.decimate import decimate
from scanprep.geometry.mesh import Mesh, take_any_mesh
from scanprep.judgement import size
from scanprep.skeleton.parts import SkeletonConfig
from scanprep.skeleton.restarts import SkeletonFinder
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread
from scanprep.words import describe_result

from ..blending import BlendedTemplate, rigid_weights
from ..human_poses import is_person
from .config import LearnConfig
from .scape import Progress, ProgressShares, learn_pose

QUICK = LearnConfig(prunings=(0.01,), ridges=(1e-3, 1e-2), refinements=1)    # models that are only compared
MORE, TRIES = 4, 10                  # parts added at each try, and most tries
# More parts cost time and names, so they must lower the left-out error: by 3% up to 20 parts, as many as people have,
# and in proportion beyond. Without that an animal of 12 bones got 44 parts.
GAIN, USUAL = 0.03, 20
FINE = 0.003                         # of the body's size, 4 mm on a man: as exact as scans are registered, and enough
VAIN = 2                             # tries in a row without such a gain end the search


@dataclass(frozen=True, eq=False)
class ChosenSkeleton:
    """A skeleton, and what it was chosen from.

    Attributes
    ----------
    skeleton : Skeleton
        With as many parts as help to predict left-out poses.
    errors : dict of int to float, metres
        Error of left-out poses by the number of parts that were tried, with sides as in the skeleton.
    tied : bool
        Whether left and right have the same parts by construction.

    Examples
    --------
    >>> from scanprep.synthetic.topology import load_topology
    >>> mesh = load_topology().mesh
    >>> whole = Skeleton(np.zeros(len(mesh.faces), dtype=int), [-1], mesh.vertices.mean(axis=0)[None])
    >>> ChosenSkeleton(whole, {1: 0.0101, 4: 0.014, 8: 0.01}, True).error
    0.0101
    """

    skeleton: Skeleton
    errors: dict[int, float]
    tied: bool
    __repr__ = describe_result

    @property
    def error(self) -> float:
        """Error of left-out poses with the chosen parts, metres."""
        return self.errors[len(self.skeleton.parents)]


@take_any_mesh
@one_thread()
def choose_skeleton(template: Mesh, poses: np.ndarray, progress: Progress | None = None, step: Step = run_uncached,
                    known: np.ndarray | None = None) -> ChosenSkeleton:
    """Find a skeleton with as many parts as help to predict left-out poses.

    The search for rigid parts stops where surfaces no longer meet in a joint. But trunk and shoulders bend without
    joints, and need more parts. So finer skeletons are found from the same restarts, and a model is learned with each
    on a coarse copy of the bodies. They are kept while the error of left-out poses falls and is not yet as small as
    that of registration, and while a person's parts can be named. On a body with two sides, skeletons with the same
    parts left and right compete with free ones; those of a person stay alike.

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

    Examples
    --------
    >>> from model import load_built_in_model
    >>> people = load_built_in_model()
    >>> poses = people.subject(None).vertices(people.pose_examples[:3])
    >>> choose_skeleton(people.template, poses).skeleton.part_of_face.shape == (len(people.template.faces),)
    True
    """
    poses = np.asarray(poses, dtype=np.float64)
    search = PartsSearch(template, poses, known, progress or (lambda done, total: None), step)
    chosen = search.choose(None)
    # sides that are tied harm a body that stands crooked; the names of a person need them
    if chosen.tied and not is_person(chosen.skeleton):
        free = search.choose(False)
        chosen = free if free.error < (1 - GAIN) * chosen.error else chosen
    search.report_progress(search.whole, search.whole)
    return chosen


class PartsSearch:
    """The search for the number of parts, by the error of left-out poses of coarse bodies; see `choose_skeleton`."""

    COARSE = 2500                    # vertices of the bodies on which models are compared: a model in seconds

    def __init__(self, template: Mesh, poses: np.ndarray, known: np.ndarray | None, report_progress: Progress,
                 step: Step) -> None:
        self.template, self.poses, self.known = template, poses, known
        self.report_progress, self.step = report_progress, step
        self.vertices, self.coarse = coarse_copy(template, self.COARSE)
        self.each = 1 + SkeletonConfig().restarts + TRIES      # skeletons with sides one way
        self.whole, self.begun = 2 * self.each, 0

    def choose(self, symmetric: bool | None) -> ChosenSkeleton:
        """Choose the number of parts, with sides alike or free; by default alike where the body is symmetric."""
        settings = SkeletonConfig(symmetric=symmetric)
        before, self.begun = self.begun, self.begun + self.each
        shown = self.poses if self.known is None else np.concatenate([self.poses, self.known])
        finder = SkeletonFinder(self.template, shown, settings,
                                lambda done, total: self.report_progress(before + done, self.whole), self.step)
        first = self._try(finder, settings, None)
        assert first is not None, "what goes wrong without a count of parts is raised"
        best, least = first
        errors, vain, tries = {len(best.parents): least}, 0, 0
        fine = FINE * size(self.template)
        while tries < TRIES and vain < VAIN and least > fine:
            wanted, tries, vain = len(best.parents) + MORE * (1 + vain), tries + 1, vain + 1
            finer = self._try(finder, settings, wanted)
            self.report_progress(before + settings.restarts + tries, self.whole)
            # the pose prior of people needs the names of parts, which a finer skeleton may lose
            if finer is None or (is_person(best) and not is_person(finer[0])):
                continue
            count = len(finer[0].parents)
            errors[count] = min(errors.get(count, np.inf), finer[1])
            if finer[1] <= (1 - GAIN * max(1, wanted / USUAL)) * least:
                (best, least), vain = finer, 0
        return ChosenSkeleton(best, errors, finder.runs[0].search.sides.tied)

    def _try(self, finder: SkeletonFinder, settings: SkeletonConfig, parts: int | None
             ) -> tuple[Skeleton, float] | None:
        """Find a skeleton with `parts` parts, or the nearest number, and its error on the coarse bodies.

        None where parts are too small to compare.
        """
        def make() -> tuple[Skeleton, float] | None:
            try:
                skeleton = finder.skeleton(finder.runs[0] if parts is None else finder.first, parts)[0]
                return skeleton, self._predict_left_out(coarse_skeleton(skeleton, self.template, self.coarse))
            except ValueError:
                if parts is None:
                    raise
                return None

        name = f"{'' if settings.symmetric is None else 'free, '}{'best' if parts is None else parts} parts"
        inputs = self.template, self.poses, settings, parts, QUICK, self.COARSE, self.known
        return self.step(name, inputs, make)

    def _predict_left_out(self, skeleton: Skeleton) -> float:
        """Compute the mean vertex error, metres, of left-out poses of the coarse bodies."""
        parts, prior = BlendedTemplate(self.coarse, skeleton, rigid_weights(skeleton)), None
        poses = self.poses[:, self.vertices]
        if self.known is not None:
            known = np.concatenate([self.coarse.vertices[None], self.known[:, self.vertices]])
            prior = learn_pose(parts, known, QUICK, ProgressShares(None))
            if len(poses) == 1:
                return prior.design.left_out_error
        return learn_pose(parts, poses, QUICK, ProgressShares(None), prior=prior).design.left_out_error


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
