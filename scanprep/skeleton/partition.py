"""Parts of a template cut in two, borders between them, and skeletons put together from parts and joints."""
from __future__ import annotations

import numpy as np

from ..geometry.mesh import Mesh
from .joints import place_joints, ring_centre
from .labels import keep_connected, pieces
from .motions import PosedSurface
from .parts import PartSearch, SkeletonConfig
from .tree import Skeleton


def border_between(template: Mesh, label: np.ndarray, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
    """The edges (n, 2) that part a shares with part b, as vertices, and their lengths (n,), metres."""
    shared = template.edge_use == 2
    both = np.sort(label[template.face_pairs], axis=1)
    border = (both == [min(a, b), max(a, b)]).all(axis=1)
    return template.edges[shared][border], template.edge_lengths[shared][border]


def cut_across(template: Mesh, mine: np.ndarray, joints: np.ndarray) -> np.ndarray | None:
    """Which triangles (F,) bool of a part `mine` (F,) bool to cut off: the farther half along its length.

    Its length runs along its joints (n, 3), of one joint from there to the middle, of none along its main axis. None
    where no cut leaves two connected halves.
    """
    inside = np.flatnonzero(mine)
    pairs = np.searchsorted(inside, template.face_pairs[mine[template.face_pairs].all(axis=1)])
    areas, centres = template.face_areas[inside], template.corners.mean(axis=1)[inside]
    middle = areas @ centres / areas.sum()
    axes = np.linalg.eigh(np.cov(centres.T, aweights=areas))[1].T[::-1]
    if len(joints):
        axes = np.vstack([np.linalg.svd(joints - joints.mean(axis=0))[2][0] if len(joints) > 1
                          else middle - joints[0], axes])
    for axis in axes:
        far = ((centres - middle) @ axis > 0).astype(np.int64)
        if not 0 < far.sum() < len(far):
            continue
        far = keep_connected(np.zeros((len(far), 2)), pairs, areas, far)      # what lies apart there goes back
        if pieces(pairs, far).max() == 1:
            cut = np.zeros_like(mine)
            cut[inside[far == 1]] = True
            return cut
    return None


def cut_where_it_bends(template: Mesh, poses: np.ndarray, mine: np.ndarray) -> np.ndarray | None:
    """Which triangles (F,) bool of a part (F,) bool to cut off so that the halves move most rigidly; None if none."""
    search = PartSearch(PosedSurface(template, poses), SkeletonConfig())
    halved, apart = search.split(np.where(mine, 0, 1), 0)
    return halved == halved.max() if apart > 0 else None


class Links:
    """Where the joint between two parts belongs: by the poses where there are some, else in the middle of the border.

    Parameters
    ----------
    template : Mesh
    label : (F,) int
    poses : (M, N, 3) float, metres, optional
    """

    def __init__(self, template: Mesh, label: np.ndarray, poses: np.ndarray | None) -> None:
        self.template, self.label, self.poses = template, label, poses

    def joint(self, a: int, b: int) -> np.ndarray:
        """(3,) metres."""
        if self.poses is None:
            return ring_centre(self.template, np.unique(border_between(self.template, self.label, a, b)[0]))
        surface = PosedSurface(self.template, self.poses)
        return place_joints(PartSearch(surface, SkeletonConfig()), self.label, surface.core_motions(self.label),
                            np.array([[a, b]]))[0]


def assemble(template: Mesh, label: np.ndarray, parents: np.ndarray, joints: np.ndarray, names: tuple[str, ...] = ()
             ) -> Skeleton:
    """A skeleton from parts that are numbered from the root on, its first joint in the middle of the root."""
    joints = joints.copy()
    unplaced = Skeleton(label, parents, joints)
    joints[0] = template.vertices[unplaced.part_of_vertex(template) == 0].mean(axis=0)
    return Skeleton(label, parents, joints, names)
