"""The search for a skeleton, begun anew several times on a coarse copy of the body, and its best result."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from ..batch.room import Step, once
from ..geometry.mesh import Mesh, check_template
from .coarse import coarse_copy, parts_of_source
from .joints import (
    LOOP_SEPARATION,
    Loop,
    dissolve_bands,
    fewer_parts,
    middle_part,
    more_parts,
    passages,
    place_joints,
    to_tree,
    tree_of,
    without_weak,
)
from .motions import PosedSurface
from .names import name_parts
from .parts import FADING, PartSearch, SkeletonConfig, find_parts
from .symmetry import Symmetry, find_symmetry, mirrored_poses
from .tree import Skeleton, reorder

Tree = tuple[np.ndarray, np.ndarray, list[Loop]]


@dataclass(frozen=True, eq=False)
class _Body:
    """A template in its poses (M, N, 3), metres, and its best mirror symmetry."""

    template: Mesh
    poses: np.ndarray
    symmetry: Symmetry

    @cached_property
    def surface(self) -> PosedSurface:
        return PosedSurface(self.template, self.poses)

    def both_ways(self) -> _Body:
        """With every pose also mirrored."""
        mirrored = mirrored_poses(self.template, self.poses, self.symmetry)
        return _Body(self.template, np.concatenate([self.poses, mirrored]), self.symmetry)


class SkeletonFinder:
    """The search, begun anew several times on a coarse copy of the body: skeletons of any number of parts follow.

    Arguments and errors are those of `find_skeleton`; the number of parts of the settings does not matter. `runs` are
    the restarts, the best first.

    [Articulated]
    """

    def __init__(self, template: Mesh, poses: np.ndarray, config: SkeletonConfig,
                 progress: Callable[[int, int], None] | None = None, step: Step = once) -> None:
        check_template(template)
        poses = _checked_poses(template, poses)
        self.config, self.copy = config, coarse_copy(template)
        self.whole = self.coarse = _Body(template, poses, find_symmetry(template, poses))
        if len(self.copy.template.vertices) < len(template.vertices):
            few = self.copy.transfer(poses)
            self.coarse = _Body(self.copy.template, few, find_symmetry(self.copy.template, few))
        kinds = self.whole.symmetry, self.coarse.symmetry
        holds = all(symmetry.holds for symmetry in kinds)
        tied = holds if config.symmetric is None else config.symmetric
        if tied and not all(symmetry.two_sided for symmetry in kinds):
            raise ValueError("symmetric: this template has no two sides")
        tell = _progress(progress, config.restarts)
        # a restart knows nothing of the count of parts or of the other restarts
        kept = partial(step, inputs=(self.coarse.template, self.coarse.poses,
                                     replace(config, parts=None, restarts=1)))
        symmetry = self.coarse.symmetry if tied else None
        self.runs = _restarts(self.coarse.surface, config, symmetry, tell, kept)    # [Articulated] E- and M-steps
        if tied and holds and _held_back(self.runs[0]):              # few poses: a limb bends on one side alone
            self.whole, self.coarse = self.whole.both_ways(), self.coarse.both_ways()
            self.runs = _restarts(self.coarse.surface, config, symmetry, tell, kept, "mirrored")

    def coarse_skeleton(self, parts: int | None) -> tuple[Skeleton, bool]:
        """The skeleton on the coarse copy, with so many parts if told, and whether left and right are alike."""
        body, config = self.coarse, replace(self.config, parts=parts)
        label, links, tied = _of_count(self.runs[0], body.surface, config)
        if tied:
            label = _borders_untied(body.surface, config, label, links)
        joints = place_joints(body.surface, label, body.surface.core_motions(label), links)     # [Articulated] joints
        skeleton = _assembled(body.template, label, links, joints)
        if tied:
            skeleton = replace(skeleton, names=name_parts(body.template, skeleton, body.symmetry))
        return skeleton, tied

    def whole_skeleton(self, coarse: Skeleton) -> Skeleton:
        """A skeleton of the coarse copy on the body itself, with borders and joints where the whole surface wants them.
        """
        body, links = self.whole, np.stack([coarse.parents, np.arange(len(coarse.parents))], axis=1)[1:]
        if self.coarse.template is body.template:
            return coarse
        label = parts_of_source(self.copy, coarse.part_of_vertex(self.coarse.template))
        label = _borders_untied(body.surface, self.config, label, links)
        joints = coarse.joints.copy()
        joints[1:] = place_joints(body.surface, label, body.surface.core_motions(label), links)
        return Skeleton(label, coarse.parents, joints, coarse.names).with_root_centred(body.template)


def _checked_poses(template: Mesh, poses: np.ndarray) -> np.ndarray:
    poses = np.asarray(poses, dtype=np.float64)
    n = len(template.vertices)
    if poses.ndim != 3 or poses.shape[1:] != (n, 3):
        raise ValueError(f"poses: expected shape (M, {n}, 3) for this template, got {poses.shape}")
    if len(poses) < 3:
        raise ValueError(f"poses: expected at least 3, got {len(poses)}; where they differ the joints show")
    bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
    if len(bad):
        raise ValueError(f"poses: {len(bad)} have vertices that are not finite, the first is pose {bad[0]}")
    return poses


def _progress(progress: Callable[[int, int], None] | None, restarts: int) -> Callable[[], None]:
    """Tells of one more restart; restarts may double where a body turns out not to be symmetric."""
    done, total = 0, restarts + 1

    def tell() -> None:
        nonlocal done
        done = min(done + 1, total - 1)
        if progress is not None:
            progress(done, total)

    return tell


@dataclass(frozen=True, eq=False)
class _Restart:
    """One beginning of the search and where it ended."""

    label: np.ndarray  # (F,) int: parts
    links: np.ndarray  # (P - 1, 2) int
    loops: list[Loop]
    energy: float  # residual of the parts and price of their borders, as a share of the squared size of the body
    score: float  # logarithm of the energy, and what every part must be worth; the lowest is best
    search: PartSearch


def _restarts(surface: PosedSurface, config: SkeletonConfig, symmetry: Symmetry | None, tell: Callable[..., None],
              kept: Callable[..., Tree], poses: str = "") -> list[_Restart]:
    """All restarts, the best first; `poses` says which, for what is kept."""
    rng = np.random.default_rng(config.seed)
    runs = []
    for number in range(config.restarts):
        search = PartSearch(surface, config, symmetry, rng)
        label, links, loops = kept(f"{poses or ('free' if symmetry is None else 'symmetric')} restart {number}",
                                   make=partial(_searched, search))
        search.forget()
        runs.append(_Restart(label, links, loops, search.energy(label) / surface.area, _score(search, label), search))
        tell()
    return sorted(runs, key=lambda run: run.score)


def _searched(search: PartSearch) -> Tree:
    """Labels and links of a tree, and the loops that were opened for it."""
    label = find_parts(search)                                                      # [Articulated]
    label = dissolve_bands(search, label)
    label, links, loops = to_tree(search, label)                                    # [SCAPE] §3
    label, links = _improved(search, label, links)
    return *_settled(search, label, links), loops


def _score(search: PartSearch, label: np.ndarray) -> float:
    """What is compared: the logarithm of the energy, and what every part must be worth."""
    energy = search.energy(label) / search.surface.area
    # a part counts that lowers the logarithm of the energy by a tenth
    return float(np.log(energy + search.config.tolerance**2) + 0.1 * (label.max() + 1))


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
            if (len(tree) == moved.max() and better < score - 0.005
                    and (moved.max() < many or passages(search, moved)[0].max() < FADING)):
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


def _held_back(run: _Restart) -> bool:
    """Whether parts that need not be symmetric would fit far better, beginning with those found."""
    free = PartSearch(run.search.surface, replace(run.search.config, patches=2))
    return free.energy(free.alternate(run.label, rounds=10)) < 0.85 * run.search.energy(run.label)


def _of_count(best: _Restart, surface: PosedSurface, config: SkeletonConfig) -> tuple[np.ndarray, np.ndarray, bool]:
    """Labels and links of exactly as many parts as asked for, and whether they are symmetric.

    A count that no symmetric tree has is reached with one part that is not.
    """
    tied = best.search.sides.tied
    if config.parts is None:
        return best.label, best.links, tied
    try:
        label, links = tree_of(best.search, best.label, best.links, config.parts)
        return *(_settled(best.search, label, links) if tied else (label, links)), tied
    except ValueError:
        if not tied or config.symmetric:
            raise
    return *tree_of(PartSearch(surface, config), best.label, best.links, config.parts), False


def _borders_untied(surface: PosedSurface, config: SkeletonConfig, label: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Labels after borders and core motions alternated on both sides by themselves, as long as the tree stays: no body
    is quite symmetric.
    """
    free, links = PartSearch(surface, replace(config, patches=2)), np.sort(links, axis=1)
    for _ in range(12):
        moved = free.alternate(label, rounds=1, core=True)
        touching = {tuple(pair) for pair in free.contacts(moved).tolist()}
        if moved.max() != label.max() or not touching.issuperset(map(tuple, links.tolist())):
            break
        changed = surface.face_weights[moved != label].sum()
        label = moved
        if changed < 5e-4:                                           # of the surface
            break
    return label


def _assembled(template: Mesh, label: np.ndarray, links: np.ndarray, joints: np.ndarray) -> Skeleton:
    """Number the parts from the middle outwards and hang every joint on its child."""
    P = int(label.max()) + 1
    areas = np.bincount(label, template.face_areas, P)
    centres = np.stack([np.bincount(label, template.face_areas * c, P)
                        for c in template.corners.mean(axis=1).T], axis=1) / areas[:, None]
    order = reorder(label, links, middle_part(areas, centres, links, joints))
    new = np.argsort(order)
    parents = np.full(P, -1)
    places = np.zeros((P, 3))
    for (a, b), joint in zip(new[links], joints, strict=True):
        parents[max(a, b)], places[max(a, b)] = min(a, b), joint
    return Skeleton(new[label], parents, places).with_root_centred(template)
