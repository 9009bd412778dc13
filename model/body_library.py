"""Import of MHR and SOMA-X, read by the optional library `body-models` (Apache-2.0), as a skinning model.

These models have neural correctives, joints that share a twist, and bones of variable length. The library evaluates
them pose by pose and shape by shape; a skinning model is fitted to the results:

    rest mesh + changes by betas      forward(rest pose, ±1), half the difference
    joints that people move           those that a control turns most; joints that turn along with them are merged
    correctives, linear in R - I      of each joint by itself: what skinning lacks in poses of this joint

The error on poses and shapes that were left out is measured and kept with the model.
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

# how a folder is recognised: a file that only this model has, then the library's module and class that read it
FOLDERS = {"mhr_model.pt": ("body_models.mhr.numpy", "MHR"), "SOMA_neutral.npz": ("body_models.soma.numpy", "SOMA")}
# the library names joints, we name the part that begins there
PARTS = {"shoulder": "upper_arm", "elbow": "forearm", "wrist": "hand", "hip": "thigh", "knee": "shin", "ankle": "foot",
         "foot": "toes"}

LONGER = 0.04                        # length that one beta adds to a bone: 4%, about the spread of statures
BENT, POSES = 0.5, 32                # radians (standard deviation) and number of poses that each joint is learned from
LEFT_OUT, TESTS = 0.3, 60            # radians and number of poses for the error: all joints bend, each of them less
AT_ONCE = 8                          # bodies that the library makes together: 18,000 vertices with a matrix each
ROUNDING = 1e-6                      # metres: a smaller change counts as none
BONES, NOTHING = -2, -1              # stand for a joint where a control changes bone lengths, or nothing


def import_any(path: str | Path, progress: Progress | None = None) -> SkinningModel:
    """Import a file in the layout of the SMPL family, or a folder with the files of MHR or SOMA-X.

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
            library_model = kind(model_path=folder)           # it downloads only where no folder is given
        except FileNotFoundError as problem:           # its message names the missing file
            raise ValueError(str(problem)) from None
        return as_ours(library_model, name, progress)


def as_ours(theirs: Any, name: str, progress: Progress | None = None) -> SkinningModel:
    """Fit a skinning model to a model of the library."""
    rng, body = np.random.default_rng(0), Library(theirs)
    template = Mesh(body.vertices(body.rest)[0], np.asarray(theirs.skinning_spec.triangles, dtype=np.int64))
    joints, (units, shapes, moved) = body.skeleton(body.rest)[1][0], body.directions
    J, C, bones = len(joints), body.rest.shape[1], int(units[:, :body.rest.shape[1]].any(axis=1).sum())
    # what a user must know of the approximation
    notes = ("pose correctives are linear in the rotation of each joint by itself; face, eyes and joints that turn "
             "along with others are no joints here")
    if bones:
        notes += f"; {bones} betas are lengths of bones, whose spread no file tells: {LONGER:.0%} each"
    # the model without correctives, then the correctives of one joint after the other
    regressor = joint_rows(template.vertices, joints, shapes, moved)
    published = Published(template, np.moveaxis(shapes, 0, -1), np.zeros((*template.vertices.shape, 0)), regressor,
                          body.weights, body.parents, body.names, {}, ())
    plain = as_skinning(published, {})
    bends = []
    for j in range(1, J):
        bends.append(corrective_shapes(body, plain, j, rng))
        if progress is not None:
            progress(j, J - 1)
    published = replace(published, bends=np.moveaxis(np.concatenate(bends), 0, -1))
    model = replace(as_skinning(published, {"imported": name, "notes": notes}), joint_components=moved)
    # the error on random poses and shapes that nothing was learned from
    controls, betas = body.draw(range(1, J), LEFT_OUT, TESTS, rng), rng.normal(size=(TESTS, len(units)))
    exact = body.vertices(controls + betas @ units[:, :C], betas @ units[:, C:])
    off = model.vertices(body.poses(controls), betas) - exact
    model.info["left_out_error"] = float(np.linalg.norm(off, axis=-1).mean())
    return model


def corrective_shapes(body: Library, plain: SkinningModel, j: int, rng: np.random.Generator) -> np.ndarray:
    """Fit the correctives (9, N, 3) of joint j, metres: changes of the rest mesh, linear in its R - I.

    They are fitted to random poses of this joint alone.
    """
    controls = body.draw([j], BENT, POSES, rng)
    poses = body.poses(controls)
    # what skinning lacks, turned back to the rest mesh by the blended rotations
    off = body.vertices(controls) - plain.subject(None).vertices(poses)
    lacking = np.stack([invert_blended(plain.blend_rotations(pose)) @ each[..., None]
                        for pose, each in zip(poses, off, strict=True)])
    X = (rotations.exp(poses[:, j]) - np.eye(3)).reshape(POSES, 9)
    # ridge regression on R - I; its weight is small against the mean square of R - I in poses of half a radian
    out = np.linalg.solve(X.T @ X + 1e-3 * POSES * np.eye(9), X.T @ lacking.reshape(POSES, -1))
    out[np.abs(out) < ROUNDING] = 0
    return out.reshape(9, *plain.rest.shape).astype(np.float32)


def joint_rows(vertices: np.ndarray, joints: np.ndarray, shapes: np.ndarray, moved: np.ndarray) -> csr_array:
    """Fit a joint regressor (J, N): joints as combinations of the vertices near them.

    It is exact at rest and nearly right where betas move vertices, `shapes` (K, N, 3), and joints, `moved` (K, J, 3),
    metres. It must fit both, because soft tissue can grow about a joint that stays where it is.
    """
    out = np.zeros((len(joints), len(vertices)))
    for j, place in enumerate(joints):
        # the 200 nearest vertices, which lie on all sides of the joint, may take part
        near = np.argsort(np.linalg.norm(vertices - place, axis=1), kind="stable")[:200]
        start = affine_weights(vertices[near], place)
        # changes of the weights that keep their sum and the joint at rest; among them the best for the betas
        free = null_space(np.vstack([np.ones(len(near)), vertices[near].T]))
        U = np.swapaxes(shapes[:, near], 1, 2).reshape(-1, len(near))
        A, b = U @ free, moved[:, j].ravel() - U @ start
        # ridge of a millimetre: weights stay small where the betas determine nothing
        out[j, near] = start + free @ np.linalg.solve(A.T @ A + 1e-3**2 * np.eye(free.shape[1]), A.T @ b)
    return csr_array(out)


@dataclass(frozen=True, eq=False)
class Library:
    """A model of the library: C pose controls and I identity coefficients in, J chosen joints and N vertices out."""

    theirs: Any

    @cached_property
    def rest(self) -> np.ndarray:
        """(1, C) the controls of the rest pose."""
        return np.zeros((1, self._size("pose")))

    def vertices(self, controls: np.ndarray, identity: np.ndarray | None = None) -> np.ndarray:
        """Compute the vertices (T, N, 3), metres, for controls (T, C) and identities (T, I), else the mean person."""
        return self._evaluate(self.theirs.forward_vertices, controls, identity)

    def skeleton(self, controls: np.ndarray, identity: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Compute world rotations (T, J, 3, 3) and positions (T, J, 3), metres, of our joints."""
        G = self._evaluate(self.theirs.forward_skeleton, controls, identity)[:, self.joints]
        return turns(G), G[..., :3, 3]

    def poses(self, controls: np.ndarray) -> np.ndarray:
        """Convert controls (T, C) to poses (T, J, 3), radians, of the skinning model."""
        R = self.skeleton(controls)[0] @ np.swapaxes(self.skeleton(self.rest)[0], -1, -2)
        R[:, 1:] = np.swapaxes(R[:, self.parents[1:]], -1, -2) @ R[:, 1:]
        return rotations.log(R)

    def draw(self, joints: range | list[int], spread: float, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw random controls (count, C), radians; only those that mainly turn the given joints are not zero."""
        leading = np.isin(self._leaders, self.joints[joints])
        return np.where(leading, rng.normal(0, spread, (count, len(leading))), 0)

    @cached_property
    def joints(self) -> np.ndarray:
        """(J,) the library's numbers of our joints, parents first.

        They are the pelvis and every joint below it that a control turns, on the way to a joint that all models of
        the library have.
        """
        pelvis, *others = self._common
        kept = {j for other in others for j in self._above(other)
                if j in self._leaders and pelvis in self._above(j)[1:]}
        return np.array([pelvis, *sorted(kept, key=lambda j: (len(self._above(j)), j))])

    @cached_property
    def parents(self) -> np.ndarray:
        """(J,) parent of each of our joints, -1 for the pelvis."""
        return np.array([-1, *(self._carrier(self.theirs.parents[j]) for j in self.joints[1:])])

    @cached_property
    def weights(self) -> np.ndarray:
        """(N, J) blend weights: joints that we leave out give theirs to the next of our joints above."""
        library_weights = np.asarray(self.theirs.skin_weights, dtype=np.float64)
        out = np.zeros((len(library_weights), len(self.joints)))
        np.add.at(out.T, [self._carrier(j) for j in range(library_weights.shape[1])], library_weights.T)
        return out / out.sum(axis=1, keepdims=True)

    @cached_property
    def directions(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Each beta in terms of controls and identity (K, C + I), and what it changes, metres.

        Changes are those of vertices (K, N, 3) and joints (K, J, 3). Betas that move the surface most come first.
        """
        C, x = self.rest.shape[1], self.vertices(self.rest)[0]
        bones, own = np.flatnonzero(self._leaders == BONES), np.arange(C, C + self._size("identity"))
        # controls of bone lengths are probed with 0.1, about 7% of a length; identity coefficients with 1
        units = np.eye(C + len(own))[np.r_[bones, own]] * np.r_[np.full(len(bones), 0.1), np.ones(len(own))][:, None]
        by_vertex, by_joint = zip(*[(self.vertices(*both), self.skeleton(*both)[1]) for both in (
            np.split(sign * units, [C], axis=1) for sign in (1, -1))], strict=True)
        shapes, moved = (by_vertex[0] - by_vertex[1]) / 2, (by_joint[0] - by_joint[1]) / 2
        # a bone's beta is scaled to add LONGER of the length of what it carries
        for k in range(len(bones)):
            far = np.linalg.norm(shapes[k], axis=1)
            size = LONGER * np.ptp(x[far >= far.max() / 10], axis=0).max()
            size /= max(np.ptp(shapes[k], axis=0).max(), ROUNDING)
            units[k], shapes[k], moved[k] = size * units[k], size * shapes[k], size * moved[k]
        # largest effect first; coefficients that change nothing are left out
        order = np.argsort(-(shapes**2).sum(axis=(1, 2)), kind="stable")
        order = order[np.abs(shapes[order]).max(axis=(1, 2)) > ROUNDING]
        return units[order], shapes[order], moved[order]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """(J,) our names of the parts; joints between common ones take the name of these and a number."""
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
        """(C,) the joint of the library that each control turns most; among equals the nearest to the root.

        `BONES` where a control turns nothing but moves or scales joints below the pelvis, else `NOTHING`.
        """
        parents, pelvis = np.array(self.theirs.parents), self._common[0]
        step = 1e-4  # finite difference by which every control is probed
        G = self._evaluate(self.theirs.forward_skeleton, np.r_[self.rest, step * np.eye(self.rest.shape[1])], None)
        R = turns(G)
        # rotations relative to the parent, and how fast each control turns them
        R = np.where((parents < 0)[:, None, None], R, np.swapaxes(R[:, parents], -1, -2) @ R)
        turned = np.linalg.norm(rotations.log(np.swapaxes(R[0], -1, -2) @ R[1:]), axis=-1) / step           # (C, all)
        order = np.argsort([len(self._above(j)) for j in range(len(parents))], kind="stable")
        most = turned.max(axis=1)
        leader = order[(turned[:, order] > most[:, None] - 1e-3).argmax(axis=1)]
        # controls that turn nothing: do joints move relative to the pelvis?
        G[..., :3, 3] -= G[:, pelvis, None, :3, 3]
        below = [j for j in range(len(parents)) if pelvis in self._above(j)]
        changed = np.abs(G[1:, below] - G[0, below]).max(axis=(1, 2, 3)) / step
        return np.where(most > 1e-3, leader, np.where(changed > 1e-3, BONES, NOTHING))

    @cached_property
    def _common(self) -> list[int]:
        """The library's numbers of the joints that all of its bodies have, the pelvis first."""
        return [self.theirs.joint_names.index(name) for name in self.theirs.common_joints.values()]

    def _above(self, j: int) -> list[int]:
        """List joint j of the library and its ancestors, up to the root."""
        out = [j]
        while self.theirs.parents[out[-1]] >= 0:
            out.append(self.theirs.parents[out[-1]])
        return out

    def _carrier(self, j: int) -> int:
        """Find which of our joints carries the library's joint j: itself or its nearest ancestor, else the pelvis."""
        return next((int(np.flatnonzero(self.joints == p)[0]) for p in self._above(j) if p in self.joints), 0)

    def _evaluate(self, forward: Callable[..., Any], controls: np.ndarray, identity: np.ndarray | None) -> np.ndarray:
        """Evaluate the library for controls (T, C) and identities (T, I), a few bodies at a time."""
        out = []
        for rows in np.array_split(np.arange(len(controls)), -(-len(controls) // AT_ONCE)):
            shape = {"identity": self._mean} if identity is None else self._arguments("identity", identity[rows])
            out.append(np.asarray(forward(**self._arguments("pose", controls[rows]), **shape), dtype=np.float64))
            if not np.isfinite(out[-1]).all():
                raise ValueError("the library makes numbers of them that are not finite")
        return np.concatenate(out)

    @cached_property
    def _mean(self) -> Any:
        """The library's prepared identity of the mean person."""
        zero = self._arguments("identity", np.zeros((1, self._size("identity"))))
        return self.theirs.prepare_identity(**{name: value[0] for name, value in zero.items()})

    def _arguments(self, role: str, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Split rows (T, ...) of numbers into the library's named arguments of a role."""
        dims = {name: spec.dims for name, spec in self.theirs.parameter_spec.items() if spec.role == role}
        parts = np.split(rows, np.cumsum([int(np.prod(each)) for each in dims.values()])[:-1], axis=1)
        return {name: part.reshape(len(rows), *each) for part, (name, each) in zip(parts, dims.items(), strict=True)}

    def _size(self, role: str) -> int:
        return sum(int(np.prod(spec.dims)) for spec in self.theirs.parameter_spec.values() if spec.role == role)


def turns(G: np.ndarray) -> np.ndarray:
    """Extract the rotations (..., 3, 3) of transforms (..., 4, 4) that may also scale."""
    return rotations.project(G[..., :3, :3].reshape(-1, 3, 3)).reshape(*G.shape[:-2], 3, 3)


def our_name(joint: str) -> str:
    """Translate a joint's name to ours of the part: left_elbow is forearm_left, left_index_mcp is index1_left."""
    plain, side = split_side(joint)
    finger, _, knuckle = plain.partition("_")
    # joints of fingers, counted from the hand; the thumb's first is the cmc
    knuckles = {"cmc": 1, "mcp": 1, "thumb_mcp": 2, "pip": 2, "dip": 3, "ip": 3}
    name = PARTS.get(plain, f"{finger}{knuckles.get(plain, knuckles.get(knuckle, ''))}")
    return f"{name}_{side}" if side else name
