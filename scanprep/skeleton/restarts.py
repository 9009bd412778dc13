"""The search for a skeleton with several restarts, and the choice of the best."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..batch.pool import SideBySide
from ..batch.room import Step, run_uncached
from ..geometry.members import ONE_BODY, check_members
from ..geometry.mesh import Mesh, check_template
from .joints import (
    LOOP_SEPARATION,
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
from .parts import FADING, START, PartSearch, SkeletonConfig, find_parts
from .symmetry import Symmetry, find_symmetry, mirror_poses
from .tree import Skeleton, reorder

Tree = tuple[np.ndarray, np.ndarray]


class SkeletonFinder:
    """The search with several restarts; skeletons with any number of parts follow from the same restarts.

    Arguments and errors are those of `find_skeleton`; the requested number of parts does not matter here. `runs` are
    the restarts, best first; `first` is the one that was started first.

    [Articulated]
    """

    def __init__(self, template: Mesh, poses: np.ndarray, config: SkeletonConfig,
                 progress: Callable[[int, int], None] | None = None, step: Step = run_uncached) -> None:
        check_template(template)
        poses = np.asarray(poses, dtype=np.float64)
        n = len(template.vertices)
        if poses.ndim != 3 or poses.shape[1:] != (n, 3):
            raise ValueError(f"poses: expected shape (M, {n}, 3) for this template, got {poses.shape}")
        if len(poses) < 3:
            raise ValueError(f"poses: expected at least 3, got {len(poses)}; where they differ the joints show")
        bad = np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))
        if len(bad):
            raise ValueError(f"poses: {len(bad)} have vertices that are not finite, the first is pose {bad[0]}")
        check_members(template, poses, "poses", ratio=ONE_BODY)
        # left and right are tied if the body is symmetric, or if the settings say so
        self.template, self.config, self.symmetry = template, config, find_symmetry(template, poses)
        tied = self.symmetry.holds if config.symmetric is None else config.symmetric
        if tied and not self.symmetry.two_sided:
            raise ValueError("symmetric: this template has no two sides")
        report_progress, self.surface = _progress(progress, config.restarts), PosedSurface(template, poses)
        # a restart does not depend on the requested number of parts or on the other restarts: cached results stay valid
        kept = partial(step, inputs=(template, poses, replace(config, parts=None, restarts=1)))
        symmetry = self.symmetry if tied else None
        runs = _restarts(self.surface, config, symmetry, report_progress, kept)           # [Articulated] E- and M-steps
        if tied and self.symmetry.holds and _is_held_back(_best(runs)):     # few poses: a limb bends on one side only
            both = np.concatenate([poses, mirror_poses(template, poses, self.symmetry)])
            self.surface = PosedSurface(template, both)
            runs = _restarts(self.surface, config, symmetry, report_progress, kept, "mirrored")
        self.first, self.runs = runs[0], sorted(runs, key=lambda run: run.score)

    def skeleton(self, run: Restart, parts: int | None) -> tuple[Skeleton, bool]:
        """Build the skeleton of a restart, with `parts` parts if given; and say whether left and right are alike."""
        surface, config = self.surface, replace(self.config, parts=parts)
        label, links, tied = _of_count(run, surface, config)
        if tied:
            # let the borders of both sides move freely, as no body is quite symmetric; keep that if the tree stays the
            # same
            free = PartSearch(surface, config, patches=2)
            moved = free.alternate(label, rounds=12, core=True)
            touching = {tuple(pair) for pair in free.contacts(moved).tolist()}
            same = moved.max() == label.max() and touching.issuperset(map(tuple, np.sort(links, axis=1).tolist()))
            label = moved if same else label
        joints, _ = place_joints(surface, label, surface.core_motions(label), links)   # [Articulated] joints
        skeleton = _assemble(self.template, label, links, joints)
        if tied:
            skeleton = replace(skeleton, names=name_parts(self.template, skeleton, self.symmetry))
        return skeleton, tied


def _progress(progress: Callable[[int, int], None] | None, restarts: int) -> Callable[[], None]:
    """Return a callback that counts restarts; there may be twice as many if limbs bend on one side only."""
    done, total = 0, restarts + 1

    def report_progress() -> None:
        nonlocal done
        done = min(done + 1, total - 1)
        if progress is not None:
            progress(done, total)

    return report_progress


@dataclass(frozen=True, eq=False)
class Restart:
    """One restart of the search and its result."""

    label: np.ndarray  # (F,) int: parts
    links: np.ndarray  # (P - 1, 2) int
    energy: float  # residual plus price of borders, as a share of the squared size of the body
    score: float  # log of the energy plus a penalty per part; the lowest is best
    search: PartSearch


def _restarts(surface: PosedSurface, config: SkeletonConfig, symmetry: Symmetry | None,
              report_progress: Callable[..., None],
              kept: Callable[..., Tree], poses: str = "") -> list[Restart]:
    """Run all restarts in parallel; `poses` names the set of poses in the cache."""
    rng = np.random.default_rng(config.seed)
    searches = [PartSearch(surface, config, symmetry, rng) for _ in range(config.restarts)]
    runs = []
    with SideBySide(_search, searches) as found:
        for number, search in enumerate(searches):
            label, links = kept(f"{poses or ('free' if symmetry is None else 'symmetric')} restart {number}",
                                make=partial(found, number))
            search.forget()
            runs.append(Restart(label, links, search.energy(label) / surface.area, _score(search, label),
                                search))
            report_progress()
    return runs


def _best(runs: list[Restart]) -> Restart:
    """Return the restart with the lowest score."""
    return min(runs, key=lambda run: run.score)


def _search(search: PartSearch) -> Tree:
    """Run one restart: labels and links of a tree."""
    # rigid parts; without bands of skin; as a tree; with parts merged and cut while that helps; settled
    label = find_parts(search)                                                      # [Articulated]
    label = dissolve_bands(search, label)
    label, links = to_tree(search, label)                                    # [SCAPE] §3
    label, links = _improve(search, label, links)
    return _settle(search, label, links)


def _score(search: PartSearch, label: np.ndarray) -> float:
    """Compute the score of a labelling: log of the energy plus a penalty per part."""
    energy = search.energy(label) / search.surface.area
    # a part must lower the log of the energy by a tenth; the tolerance keeps the logarithm finite
    return float(np.log(energy + search.config.tolerance**2) + 0.1 * (label.max() + 1))


def _improve(search: PartSearch, label: np.ndarray, links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge and cut parts of a tree as long as the score falls; return labels and links.

    Only parts that are not well separated are merged, because hands are too small to lower the energy much. A cut that
    creates a mere band of skin is rejected.
    """
    score = _score(search, label)
    for _ in range(START):
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


def _settle(search: PartSearch, label: np.ndarray, links: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Alternate labels and core motions to the end; keep the result only if the tree stays the same."""
    moved = search.alternate(label, rounds=12, core=True)
    tree = without_weak(search, moved)
    return (moved, tree) if moved.max() == label.max() and len(tree) == len(links) else (label, links)


def _is_held_back(run: Restart) -> bool:
    """Test whether parts without the symmetry would fit far better: an energy lower by 15%."""
    free = PartSearch(run.search.surface, run.search.config, patches=2)
    return free.energy(free.alternate(run.label, rounds=10)) < 0.85 * run.search.energy(run.label)


def _of_count(best: Restart, surface: PosedSurface, config: SkeletonConfig) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return labels and links with the requested number of parts, or the nearest, and whether they are symmetric.

    If no symmetric tree has that number, the symmetry is given up for one that is nearer.
    """
    tied, wanted = best.search.sides.tied, config.parts
    if wanted is None:
        return best.label, best.links, tied
    label, links = tree_of(best.search, best.label, best.links, wanted)
    if not tied:
        return label, links, False
    if len(links) + 1 != wanted and not config.symmetric:
        free = tree_of(PartSearch(surface, config), best.label, best.links, wanted)
        if abs(len(free[1]) + 1 - wanted) < abs(len(links) + 1 - wanted):
            return *free, False
    return *_settle(best.search, label, links), True


def _assemble(template: Mesh, label: np.ndarray, links: np.ndarray, joints: np.ndarray) -> Skeleton:
    """Number the parts from the middle outwards and assign every joint to its child."""
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
