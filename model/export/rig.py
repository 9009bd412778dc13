"""A body as other programs move it: a mesh that hangs on joints by linear blend skinning."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.gltf import UPRIGHT
from scanprep.ranges import TURNS
from scanprep.skeleton.tree import Skeleton

from ..blend_weights import CARRIERS, skin_weights, strongest
from ..body import BodyModel
from ..skinning import SkinningModel


@dataclass(frozen=True, eq=False)
class Rig:
    """A rest mesh, its skeleton, and how much each joint carries each vertex.

    At rest all parts have the axes of the world. A pose turns every part about its joint, and the root's joint
    stands at `joints[0] + trans`, as in the models.
    """

    mesh: Mesh                       # at rest: pose and trans are zero
    skeleton: Skeleton               # with the joints of this body
    weights: np.ndarray              # (N, J), rows sum to 1, with at most `CARRIERS` entries that are not zero
    shapes: np.ndarray               # (K, N, 3) metres, change of the rest mesh for one standard deviation of each beta

    def __post_init__(self) -> None:
        N, J = len(self.mesh.vertices), len(self.skeleton.parents)
        if self.weights.shape != (N, J):
            raise ValueError(f"weights: expected shape {(N, J)}, got {self.weights.shape}")
        if not (self.weights >= 0).all() or not np.allclose(self.weights.sum(axis=1), 1, atol=1e-6):
            raise ValueError("weights: expected numbers of at least 0 that sum to 1 for every vertex")
        if ((self.weights > 0).sum(axis=1) > CARRIERS).any():
            raise ValueError(f"weights: expected at most {CARRIERS} for a vertex (see strongest)")
        if self.shapes.ndim != 3 or self.shapes.shape[1:] != (N, 3):
            raise ValueError(f"shapes: expected shape (K, {N}, 3), got {self.shapes.shape}")

    def __repr__(self) -> str:
        return f"Rig({self.mesh!r}, {len(self.skeleton.parents)} joints, {len(self.shapes)} shapes)"

    def vertices(self, poses: np.ndarray, trans: np.ndarray | None = None, changes: np.ndarray | None = None
                 ) -> np.ndarray:
        """The skinned mesh (N, 3) or (T, N, 3), metres, in one pose (J, 3) or several (T, J, 3), radians.

        `changes` (N, 3) or (T, N, 3), metres, are added to the rest mesh before it is skinned.
        """
        R = self.skeleton.part_rotations(poses)
        offset = joint_places(self.skeleton, poses, trans) - np.einsum("...jab,jb->...ja", R, self.skeleton.joints)
        out = np.einsum("nj,nb,...jab->...na", self.weights, self.mesh.vertices, R, optimize=True)
        if changes is not None:
            out += np.einsum("nj,...nb,...jab->...na", self.weights, changes, R, optimize=True)
        return out + self.weights @ offset

    def turned(self, up: int) -> Rig:
        """The same body with the axis `up` turned to +y; poses and trans turn with `turn_up`."""
        U = turn_up(up).T
        return replace(self, mesh=self.mesh.with_vertices(self.mesh.vertices @ U), shapes=self.shapes @ U,
                       skeleton=replace(self.skeleton, joints=self.skeleton.joints @ U))


def make_rig(model: BodyModel, betas: np.ndarray | None = None, shapes: int = 0, weights: np.ndarray | None = None
             ) -> Rig:
    """The body of one person, ready for linear blend skinning.

    Parameters
    ----------
    model : BodyModel
    betas : (k,) float, optional
        None is the template's own body, which has no shapes.
    shapes : int
        So many of the first betas become shapes; more than the model has are not asked for.
    weights : (N, J) float, optional
        Else those of a skinning model, or `skin_weights`. Of every vertex the largest `CARRIERS` are kept.

    Raises
    ------
    ValueError
        Weights of another shape, shapes of the template's own body.
    """
    if shapes and betas is None:
        raise ValueError(f"shapes: the template's own body has none, got {shapes}")
    rest = np.zeros((len(model.skeleton.parents), 3))
    mesh = model.template.with_vertices(model.vertices(rest, betas))
    joints = model.joint_regressor @ mesh.vertices
    if weights is None:
        weights = model.weights if isinstance(model, SkinningModel) else skin_weights(model.template, model.skeleton)
    changes = np.zeros((0, *mesh.vertices.shape))
    if shapes:
        changes = np.moveaxis(model.shape_jacobian(rest)[..., :shapes], -1, 0)
    return Rig(mesh, replace(model.skeleton, joints=joints), strongest(weights), changes)


def joint_places(skeleton: Skeleton, poses: np.ndarray, trans: np.ndarray | None = None) -> np.ndarray:
    """Where the joints (..., J, 3) of a skeleton with bones of fixed length stand, metres."""
    R = skeleton.part_rotations(poses)
    out = np.empty(R.shape[:-1])
    out[..., 0, :] = skeleton.joints[0] + (0.0 if trans is None else np.asarray(trans))
    for j in range(1, len(skeleton.parents)):
        p = skeleton.parents[j]
        out[..., j, :] = out[..., p, :] + R[..., p, :, :] @ (skeleton.joints[j] - skeleton.joints[p])
    return out


def check_motion(skeleton: Skeleton, poses: np.ndarray, trans: np.ndarray | None, rate: float
                 ) -> tuple[np.ndarray, np.ndarray]:
    """Poses (T, J, 3) and trans (T, 3) of a motion, or ValueError."""
    poses = np.asarray(poses, dtype=np.float64)
    J = len(skeleton.parents)
    if poses.ndim != 3 or poses.shape[1:] != (J, 3) or not len(poses):
        raise ValueError(f"poses: expected shape (T, {J}, 3) with at least one frame, got {poses.shape}")
    trans = np.zeros((len(poses), 3)) if trans is None else np.asarray(trans, dtype=np.float64)
    if trans.shape != (len(poses), 3):
        raise ValueError(f"trans: expected shape {(len(poses), 3)}, got {trans.shape}")
    bad = np.flatnonzero(~(np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(trans).all(axis=1)))
    if len(bad):
        raise ValueError(f"poses, trans: {len(bad)} frames are not finite, the first is frame {bad[0]}")
    TURNS.check(poses, "poses")
    if not (np.isfinite(rate) and rate > 0):
        raise ValueError(f"rate: expected a positive number of frames a second, got {rate}")
    return poses, trans


def turn_up(up: int) -> np.ndarray:
    """The rotation (3, 3) that brings an axis to +y; points, poses and trans turn as `x @ turn_up(up).T`.

    A rotation vector turns like a point because the axes of all parts are those of the world at rest.
    """
    if up not in UPRIGHT:
        raise ValueError(f"up: expected 0, 1 or 2, got {up}")
    axis = np.array(UPRIGHT[up][:3])
    return rotations.exp(axis / max(float(np.linalg.norm(axis)), 1e-12) * (0 if up == 1 else np.pi / 2)).round()
