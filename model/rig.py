"""Rigs: a body as animation programs move it, a mesh on joints with linear blend skinning."""
from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.format_glb import turn_up
from scanprep.geometry.mesh import Mesh
from scanprep.ranges import TURNS
from scanprep.skeleton.tree import Skeleton, reorder

from .blend_weights import CARRIERS, skin_weights, strongest
from .body import BodyModel
from .linear import Subject


@dataclass(frozen=True, eq=False)
class Correctives:
    """Corrective shapes of one motion: changes of the rest mesh, and their weights over time.

    Between the frames that have weights, the weights are interpolated linearly, as in the files.
    """

    shapes: np.ndarray               # (C, N, 3) metres, at weight 1
    weights: np.ndarray              # (n, C), from 0 to 1
    frames: np.ndarray               # (n,) int, increasing: the frames of the motion that have these weights

    def changes(self, frames: np.ndarray) -> np.ndarray:
        """Compute the changes (..., N, 3) of the rest mesh in some frames (...) of the motion, metres."""
        weights = np.stack([np.interp(frames, self.frames, w) for w in self.weights.T], axis=-1)
        return np.tensordot(weights, self.shapes, axes=1)


@dataclass(frozen=True, eq=False)
class Rig:
    """A rest mesh, its skeleton, and the blend weights of its vertices.

    A pose turns every part about its joint, with axes parallel to the world's at rest. The root's joint is at
    `joints[0] + trans`, as in the models. `axes` change neither poses nor surface: they are the local frames of the
    bones in files (`local_rotations`, `local_offsets`).
    """

    mesh: Mesh                       # at rest: pose and trans are zero
    skeleton: Skeleton               # with the joints of this body
    weights: np.ndarray              # (N, J), rows sum to 1, with at most `CARRIERS` entries that are not zero
    shapes: np.ndarray               # (K, N, 3) metres, change of the rest mesh for one standard deviation of each beta
    # (J, 3, 3): columns are the axes of each bone at rest, in the world; y along the bone where they are `aim_bones`
    axes: np.ndarray = field(default_factory=lambda: np.zeros((0, 3, 3)))
    correctives: Correctives | None = None          # of the one motion that the rig is written with

    def __post_init__(self) -> None:
        N, J = len(self.mesh.vertices), len(self.skeleton.parents)
        # blend weights that every format can hold; without bone axes those of the world
        if self.weights.shape != (N, J):
            raise ValueError(f"weights: expected shape {(N, J)}, got {self.weights.shape}")
        if not (self.weights >= 0).all() or not np.allclose(self.weights.sum(axis=1), 1, atol=1e-6):
            raise ValueError("weights: expected numbers of at least 0 that sum to 1 for every vertex")
        if ((self.weights > 0).sum(axis=1) > CARRIERS).any():
            raise ValueError(f"weights: expected at most {CARRIERS} for a vertex (see strongest)")
        if self.shapes.ndim != 3 or self.shapes.shape[1:] != (N, 3):
            raise ValueError(f"shapes: expected shape (K, {N}, 3), got {self.shapes.shape}")
        if not len(self.axes):
            object.__setattr__(self, "axes", np.tile(np.eye(3), (J, 1, 1)))
        if self.axes.shape != (J, 3, 3):
            raise ValueError(f"axes: expected shape {(J, 3, 3)}, got {self.axes.shape}")

    def __repr__(self) -> str:
        return f"Rig({self.mesh!r}, {len(self.skeleton.parents)} joints, {len(self.shapes)} shapes)"

    def vertices(self, poses: np.ndarray, trans: np.ndarray | None = None, changes: np.ndarray | None = None
                 ) -> np.ndarray:
        """Compute the skinned mesh (N, 3) or (T, N, 3), metres, in one pose (J, 3) or several (T, J, 3), radians.

        `changes` (N, 3) or (T, N, 3), metres, are added to the rest mesh before it is skinned.
        """
        # rigid motion of every part: rotation, and the translation that keeps its joint in place
        R = self.skeleton.part_rotations(poses)
        offset = joint_places(self.skeleton, poses, trans) - np.einsum("...jab,jb->...ja", R, self.skeleton.joints)
        motions = np.concatenate([R, offset[..., None]], axis=-1).reshape(-1, R.shape[-3], 12)
        parts, rest = np.ascontiguousarray(self.weights.T), np.ascontiguousarray(self.mesh.vertices.T)
        added = np.broadcast_to(0.0 if changes is None else changes, (len(motions), *self.mesh.vertices.shape))
        out = np.empty((len(motions), *self.mesh.vertices.shape))
        for t, motion in enumerate(motions):
            M = (motion.T @ parts).reshape(3, 4, -1)                # the mean motion of every vertex
            x = rest if changes is None else rest + added[t].T
            out[t] = (np.einsum("abn,bn->an", M[:, :3], x) + M[:, 3]).T
        return out.reshape(*poses.shape[:-2], *self.mesh.vertices.shape)

    def local_rotations(self, poses: np.ndarray) -> np.ndarray:
        """Compute rotations (..., J, 3, 3) of bones relative to their parents, for poses (..., J, 3)."""
        above = np.concatenate([np.eye(3)[None], self.axes[self.skeleton.parents[1:]]])
        return np.swapaxes(above, -1, -2) @ rotations.exp(poses) @ self.axes

    @property
    def local_offsets(self) -> np.ndarray:
        """(J, 3) metres: offset of every joint from its parent in the parent bone's axes; the root's in the world."""
        joints, above = self.skeleton.joints, self.skeleton.parents[1:]
        return np.concatenate([joints[:1], np.einsum("jba,jb->ja", self.axes[above], joints[1:] - joints[above])])

    def beta_targets(self) -> tuple[list[str], np.ndarray]:
        """Make morph targets: their names, and their changes of the rest mesh (2K, N, 3), metres, at weight 1.

        Each beta has two, `beta 1 +3` and `beta 1 -3`. Sliders from 0 to 1 reach 3 standard deviations of either sign.
        """
        slider = 3.0  # standard deviations at weight 1: hardly anybody is beyond 3
        names = [f"beta {k + 1} {sign}{slider:g}" for k in range(len(self.shapes)) for sign in "+-"]
        changes = slider * np.stack([self.shapes, -self.shapes], axis=1)
        return names, changes.reshape(-1, *self.mesh.vertices.shape)

    def transform(self, R: np.ndarray, shift: np.ndarray | float = 0.0) -> Rig:
        """Rotate the rig by R (3, 3) and then shift it, metres; `transform_rig` also changes its motion."""
        extra = self.correctives and replace(self.correctives, shapes=self.correctives.shapes @ R.T)
        return replace(self, mesh=self.mesh.with_vertices(self.mesh.vertices @ R.T + shift), shapes=self.shapes @ R.T,
                       skeleton=replace(self.skeleton, joints=self.skeleton.joints @ R.T + shift), axes=R @ self.axes,
                       correctives=extra)

    def with_attached(self) -> Rig:
        """Return the rig of the whole mesh, with what is attached to the body; its skeleton keeps the body's parts."""
        attached, rest = self.mesh.attached, self.mesh.vertices
        if attached is None:
            return self
        whole, extra = attached.mesh(self.mesh), self.correctives

        def changes(shapes: np.ndarray) -> np.ndarray:
            moved = [attached.follow(rest + shape) - whole.vertices for shape in shapes]
            return np.stack(moved) if moved else np.zeros((0, *whole.vertices.shape))

        return replace(self, mesh=whole, weights=strongest(attached.spread(self.weights)), shapes=changes(self.shapes),
                       correctives=extra and replace(extra, shapes=changes(extra.shapes)))

    def with_up(self, up: int) -> Rig:
        """Turn the axis `up` to +y; poses and trans turn with `turn_up`."""
        return self.transform(turn_up(up))


def make_rig(model: BodyModel, betas: np.ndarray | None = None, shapes: int = 0) -> Rig:
    """Build the rig of one person, for linear blend skinning.

    Parameters
    ----------
    model : BodyModel
        A model of any kind.
    betas : (k,) float, optional
        None is the template's own body, which has no shapes.
    shapes : int
        Number of first betas that become shapes, at most all of the model.

    Returns
    -------
    Rig
        The mesh at rest with its skeleton, weights (N, J) and shapes, as `write_skinned_glb` takes it. The weights are
        those of a skinning model or of `skin_weights`; the largest `CARRIERS` of every vertex are kept.

    Raises
    ------
    ValueError
        Shapes of the template's own body.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> rig = make_rig(load_built_in_model(), np.zeros(2), shapes=2)
    >>> rig.weights.shape, rig.shapes.shape
    ((5002, 16), (2, 5002, 3))
    """
    if shapes and betas is None:
        raise ValueError(f"shapes: the template's own body has none, got {shapes}")
    rest = np.zeros((len(model.skeleton.parents), 3))
    mesh = model.template.with_vertices(model.vertices(rest, betas), model.template.up)
    return Rig(mesh, replace(model.skeleton, joints=model.rest_joints(betas)),
               strongest(model.skin_weights),
               np.moveaxis(model.shape_jacobian(rest)[..., :shapes], -1, 0))


def subject_rig(subject: Subject) -> Rig:
    """Build the rig of a subject, without shapes."""
    skeleton, template = subject.skeleton, subject.template
    rest = subject.vertices(np.zeros(skeleton.joints.shape))
    return Rig(template.with_vertices(rest, template.up), replace(skeleton, joints=subject.joint_regressor @ rest),
               strongest(skin_weights(template, skeleton)), np.zeros((0, *rest.shape)))


def change_root(rig: Rig, poses: np.ndarray, trans: np.ndarray, root: str) -> tuple[Rig, np.ndarray, np.ndarray]:
    """Make another part the root of the skeleton; the surface moves as before.

    All parts turn as before and the joints between parts stay where they are. The new root's joint is the centroid of
    its part's vertices, as in the models.

    Parameters
    ----------
    rig : Rig
        The body.
    poses : (T, J, 3) float, radians
        T may be 0.
    trans : (T, 3) float, metres
        Travel of the root's joint.
    root : str
        Name of a part.

    Raises
    ------
    ValueError
        A part that the skeleton has not.
    """
    old = rig.skeleton
    if root not in old.names:
        raise ValueError(f"root: expected a part of the body ({', '.join(old.names)}), got {root!r}")
    links = np.stack([np.arange(1, len(old.parents)), old.parents[1:]], axis=1)
    # links on the way from the new root to the old one change direction: parent and child swap
    order = reorder(old.part_of_face, links, old.names.index(root))
    now = np.argsort(order)                                           # new numbers of the old parts
    parents, joints = np.full(len(order), -1), old.joints[order]
    for a, b in links:
        child = a if now[a] > now[b] else b
        parents[now[child]], joints[now[child]] = now[a + b - child], old.joints[a]
    new = Skeleton(now[old.part_of_face], parents, joints, tuple(old.names[p] for p in order))
    new = new.with_root_centred(rig.mesh)
    # the motion of the new root: its rotation, and where its centroid goes
    R, first = old.part_rotations(poses), order[0]
    places = joint_places(old, poses, trans)[:, first] + R[:, first] @ (new.joints[0] - old.joints[first])
    return (replace(rig, skeleton=new, weights=rig.weights[:, order], axes=rig.axes[order]), new.pose_of(R[:, order]),
            places - new.joints[0])


def transform_rig(rig: Rig, poses: np.ndarray, trans: np.ndarray, rest: tuple[np.ndarray, np.ndarray],
                  world: tuple[np.ndarray, np.ndarray]) -> tuple[Rig, np.ndarray, np.ndarray]:
    """Rotate and shift the body at rest by `rest`, and its motion by `world`, each a pair (R (3, 3), shift (3,)).

    Poses are (T, J, 3), radians, trans (T, 3), metres; T may be 0.
    """
    (Q, shift), (W, step) = rest, world
    moved = rig.transform(Q, shift)
    places = (rig.skeleton.joints[0] + trans) @ W.T + step
    turns = poses @ Q.T
    if len(poses) and not np.array_equal(Q, W):
        turns[:, 0] = rotations.log(W @ rotations.exp(poses[:, 0]) @ Q.T)
    return moved, turns, places - moved.skeleton.joints[0]


def joint_places(skeleton: Skeleton, poses: np.ndarray, trans: np.ndarray | None = None) -> np.ndarray:
    """Compute the joint positions (..., J, 3), metres, of a skeleton with bones of fixed length."""
    R = skeleton.part_rotations(poses)
    out = np.empty(R.shape[:-1])
    out[..., 0, :] = skeleton.joints[0] + (0.0 if trans is None else np.asarray(trans))
    for j in range(1, len(skeleton.parents)):
        p = skeleton.parents[j]
        out[..., j, :] = out[..., p, :] + R[..., p, :, :] @ (skeleton.joints[j] - skeleton.joints[p])
    return out


def check_motion(skeleton: Skeleton, poses: np.ndarray, trans: np.ndarray | None, rate: float
                 ) -> tuple[np.ndarray, np.ndarray]:
    """Check poses (T, J, 3), trans (T, 3) and rate of a motion, else ValueError."""
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
