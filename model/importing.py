"""Other people's body models: the arrays of the SMPL family become a skinning model.

    T(β, θ) = v_template + shapedirs β + posedirs f(θ),    joints J_regressor (v_template + shapedirs β)

and linear blend skinning of T about the joints, + trans (Loper et al. 2015). f is `R - I` of all joints but the root's,
row by row, or quaternions and then the second beta (Osman et al. 2020). Licences of such files are their users' affair.
"""
from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import ObjectsError, StorageError, check_regular, load_arrays, names_in, taking_apart
from scanprep.skeleton.names import name_parts
from scanprep.skeleton.symmetry import find_symmetry
from scanprep.skeleton.tree import Skeleton

from .features import Lift, QuaternionLift, RotationLift, part_features
from .human_poses import human_poses, is_held, with_human_poses
from .motion.amass import PARENTS
from .skinning import SkinningModel

NEEDED = ("v_template", "shapedirs", "weights", "kintree_table", "f")
WANTED = (*NEEDED, "posedirs", "J_regressor")

BODY = ("pelvis", "thigh_left", "thigh_right", "abdomen", "shin_left", "shin_right", "abdomen2", "foot_left",
        "foot_right", "chest", "toes_left", "toes_right", "neck", "shoulder_left", "shoulder_right", "head",
        "upper_arm_left", "upper_arm_right", "forearm_left", "forearm_right", "hand_left", "hand_right")
FINGERS = {side: tuple(f"{finger}{i}_{side}" for finger in ("index", "middle", "pinky", "ring", "thumb")
                       for i in (1, 2, 3)) for side in ("left", "right")}
NAMES = {24: (*BODY, "fingers_left", "fingers_right"), 52: (*BODY, *FINGERS["left"], *FINGERS["right"]),
         55: (*BODY, "jaw", "eye_left", "eye_right", *FINGERS["left"], *FINGERS["right"])}
FAMILY = {24: "smpl", 52: "smplh", 55: "smplx"}


@dataclass(frozen=True, eq=False)
class Published:
    """The arrays of a published model, checked: N vertices, J joints, K betas, C pose columns."""

    mesh: Mesh
    shapes: np.ndarray               # (N, 3, K) metres
    bends: np.ndarray                # (N, 3, C) metres
    regressor: csr_array             # (J, N)
    weights: np.ndarray              # (N, J)
    parents: np.ndarray              # (J,)
    names: tuple[str, ...]           # (J,) or none
    hands: dict[str, np.ndarray]     # mean poses (45,) of left and right
    notes: tuple[str, ...]


def import_model(path: str | Path) -> SkinningModel:
    """A linear body model of the SMPL family's layout, whose `vertices` are those of the published formula.

    Parameters
    ----------
    path : path
        `.npz` with v_template (N, 3), shapedirs (N, 3, K), posedirs (N, 3, 9 (J - 1)) or (N, 3, 4 (J - 1) + 1) or none,
        J_regressor (J, N), weights (N, J), kintree_table (2, J), f (F, 3); metres.

    Raises
    ------
    StorageError
        A pickle, arrays that are missing or do not fit, a joint before its parent: which one, and what was expected.

    Loper et al., SMPL, 2015.
    """
    found = read_published(path)
    model = as_skinning(found, {"imported": Path(path).name, "notes": "; ".join(found.notes)})
    family = "star" if model.features.lift.kind == QuaternionLift.kind else FAMILY.get(len(found.parents), "")
    if model.skeleton.names == NAMES.get(len(found.parents)):
        model.info["family"] = family                                         # whose motions are taken pose by pose
    return model


def as_skinning(found: Published, info: dict[str, Any]) -> SkinningModel:
    """The model of published arrays."""
    mesh, K, C = found.mesh, found.shapes.shape[2], found.bends.shape[2]
    skeleton = _skeleton(found)
    J, shapes, bends = len(found.parents), np.moveaxis(found.shapes, -1, 0), np.moveaxis(found.bends, -1, 0)
    joint_components = np.stack([found.regressor @ each for each in shapes]) if K else np.zeros((0, J, 3))
    lift: Lift = RotationLift()
    if C == 4 * (J - 1) + 1:                                       # the last column is the second beta's
        lift, shapes, bends = QuaternionLift(), shapes.copy(), bends[:-1]
        if K > 1:
            shapes[1] += found.bends[..., -1]
    axes = [np.zeros((lift.width, 0)), *[np.eye(lift.width) if C else np.zeros((lift.width, 0))] * (J - 1)]
    features = part_features(skeleton, lift, axes, [[j] for j in range(J)])
    variances = (shapes.astype(np.float64)**2).sum(axis=(1, 2))
    mean, covariance, examples = _poses(mesh, skeleton, found.hands)
    return SkinningModel(
        mesh, skeleton, mesh.vertices, found.weights, features, np.ascontiguousarray(bends), mesh.vertices,
        np.ascontiguousarray(shapes), variances, float(variances.sum()), mean, covariance, info,
        pose_examples=examples, regressor=found.regressor, joint_components=joint_components)


def _skeleton(found: Published) -> Skeleton:
    """Parts by the largest weight of each triangle; a joint that is nowhere the largest has the triangle nearest it."""
    mesh, J = found.mesh, len(found.parents)
    joints, on_face = found.regressor @ mesh.vertices, found.weights[mesh.faces].sum(axis=1)
    part, centre = on_face.argmax(axis=1), mesh.corners.mean(axis=1)
    for j in np.setdiff1d(np.arange(J), part):
        shared = np.bincount(part, minlength=J)[part] > 1
        best = on_face[:, j] if on_face[:, j].any() else -np.linalg.norm(centre - joints[j], axis=1)
        part[np.where(shared, best, -np.inf).argmax()] = j
    plain = Skeleton(part, found.parents, joints, found.names)
    known = NAMES.get(J, ())
    if not found.names and np.array_equal(found.parents[:22], PARENTS) and known:
        return Skeleton(part, found.parents, joints, known)
    return plain if found.names else Skeleton(part, found.parents, joints,
                                              name_parts(mesh, plain, find_symmetry(mesh)))


def _poses(mesh: Mesh, skeleton: Skeleton, hands: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean (J, 3) and covariance (3J, 3J) of the poses people take, radians, and examples; fingers and face at rest."""
    J = len(skeleton.parents)
    # poses of people that stand for those of training
    examples = human_poses(mesh, skeleton, 60, np.random.default_rng(0))
    if examples is None:
        examples, covariance = np.zeros((0, J, 3)), 0.5**2 * np.eye(3 * J)
        covariance[:3, :3] = 0
        return np.zeros((J, 3)), covariance, examples
    mean, covariance = with_human_poses(mesh, skeleton, 0, np.zeros((J, 3)), np.zeros((3 * J, 3 * J)))
    for side, pose in hands.items():
        mine = [skeleton.names.index(name) for name in FINGERS[side] if name in skeleton.names]
        if len(pose) == 3 * len(mine):
            mean[mine] = examples[:, mine] = pose.reshape(-1, 3)
    held = np.repeat([is_held(name) for name in skeleton.names], 3)
    covariance[held], covariance[:, held] = 0, 0
    # radians by which fingers and face are expected to leave their mean
    covariance[held, held] = 0.05**2
    return mean, covariance, examples


def read_published(path: str | Path) -> Published:
    """The arrays of a file of the SMPL family's layout, checked; as for `import_model`."""
    convert = ("convert it once where the library it came with is installed: python -c \"import pickle, numpy as np; "
               f"m = pickle.load(open('{path}', 'rb'), encoding='latin1'); np.savez('{Path(path).stem}.npz', **{{k: "
               f"np.array(m[k].todense() if hasattr(m[k], 'todense') else m[k]) for k in {WANTED}}})\"")
    check_regular(path, what="a body model as .npz")
    with taking_apart(path, "a body model as .npz"):
        with open(path, "rb") as file:
            start = file.read(4)
        if start[:2] != b"PK" or not zipfile.is_zipfile(path):
            if start[:1] == b"\x80" or Path(path).suffix == ".pkl":
                raise StorageError(f"{path}: a pickle can run any program, so it is not opened; {convert}")
            raise StorageError(f"{path}: expected a body model as .npz, found another kind of file")
        wanted = [name for name in names_in(path) if name in WANTED or name in ("part_names", "header")
                  or name.startswith(("J_regressor_", "hands_mean"))]
        try:
            arrays = load_arrays(path, "a body model as .npz", wanted)
        except StorageError as problem:
            if isinstance(problem.__cause__, ObjectsError):
                raise StorageError(f"{problem}; {convert}") from None
            raise
        if "header" in arrays:
            raise ValueError("it is a model of ours already: nothing to import")
        return _check_arrays(arrays)


def _check_arrays(a: dict[str, np.ndarray]) -> Published:
    """What the arrays are, or ValueError or KeyError."""
    for name in NEEDED:
        if name not in a:
            raise KeyError(name)
    notes = [f"{name} is float16: read as it is, good to {1000 * 2**-11 * np.abs(a[name]).max():.1g} mm"
             for name in sorted(a) if a[name].dtype == np.float16]
    a = {name: value.astype(np.float32) if value.dtype == np.float16 else value for name, value in a.items()}
    vertices = _numbers(a, "v_template", None, 3).astype(np.float64)
    N, parents = len(vertices), _parents(a["kintree_table"])
    J = len(parents)
    faces = a["f"]
    if faces.ndim != 2 or faces.shape[1:] != (3,) or (faces != np.round(faces)).any() or faces.min() < 0 \
            or faces.max() >= N:
        raise ValueError(f"f: expected (F, 3) vertices of 0..{N - 1}, found {faces.dtype} {faces.shape}")
    weights = _numbers(a, "weights", N, J).astype(np.float64)
    off = float(np.abs(weights.sum(axis=1) - 1).max())
    if off > 1e-4 or weights.min() < -1e-6:
        raise ValueError(f"weights: expected rows of at least 0 that sum to 1, found sums up to {off:.2g} off and "
                         f"{weights.min():.2g}")
    weights = np.maximum(weights, 0)
    shapes = _numbers(a, "shapedirs", N, 3, None)
    if shapes.shape[2] > 300:            # SMPL-X: the first are of shape, the others of expression
        notes.append("betas from number 301 on are taken for expressions")
    bends, kinds = np.zeros((N, 3, 0), np.float32), {9 * (J - 1), 4 * (J - 1) + 1}
    if "posedirs" in a:
        bends = _numbers(a, "posedirs", N, 3, None)
        if bends.shape[2] not in kinds:
            raise ValueError(f"posedirs: expected {9 * (J - 1)} columns (rotations) or {4 * (J - 1) + 1} (quaternions) "
                             f"for {J} joints, found {bends.shape[2]}")
    hands = {side: a[name].ravel().astype(np.float64) for side, name in (("left", "hands_meanl"),
                                                                         ("right", "hands_meanr")) if name in a}
    # (J, N) the regressor, dense or in the parts of a sparse matrix: data with row and col, or indices and indptr
    part = {name: a[f"J_regressor_{name}"] for name in ("data", "row", "col", "indices", "indptr")
            if f"J_regressor_{name}" in a}
    if "J_regressor" in a:
        regressor = csr_array(_numbers(a, "J_regressor", J, N).astype(np.float64))
    elif {"data", "row", "col"} <= set(part):
        regressor = csr_array(coo_array((part["data"], (part["row"], part["col"])), shape=(J, N)))
    elif {"data", "indices", "indptr"} <= set(part):
        kind = csc_array if len(part["indptr"]) == N + 1 else csr_array
        regressor = csr_array(kind((part["data"], part["indices"], part["indptr"]), shape=(J, N)))
    else:
        raise KeyError("J_regressor")
    if not np.allclose(regressor.sum(axis=1), 1, rtol=0, atol=1e-3):
        raise ValueError("J_regressor: expected rows that sum to 1")
    names = tuple(map(str, a["part_names"])) if len(a.get("part_names", ())) == J else ()
    return Published(Mesh(vertices, faces.astype(np.int64)), shapes, bends, csr_array(regressor.astype(np.float64)),
                     weights / weights.sum(axis=1, keepdims=True), parents, names, hands, tuple(notes))


def _numbers(a: dict[str, np.ndarray], name: str, *shape: int | None) -> np.ndarray:
    """An array of finite numbers of this shape, or ValueError."""
    value = a[name]
    wanted = ", ".join("any" if n is None else str(n) for n in shape)
    if value.dtype.kind not in "fiu" or value.ndim != len(shape) or any(
            n is not None and n != found for n, found in zip(shape, value.shape, strict=True)):
        raise ValueError(f"{name}: expected numbers of shape ({wanted}), found {value.dtype} {value.shape}")
    if not np.isfinite(value).all():
        raise ValueError(f"{name}: expected finite numbers")
    return value


def _parents(table: np.ndarray) -> np.ndarray:
    """The parents (J,) of a kintree_table (2, J), the root's -1."""
    if table.ndim != 2 or len(table) != 2 or table.dtype.kind not in "iuf" or not table.shape[1]:
        raise ValueError(f"kintree_table: expected whole numbers of shape (2, J), found {table.dtype} {table.shape}")
    parents, own = table.astype(np.int64)
    J = len(own)
    if not np.array_equal(own, np.arange(J)):
        raise ValueError(f"kintree_table: expected joints 0..{J - 1} in order in its second row, found {own.tolist()}")
    if parents[0] not in (-1, 2**32 - 1, 0):
        raise ValueError(f"kintree_table: expected the root first, its parent -1 or 2**32 - 1, found {parents[0]}")
    parents[0] = -1
    wrong = np.flatnonzero((parents[1:] < 0) | (parents[1:] >= np.arange(1, J))) + 1
    if len(wrong):
        raise ValueError(f"kintree_table: joint {wrong[0]} has parent {parents[wrong[0]]}, expected a joint listed "
                         "before it")
    return parents
