"""The skeleton of a body from its registered poses."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..geometry.mesh import Mesh, check_template
from .joints import middle_part, place_joints, refine_tree, to_tree
from .motions import PosedSurface
from .parts import PartSearch, SkeletonConfig, find_parts
from .tree import Skeleton, reorder


def find_skeleton(template: Mesh, poses: np.ndarray, config: SkeletonConfig | None = None,
                  progress: Callable[[int, int], None] | None = None) -> Skeleton:
    """Rigid parts, the tree over them, and the joints, from registered poses of one body.

    Parts that never move against each other in the poses cannot be told apart.

    Parameters
    ----------
    template : Mesh
    poses : (M, N, 3) float, metres
        The template's vertices in at least three poses.
    config : SkeletonConfig, optional
    progress : callable(done, total), optional

    Returns
    -------
    Skeleton
        Part 0 lies in the middle of the body.

    Raises
    ------
    ValueError
        A template that is not one connected manifold; poses of another shape, not finite, or too few.

    [SCAPE] §3
    """
    config = config or SkeletonConfig()
    tell = progress or (lambda done, total: None)
    check_template(template)
    poses = _checked_poses(template, poses)
    surface = PosedSurface(template, poses)
    search = PartSearch(surface, config)
    label, links = to_tree(search, find_parts(search, lambda done, total: tell(done, total + 1)))
    if config.parts is not None:
        label, links = refine_tree(search, label, links, config.parts)
    joints = place_joints(search, label, surface.core_motions(label), links)
    tell(4, 4)
    return _assemble(template, label, links, joints)


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
