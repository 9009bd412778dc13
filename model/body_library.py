"""MHR and SOMA-X, as the optional library `body-models` (Apache-2.0) reads them, become a skinning model.

Neural correctives, joints that twist by shares and bones that change their length are asked of the library, pose by
pose and shape by shape, and told by what a skinning model has:

    rest mesh + changes by betas      forward(rest pose, ±1), half the difference
    joints that people move           those that a control turns most; they carry what turns along with them
    correctives, linear in R - I      of each joint by itself: what skinning lacks in poses of this joint

How far that is from the library in poses and shapes that were left out is measured and kept with the model.
"""
from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import null_space
from scipy.sparse import csr_array

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sides import split_side
from scanprep.geometry.storage import StorageError, taking_apart
from scanprep.skeleton.roles import part_kind
from scanprep.skeleton.tree import affine_weights

from .body import Progress
from .importing import Published, as_skinning, import_model
from .skinning import SkinningModel, invert_blended

# by the file that only this model's folder has: the module and class of the library
FOLDERS = {"mhr_model.pt": ("body_models.mhr.numpy", "MHR"), "SOMA_neutral.npz": ("body_models.soma.numpy", "SOMA")}
# our parts by the library's joints, and how its joints of the fingers are counted from the hand
PARTS = {"shoulder": "upper_arm", "elbow": "forearm", "wrist": "hand", "hip": "thigh", "knee": "shin", "ankle": "foot",
         "foot": "toes"}

LONGER = 0.04                        # share of what a bone carries that a beta of it adds: statures spread by it
BENT, POSES = 0.5, 32                # radians, standard deviation, and number of the poses of a joint to learn from
LEFT_OUT, TESTS = 0.3, 60            # the same of all controls together, of the bodies that tell the error
AT_ONCE = 8                          # bodies that the library makes together: 18,000 vertices with a matrix each
ROUNDING = 1e-6                      # metres below which a change is none
BONES, NOTHING = -2, -1              # what a control may lead in the place of a joint


def import_any(path: str | Path, progress: Progress | None = None) -> SkinningModel:
    """A model of ours of a file of the SMPL family's layout, or of a folder with the files of MHR or SOMA-X.

    Parameters
    ----------
    path : path
        A file for `import_model`, a folder of the files that the library names, or the first of these, see `FOLDERS`.
    progress : callable, optional
        Called with the joints learned so far and their number.

    Raises
    ------
    StorageError
        As `import_model`; a folder of neither, or that lacks a file; a library that is not installed.
    """
    path = Path(path)
    folder = path.parent if path.name in FOLDERS else path
    if not folder.is_dir():
        return import_model(path)
    module, name = next((each for file, each in FOLDERS.items() if (folder / file).is_file()), ("", ""))
    if not name:
        raise StorageError(f"{folder}: expected a folder of MHR or SOMA-X, found neither {' nor '.join(FOLDERS)} in it")
    try:
        kind = getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as missing:
        raise StorageError(f"{folder}: {name} is read by a library that is not installed here (no {missing.name}): "
                           "pip install body-models") from None
    with taking_apart(folder, f"the files of {name}"):
        try:
            theirs = kind(model_path=folder)           # it downloads only where no folder is given
        except FileNotFoundError as problem:           # tells which file is missing
            raise ValueError(str(problem)) from None
        return as_ours(theirs, name, progress)


def as_ours(theirs: Any, name: str, progress: Progress | None = None) -> SkinningModel:
    """A skinning model of a model of the library."""
    rng, body = np.random.default_rng(0), Library(theirs)
    template = Mesh(body.vertices(body.rest)[0], np.asarray(theirs.skinning_spec.triangles, dtype=np.int64))
    joints, (units, shapes, moved) = body.skeleton(body.rest)[1][0], body.directions
    J, C, bones = len(joints), body.rest.shape[1], int(units[:, :body.rest.shape[1]].any(axis=1).sum())
    notes = ("pose correctives are linear in the rotation of each joint by itself; face, eyes and joints that turn "
             "along with others are no joints here")
    if bones:
        notes += f"; {bones} betas are lengths of bones, whose spread no file tells: {LONGER:.0%} each"
    regressor = joint_rows(template.vertices, joints, shapes, moved)
    found = Published(template, np.moveaxis(shapes, 0, -1), np.zeros((*template.vertices.shape, 0)), regressor,
                      body.weights, body.parents, body.names, {}, ())
    plain = as_skinning(found, {})
    bends = []
    for j in range(1, J):
        bends.append(corrective_shapes(body, plain, j, rng))
        if progress is not None:
            progress(j, J - 1)
    found = replace(found, bends=np.moveaxis(np.concatenate(bends), 0, -1))
    model = replace(as_skinning(found, {"imported": name, "notes": notes}), joint_components=moved)
    # poses and shapes that nothing was learned from
    controls, betas = body.draw(range(1, J), LEFT_OUT, TESTS, rng), rng.normal(size=(TESTS, len(units)))
    exact = body.vertices(controls + betas @ units[:, :C], betas @ units[:, C:])
    off = model.vertices(body.poses(controls), betas) - exact
    model.info["left_out_error"] = float(np.linalg.norm(off, axis=-1).mean())
    return model


def corrective_shapes(body: Library, plain: SkinningModel, j: int, rng: np.random.Generator) -> np.ndarray:
    """(9, N, 3) metres, changes of the rest mesh by R - I of joint j, in poses of this joint, that skinning lacks."""
    controls = body.draw([j], BENT, POSES, rng)
    poses = body.poses(controls)
    off = body.vertices(controls) - plain.subject(None).vertices(poses)
    lacking = np.stack([invert_blended(plain.blend_rotations(pose)) @ each[..., None]
                        for pose, each in zip(poses, off, strict=True)])
    X = (rotations.exp(poses[:, j]) - np.eye(3)).reshape(POSES, 9)
    # mean square of a number of R - I that counts as nothing
    out = np.linalg.solve(X.T @ X + 1e-3 * POSES * np.eye(9), X.T @ lacking.reshape(POSES, -1))
    out[np.abs(out) < ROUNDING] = 0
    return out.reshape(9, *plain.rest.shape).astype(np.float32)


def joint_rows(vertices: np.ndarray, joints: np.ndarray, shapes: np.ndarray, moved: np.ndarray) -> csr_array:
    """(J, N) joints as combinations of the vertices near them, exactly at rest, and nearly where betas move both.

    Shapes (K, N, 3) and moved (K, J, 3), metres: flesh grows about joints that stay where they are.
    """
    out = np.zeros((len(joints), len(vertices)))
    for j, place in enumerate(joints):
        # vertices that a joint is a combination of
        near = np.argsort(np.linalg.norm(vertices - place, axis=1), kind="stable")[:200]
        start = affine_weights(vertices[near], place)
        free = null_space(np.vstack([np.ones(len(near)), vertices[near].T]))
        U = np.swapaxes(shapes[:, near], 1, 2).reshape(-1, len(near))
        A, b = U @ free, moved[:, j].ravel() - U @ start
        # a vertex tells its place to a millimetre
        out[j, near] = start + free @ np.linalg.solve(A.T @ A + 1e-3**2 * np.eye(free.shape[1]), A.T @ b)
    return csr_array(out)


@dataclass(frozen=True, eq=False)
class Library:
    """A model of the library, posed by one row of C controls, shaped by I numbers of identity, with J of its joints."""

    theirs: Any

    @cached_property
    def rest(self) -> np.ndarray:
        """(1, C) the controls of the rest pose."""
        return np.zeros((1, self._size("pose")))

    def vertices(self, controls: np.ndarray, identity: np.ndarray | None = None) -> np.ndarray:
        """(T, N, 3) metres, of controls (T, C) and identities (T, I); without, the mean person."""
        return self._evaluate(self.theirs.forward_vertices, controls, identity)

    def skeleton(self, controls: np.ndarray, identity: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (T, J, 3, 3) of our joints in the world, and where they are (T, J, 3), metres."""
        G = self._evaluate(self.theirs.forward_skeleton, controls, identity)[:, self.joints]
        return turns(G), G[..., :3, 3]

    def poses(self, controls: np.ndarray) -> np.ndarray:
        """Poses (T, J, 3), radians, of a skinning model, of controls (T, C)."""
        R = self.skeleton(controls)[0] @ np.swapaxes(self.skeleton(self.rest)[0], -1, -2)
        R[:, 1:] = np.swapaxes(R[:, self.parents[1:]], -1, -2) @ R[:, 1:]
        return rotations.log(R)

    def draw(self, joints: range | list[int], spread: float, count: int, rng: np.random.Generator) -> np.ndarray:
        """(count, C) random controls, radians, of those that turn some of our joints more than any other."""
        leading = np.isin(self._leaders, self.joints[joints])
        return np.where(leading, rng.normal(0, spread, (count, len(leading))), 0)

    @cached_property
    def joints(self) -> np.ndarray:
        """(J,) the library's numbers of our joints, parents first: the pelvis, and of those below that lead a control
        all that are, or have below them, a joint common to the models of the library.
        """
        pelvis, *others = self._common
        kept = {j for other in others for j in self._above(other)
                if j in self._leaders and pelvis in self._above(j)[1:]}
        return np.array([pelvis, *sorted(kept, key=lambda j: (len(self._above(j)), j))])

    @cached_property
    def parents(self) -> np.ndarray:
        """(J,) the joint of ours that each of ours hangs on, -1 for the pelvis."""
        return np.array([-1, *(self._carrier(self.theirs.parents[j]) for j in self.joints[1:])])

    @cached_property
    def weights(self) -> np.ndarray:
        """(N, J) skinning weights: our joints carry also what hangs on them by others."""
        theirs = np.asarray(self.theirs.skin_weights, dtype=np.float64)
        out = np.zeros((len(theirs), len(self.joints)))
        np.add.at(out.T, [self._carrier(j) for j in range(theirs.shape[1])], theirs.T)
        return out / out.sum(axis=1, keepdims=True)

    @cached_property
    def directions(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What each beta is in controls and identity (K, C + I), and its changes of vertices (K, N, 3) and joints
        (K, J, 3), metres; those that move the surface most come first.
        """
        C, x = self.rest.shape[1], self.vertices(self.rest)[0]
        bones, own = np.flatnonzero(self._leaders == BONES), np.arange(C, C + self._size("identity"))
        # of a control of bones, to learn what it does: about 7% of a length
        units = np.eye(C + len(own))[np.r_[bones, own]] * np.r_[np.full(len(bones), 0.1), np.ones(len(own))][:, None]
        by_vertex, by_joint = zip(*[(self.vertices(*both), self.skeleton(*both)[1]) for both in (
            np.split(sign * units, [C], axis=1) for sign in (1, -1))], strict=True)
        shapes, moved = (by_vertex[0] - by_vertex[1]) / 2, (by_joint[0] - by_joint[1]) / 2
        for k in range(len(bones)):
            far = np.linalg.norm(shapes[k], axis=1)
            size = LONGER * np.ptp(x[far >= far.max() / 10], axis=0).max()
            size /= max(np.ptp(shapes[k], axis=0).max(), ROUNDING)
            units[k], shapes[k], moved[k] = size * units[k], size * shapes[k], size * moved[k]
        order = np.argsort(-(shapes**2).sum(axis=(1, 2)), kind="stable")
        order = order[np.abs(shapes[order]).max(axis=(1, 2)) > ROUNDING]
        return units[order], shapes[order], moved[order]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Our names (J,) of the joints; those between common ones are called after these, and counted."""
        common = dict(zip(self._common, map(our_name, map(str, self.theirs.common_joints)), strict=True))
        arms = [j for j, name in common.items() if part_kind(name) == "upper_arm"]
        trunk = [j for j in self.joints[1:] if all(j in self._above(arm)[1:] for arm in arms)]
        out: dict[int, str] = {}
        for j in self.joints:
            above = next((common[p] for p in self._above(j)[1:] if p in common), "pelvis")
            below = next(name for each, name in common.items() if j in self._above(each))
            if j in trunk:
                name = "chest" if j == trunk[-1] else "abdomen"
            elif above == "pelvis":                    # collarbones
                name = below.replace("upper_arm", "shoulder")
            else:                                      # bones of palm and foot, or limbs in pieces
                name = below if part_kind(above) in ("hand", "foot") else above
            plain, side = part_kind(name), split_side(name)[1]
            tries = [f"{plain}{k or ''}" + (f"_{side}" if side else "") for k in (0, *range(2, 99))]
            out[j] = common.get(j) or next(each for each in tries if each not in {*out.values(), *common.values()})
        return tuple(out.values())

    @cached_property
    def _leaders(self) -> np.ndarray:
        """(C,) the joint of the library that each control turns most, of equals the nearest to the root; `BONES` where
        it turns none, but changes place or size of joints below the pelvis, else `NOTHING`.
        """
        parents, pelvis = np.array(self.theirs.parents), self._common[0]
        step = 1e-4  # of a control, to see what it does
        G = self._evaluate(self.theirs.forward_skeleton, np.r_[self.rest, step * np.eye(self.rest.shape[1])], None)
        R = turns(G)
        R = np.where((parents < 0)[:, None, None], R, np.swapaxes(R[:, parents], -1, -2) @ R)
        turned = np.linalg.norm(rotations.log(np.swapaxes(R[0], -1, -2) @ R[1:]), axis=-1) / step           # (C, all)
        order = np.argsort([len(self._above(j)) for j in range(len(parents))], kind="stable")
        most = turned.max(axis=1)
        leader = order[(turned[:, order] > most[:, None] - 1e-3).argmax(axis=1)]
        G[..., :3, 3] -= G[:, pelvis, None, :3, 3]
        below = [j for j in range(len(parents)) if pelvis in self._above(j)]
        changed = np.abs(G[1:, below] - G[0, below]).max(axis=(1, 2, 3)) / step
        return np.where(most > 1e-3, leader, np.where(changed > 1e-3, BONES, NOTHING))

    @cached_property
    def _common(self) -> list[int]:
        """The library's numbers of the joints that all of its bodies have, the pelvis first."""
        return [self.theirs.joint_names.index(name) for name in self.theirs.common_joints.values()]

    def _above(self, j: int) -> list[int]:
        """Joint j of the library and all it hangs on, to the root."""
        out = [j]
        while self.theirs.parents[out[-1]] >= 0:
            out.append(self.theirs.parents[out[-1]])
        return out

    def _carrier(self, j: int) -> int:
        """Which of our joints the joint j of the library is or hangs on; the pelvis for what it hangs on itself."""
        return next((int(np.flatnonzero(self.joints == p)[0]) for p in self._above(j) if p in self.joints), 0)

    def _evaluate(self, forward: Callable[..., Any], controls: np.ndarray, identity: np.ndarray | None) -> np.ndarray:
        """What the library makes of controls (T, C) and identities (T, I), a few at a time."""
        out = []
        for rows in np.array_split(np.arange(len(controls)), -(-len(controls) // AT_ONCE)):
            shape = {"identity": self._mean} if identity is None else self._arguments("identity", identity[rows])
            out.append(np.asarray(forward(**self._arguments("pose", controls[rows]), **shape), dtype=np.float64))
            if not np.isfinite(out[-1]).all():
                raise ValueError("the library makes numbers of them that are not finite")
        return np.concatenate(out)

    @cached_property
    def _mean(self) -> Any:
        """What the library prepares of the identity of the mean person."""
        zero = self._arguments("identity", np.zeros((1, self._size("identity"))))
        return self.theirs.prepare_identity(**{name: value[0] for name, value in zero.items()})

    def _arguments(self, role: str, rows: np.ndarray) -> dict[str, np.ndarray]:
        """The arguments of a role, by their names, of rows (T, ...) of all their numbers."""
        dims = {name: spec.dims for name, spec in self.theirs.parameter_spec.items() if spec.role == role}
        parts = np.split(rows, np.cumsum([int(np.prod(each)) for each in dims.values()])[:-1], axis=1)
        return {name: part.reshape(len(rows), *each) for part, (name, each) in zip(parts, dims.items(), strict=True)}

    def _size(self, role: str) -> int:
        return sum(int(np.prod(spec.dims)) for spec in self.theirs.parameter_spec.values() if spec.role == role)


def turns(G: np.ndarray) -> np.ndarray:
    """The rotations (..., 3, 3) of transforms (..., 4, 4), which may stretch."""
    return rotations.project(G[..., :3, :3].reshape(-1, 3, 3)).reshape(*G.shape[:-2], 3, 3)


def our_name(joint: str) -> str:
    """Our name of the part at a joint of the library: forearm_left of left_elbow, index1_left of left_index_mcp."""
    plain, side = split_side(joint)
    finger, _, knuckle = plain.partition("_")
    knuckles = {"cmc": 1, "mcp": 1, "thumb_mcp": 2, "pip": 2, "dip": 3, "ip": 3}
    name = PARTS.get(plain, f"{finger}{knuckles.get(plain, knuckles.get(knuckle, ''))}")
    return f"{name}_{side}" if side else name
