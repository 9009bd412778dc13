"""Bodies whose shape changes a little as they move, for long motions: exact in some frames, nearly so in between."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from model.body import BodyModel
from model.linear import PointOperator, Subject

from ..soft_tissue.soft_tissue import SoftTissue


@dataclass(frozen=True, eq=False)
class QuickBodies:
    """Some vertices (n) of a person with soft tissue; several times faster than the exact bodies.

    What a change of shape moves is taken from the mean pose: a vertex off the joint of its part turns with that part,
    a joint off the one before with the part between. What that leaves is known in key frames (k,), and goes straight
    from one to the next.

    Attributes
    ----------
    rigid : PointOperator
        The vertices of the person's own shape.
    part : (n,) int
    slopes, joints : (K, 3 n) and (K, 3 J) float, metres
        What each beta moves, in the frames of the parts and of the parts before.
    left : (k, n, 3) float, metres
        What is left in the key frames, in the frames of the parts.
    """

    soft: SoftTissue
    rigid: PointOperator
    part: np.ndarray
    slopes: np.ndarray
    joints: np.ndarray
    keys: np.ndarray
    left: np.ndarray

    @staticmethod
    def of(model: BodyModel, subject: Subject, soft: SoftTissue, ids: np.ndarray, keys: np.ndarray, exact: np.ndarray
           ) -> QuickBodies:
        """Of vertices (n,) that are exact (k, n, 3), metres, in key frames (k,), in order."""
        part, K = model.skeleton.part_of_vertex(model.template)[ids], soft.changes.shape[1]
        before = np.maximum(model.skeleton.parents, 0)
        moved = model.shape_jacobian(model.pose_mean)[..., :K]
        at_joints = np.tensordot(model.joint_regressor.toarray(), moved, axes=1)
        back = np.swapaxes(model.skeleton.part_rotations(model.pose_mean), -1, -2)
        slopes, joints = ((turn @ by).reshape(-1, K).T.astype(np.float32) for turn, by in (
            (back[part], moved[ids] - at_joints[part]), (back[before], at_joints - at_joints[before])))
        first = QuickBodies(soft, subject.points(ids).astype(np.float32), part, slopes, joints, keys,
                            np.zeros((len(keys), len(ids), 3), dtype=np.float32))
        left = first.turned(np.swapaxes(first.rotations(keys), -1, -2), exact - first.vertices(keys))
        return replace(first, left=left.astype(np.float32))

    def vertices(self, frames: np.ndarray) -> np.ndarray:
        """Their places (m, n, 3), metres, in some frames (m,)."""
        motion, keys = self.soft.motion, self.keys
        before = np.clip(np.searchsorted(keys, frames, side="right") - 1, 0, max(len(keys) - 2, 0))
        after = np.minimum(before + 1, len(keys) - 1)
        share = ((frames - keys[before]) / np.maximum(keys[after] - keys[before], 1)).astype(np.float32)
        R, changes = self.rotations(frames), self.soft.changes[frames].astype(np.float32)
        moved, at_joints = ((changes @ by).reshape(len(frames), -1, 3) for by in (self.slopes, self.joints))
        for t, (a, b, s) in enumerate(zip(before, after, share, strict=True)):
            moved[t] += (1 - s) * self.left[a] + s * self.left[b]
        for j, parent in enumerate(self.rigid.skeleton.parents[1:], start=1):
            at_joints[:, j] = at_joints[:, parent] + (R[:, parent] @ at_joints[:, j, :, None])[..., 0]
        return (self.rigid.evaluate(motion.poses[frames], motion.trans[frames]) + at_joints[:, self.part]
                + self.turned(R, moved))

    def rotations(self, frames: np.ndarray) -> np.ndarray:
        """Those of the parts (m, J, 3, 3)."""
        return self.rigid.skeleton.part_rotations(self.soft.motion.poses[frames])

    def turned(self, R: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """Vectors (m, n, 3) of the vertices, each by the rotation (m, J, 3, 3) of its part."""
        out = np.empty_like(vectors)
        for p in np.unique(self.part):
            mine = self.part == p
            out[:, mine] = vectors[:, mine] @ np.swapaxes(R[:, p], -1, -2).astype(vectors.dtype)
        return out
