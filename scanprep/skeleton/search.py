"""The search for a skeleton: begun anew several times, the best result kept, and what was found on the way."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..batch.steps import Step, once
from ..geometry.mesh import Mesh, check_template
from ..threads import one_thread
from .bands import dissolve_bands, passages
from .joints import (
    LOOP_SEPARATION,
    Loop,
    fewer_parts,
    middle_part,
    more_parts,
    place_joints,
    to_tree,
    tree_of,
    without_weak,
)
from .motions import PosedSurface
from .names import names_by_symmetry
from .parts import PartSearch, SkeletonConfig, find_parts
from .symmetry import Symmetry, find_symmetry
from .tree import Skeleton, reorder

LEAST_GAIN = 0.005               # of the score: less is no improvement
Tree = tuple[np.ndarray, np.ndarray, list[Loop]]
LOOSE = 0.85                     # of the energy: where sides let go find so much less, the body is not symmetric


@dataclass(frozen=True, eq=False)
class Restart:
    """One beginning of the search and where it ended.

    Attributes
    ----------
    label : (F,) int
        Parts.
    links : (P - 1, 2) int
    loops : the loops that were opened
    energy : float
        Residual of the parts and price of their borders, as a share of the squared size of the body.
    score : float
        Logarithm of the energy, and what every part must be worth; the lowest is best.
    search : PartSearch
    """

    label: np.ndarray
    links: np.ndarray
    loops: tuple[Loop, ...]
    energy: float
    score: float
    search: PartSearch


@dataclass(frozen=True)
class OpenedLoop:
    """A loop of parts that had to be opened for a tree.

    Attributes
    ----------
    parts : two strings
        Names of the parts that lie where it was opened; twice the same when they became one.
    joined : bool
        Whether they became one; else only the link between them was dropped.
    length : int
        Number of links that lay on loops.
    """

    parts: tuple[str, str]
    joined: bool
    length: int


@dataclass(frozen=True, eq=False)
class SkeletonSearch:
    """A skeleton and how it was found.

    Attributes
    ----------
    skeleton : Skeleton
    loops : tuple of OpenedLoop
    symmetry : Symmetry
        The best mirror symmetry of the body, whether it holds or not.
    symmetric : bool
        Whether left and right have the same parts by construction; only borders may differ, as far as the poses show.
    energies : tuple of float
        Of every restart, as a share of the squared size of the body.
    parts : tuple of int
        Number of parts that every restart ended with.
    restarts : int
    """

    skeleton: Skeleton
    loops: tuple[OpenedLoop, ...]
    symmetry: Symmetry
    symmetric: bool
    energies: tuple[float, ...]
    parts: tuple[int, ...]

    @property
    def restarts(self) -> int:
        return len(self.energies)


@one_thread()
def search_skeleton(template: Mesh, poses: np.ndarray, config: SkeletonConfig | None = None,
                    progress: Callable[[int, int], None] | None = None, step: Step = once) -> SkeletonSearch:
    """The skeleton of `find_skeleton`, with the loops, the symmetry and the restarts it came from.

    Parameters
    ----------
    template : Mesh
    poses : (M, N, 3) float, metres
        The template's vertices in at least three poses.
    config : SkeletonConfig, optional
    progress : callable(done, total), optional
    step : callable, optional
        Keeps every restart, as `scanprep.batch.steps.Step`.

    Raises
    ------
    ValueError
        A template that is not one connected manifold; poses of another shape, not finite, or too few; no tree of as
        many parts as asked for; a symmetric skeleton asked for where no part has a mirror image.

    [SCAPE] §3
    """
    config = config or SkeletonConfig()
    check_template(template)
    poses = _checked_poses(template, poses)
    ticks = _Ticks(progress, config.restarts + 1)
    surface = PosedSurface(template, poses)
    symmetry = find_symmetry(template, poses)
    wanted = symmetry.holds if config.symmetric is None else config.symmetric
    if wanted and (symmetry.left.all() or not symmetry.left.any()):
        raise ValueError("symmetric: this template has no two sides")
    # a restart knows nothing of the count of parts or of the other restarts
    kept = partial(step, inputs=(template, poses, replace(config, parts=None, restarts=1)))
    runs = _best_of(surface, config, symmetry if wanted else None, ticks, kept)
    if wanted and config.symmetric is None and _held_back(runs[0]):
        runs, wanted = _best_of(surface, config, None, ticks, kept), False
    best = runs[0]
    label, links = best.label, best.links
    if config.parts is not None:
        label, links, wanted = _of_count(best, surface, config)
        label, links = _settled(best.search, label, links) if wanted else (label, links)
    label = _freed(surface, config, label, links) if wanted else label
    joints = place_joints(best.search, label, surface.core_motions(label), links)
    skeleton = _assemble(template, label, links, joints)
    if wanted:
        skeleton = replace(skeleton, names=names_by_symmetry(template, skeleton, symmetry))
    ticks.finish()
    loops = tuple(OpenedLoop(_named(loop, skeleton), loop.joined, loop.length) for loop in best.loops)
    return SkeletonSearch(skeleton, loops, symmetry, wanted, tuple(run.energy for run in runs),
                          tuple(len(run.links) + 1 for run in runs))


class _Ticks:
    """Progress over restarts, whose number may double when a body turns out not to be symmetric."""

    def __init__(self, progress: Callable[[int, int], None] | None, total: int) -> None:
        self.progress, self.total, self.done = progress, total, 0

    def tick(self) -> None:
        self.done = min(self.done + 1, self.total - 1)
        if self.progress is not None:
            self.progress(self.done, self.total)

    def finish(self) -> None:
        if self.progress is not None:
            self.progress(self.total, self.total)


def _checked_poses(template: Mesh, poses: np.ndarray) -> np.ndarray:
    poses = np.asarray(poses, dtype=np.float64)
    n = len(template.vertices)
    if poses.ndim != 3 or poses.shape[1:] != (n, 3):
        raise ValueError(f"poses: expected shape (M, {n}, 3) for this template, got {poses.shape}")
    if len(poses) < 3:
        raise ValueError(f"poses: expected at least 3, got {len(poses)}")
    bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
    if len(bad):
        raise ValueError(f"poses: {len(bad)} have vertices that are not finite, the first is pose {bad[0]}")
    return poses


def _best_of(surface: PosedSurface, config: SkeletonConfig, symmetry: Symmetry | None, ticks: _Ticks,
             kept: Callable[..., Tree]) -> list[Restart]:
    """All restarts, the best first."""
    rng = np.random.default_rng(config.seed)
    runs = []
    for number in range(config.restarts):
        search = PartSearch(surface, config, symmetry, rng)
        label, links, loops = kept(f"{'free' if symmetry is None else 'symmetric'} restart {number}",
                                   make=partial(_searched, search))
        search.forget()
        runs.append(Restart(label, links, tuple(loops), search.energy(label) / surface.area, _score(search, label),
                            search))
        ticks.tick()
    return sorted(runs, key=lambda run: run.score)


def _searched(search: PartSearch) -> Tree:
    """Labels and links of a tree, and the loops that were opened for it."""
    label, links, loops = to_tree(search, dissolve_bands(search, find_parts(search)))
    return *_settled(search, *_improved(search, label, links)), loops


def _score(search: PartSearch, label: np.ndarray) -> float:
    """What is compared: the logarithm of the energy, and what every part must be worth."""
    energy = search.energy(label) / search.surface.area
    return float(np.log(energy + search.config.tolerance**2) + search.config.worth * (label.max() + 1))


def _improved(search: PartSearch, label: np.ndarray, links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labels and links of a tree after parts were joined, and cut, as long as the score falls.

    Only parts that are not well apart are joined: hands are too small to lower the energy much. A cut that makes a mere
    band of skin does not count.
    """
    score = _score(search, label)
    for _ in range(search.config.start):
        many = int(label.max()) + 1
        for trial in (fewer_parts(search, label, max(many - 2, 1), LOOP_SEPARATION * search.config.separation),
                      more_parts(search, label, many + 2)):
            if trial is None:
                continue
            moved = search.alternate(trial[0], rounds=4)
            tree = without_weak(search, moved)
            better = _score(search, moved)
            if (len(tree) == moved.max() and better < score - LEAST_GAIN
                    and (moved.max() < many or passages(search, moved)[0].max() < search.config.fading)):
                label, links, score = moved, tree, better
                break
        else:
            return label, links
    return label, links


def _settled(search: PartSearch, label: np.ndarray, links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labels and links of a tree after labels and core motions alternated to the end, if it still is that tree."""
    moved = search.alternate(label, rounds=12, core=True)
    tree = without_weak(search, moved)
    return (moved, tree) if moved.max() == label.max() and len(tree) == len(links) else (label, links)


def _freed(surface: PosedSurface, config: SkeletonConfig, label: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Labels of the same tree after the borders of both sides settled, each by itself: no body is quite symmetric."""
    free = PartSearch(surface, replace(config, patches=2), None)
    moved = free.alternate(label, rounds=12, core=True)
    touching = {tuple(pair) for pair in free.contacts(moved).tolist()}
    same = moved.max() == label.max() and touching.issuperset(map(tuple, np.sort(links, axis=1).tolist()))
    return moved if same else label


def _held_back(run: Restart) -> bool:
    """Whether parts that need not be symmetric would fit far better, beginning with those found."""
    free = PartSearch(run.search.surface, replace(run.search.config, patches=2), None)
    return free.energy(free.alternate(run.label, rounds=10)) < LOOSE * run.search.energy(run.label)


def _of_count(best: Restart, surface: PosedSurface, config: SkeletonConfig) -> tuple[np.ndarray, np.ndarray, bool]:
    """Labels and links of exactly as many parts as asked for, and whether they are symmetric.

    A count that no symmetric tree has is reached with one part that is not.
    """
    assert config.parts is not None
    tied = best.search.sides.tied
    try:
        return *tree_of(best.search, best.label, best.links, config.parts), tied
    except ValueError:
        if not tied or config.symmetric:
            raise
    free = PartSearch(surface, config, None)
    return *tree_of(free, best.label, best.links, config.parts), False


def _named(loop: Loop, skeleton: Skeleton) -> tuple[str, str]:
    """The names of the parts of the skeleton that hold most of the two sides of a loop."""
    a, b = (skeleton.names[int(np.bincount(skeleton.part_of_face[side]).argmax())] for side in loop.sides)
    return a, b


def _assemble(template: Mesh, label: np.ndarray, links: np.ndarray, joints: np.ndarray) -> Skeleton:
    """Number the parts from the middle outwards and hang every joint on its child."""
    P = int(label.max()) + 1
    areas = np.bincount(label, template.face_areas, P)
    centres = np.stack([np.bincount(label, template.face_areas * c, P)
                        for c in template.corners.mean(axis=1).T], axis=1) / areas[:, None]
    root = middle_part(areas, centres, links, joints)
    order = reorder(label, _rooted(links, root, P), root)
    new = np.argsort(order)
    part_of_face = new[label]
    parents = np.full(P, -1)
    places = np.zeros((P, 3))
    for (a, b), joint in zip(new[links], joints, strict=True):
        parents[max(a, b)], places[max(a, b)] = min(a, b), joint
    unplaced = Skeleton(part_of_face, parents, places)
    places[0] = template.vertices[unplaced.part_of_vertex(template) == 0].mean(axis=0)
    return Skeleton(part_of_face, parents, places)


def _rooted(links: np.ndarray, root: int, count: int) -> list[int]:
    """The parent of every part when the tree hangs from `root`, -1 there."""
    parent = [-1] * count
    reached = [root]
    for part in reached:
        for a, b in links:
            for here, there in ((a, b), (b, a)):
                if here == part and there != root and parent[there] < 0 and there not in reached:
                    parent[there] = part
                    reached.append(int(there))
    return parent


def skeleton_problem(found: SkeletonSearch, wanted: int | None) -> str | None:
    """Why a skeleton means nothing, with the likely cause; None where it means something.

    Parameters
    ----------
    wanted : int, optional
        How many parts were asked for.
    """
    if len(found.skeleton.parents) > 1 or wanted == 1:
        return None
    return "the body has one part and no joint; the meshes do not differ in pose, or are smaller than their unit says?"
