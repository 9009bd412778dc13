"""Creases of posed bodies laid smooth where triangles are inverted."""
from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sparse import harmonic
from scanprep.skeleton.tree import Skeleton

REACH = (1, 2, 2, 3, 3, 4)           # rings around inverted triangles that are laid anew, one round each


class Creases:
    """Where triangles of a posed body are inverted, and the body without.

    A triangle is inverted when it faces away from where the rotations of the parts around it take it, those of
    neighbouring parts mixed over `blend` rings: at a raised shoulder the skin rightly faces away from its own part.
    """

    def __init__(self, rest: Mesh, skeleton: Skeleton, blend: int = 6) -> None:
        self.rest, self.skeleton = rest, skeleton
        self._near = csr_array(rest.vertex_adjacency, dtype=np.float64)
        self._shares = np.eye(len(skeleton.parents))[skeleton.part_of_face]
        if blend:
            own = np.eye(len(skeleton.parents))[skeleton.part_of_vertex(rest)]
            spread = diags_array(1 / (1 + np.asarray(self._near.sum(axis=1)).ravel()))
            for _ in range(blend):
                own = spread @ (own + self._near @ own)
            self._shares = own[rest.faces].mean(axis=1)

    def inverted(self, bodies: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """(..., F) bool: triangles of bodies (..., N, 3) in poses (..., J, 3) that face the wrong way."""
        corners = bodies[..., self.rest.faces, :]
        now = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
        R = np.tensordot(self._shares, self.skeleton.part_rotations(poses), axes=(1, -3))
        R = np.moveaxis(R, 0, -3)
        return np.asarray((now * (R @ self.rest.face_normals[..., None])[..., 0]).sum(axis=-1) < 0)

    def smoothed(self, bodies: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Bodies (n, N, 3) in poses (n, J, 3) whose inverted triangles are laid as smoothly as what is around allows.

        Where thick limbs bend sharply, as those of a character do, the skin of the hollow has no room and folds over.
        Small patches are laid there instead, wider ones while triangles are inverted; nothing else moves, and patches
        that leave more triangles inverted than there were are not taken.
        """
        out = np.array(bodies)
        for t in range(len(out)):
            bad = self.inverted(out[t], poses[t])
            for rings in REACH:
                if not bad.any():
                    break
                out[t] = self._laid(out[t], poses[t], bad, rings)
                bad = self.inverted(out[t], poses[t])
        return out

    def _laid(self, x: np.ndarray, pose: np.ndarray, bad: np.ndarray, rings: int) -> np.ndarray:
        """Vertices (N, 3) with patches of so many rings around inverted triangles (F,) laid where that helps."""
        free = np.zeros(len(x))
        free[self.rest.faces[bad]] = 1
        for _ in range(rings - 1):
            free = (free + self._near @ free > 0).astype(float)
        mine = np.flatnonzero(free)
        if len(mine) == len(x):
            return x
        count, patch = connected_components(self._near[mine][:, mine])
        trial = harmonic(self._near, x, free == 0)
        left = self.inverted(trial, pose)
        of_vertex = np.full(len(x), -1)
        of_vertex[mine] = patch
        of_face = of_vertex[self.rest.faces].max(axis=1)                      # no triangle touches two patches
        better = np.bincount(of_face[left & (of_face >= 0)], minlength=count) < np.bincount(of_face[bad],
                                                                                           minlength=count)
        kept = mine[~better[patch]]
        trial[kept] = x[kept]
        return trial
