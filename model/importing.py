"""Import of published body models: the arrays of the SMPL family become a skinning model.

    T(β, θ) = v_template + shapedirs β + posedirs f(θ),    joints J_regressor (v_template + shapedirs β)

and linear blend skinning of T about the joints, + trans (Loper et al. 2015). f is `R - I` of all joints but the root's,
row by row, or quaternions and then the second beta (Osman et al. 2020). Users must keep to the licences of such files.
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
from scanprep.geometry.upright import find_up
from scanprep.skeleton.names import name_parts
from scanprep.skeleton.symmetry import find_symmetry
from scanprep.skeleton.tree import Skeleton

from .features import Lift, QuaternionLift, RotationLift, part_features
from .human_poses import human_poses, is_held, with_human_poses
from .motion.amass import PARENTS
from .skinning import SkinningModel

# arrays without which nothing can be imported, and those that are read if they are there
NEEDED = ("v_template", "shapedirs", "weights", "kintree_table", "f")
WANTED = (*NEEDED, "posedirs", "J_regressor")

# parts in the order of the published files: 22 of the body, then 15 finger bones a hand
BODY = ("pelvis", "thigh_left", "thigh_right", "abdomen", "shin_left", "shin_right", "abdomen2", "foot_left",
        "foot_right", "chest", "toes_left", "toes_right", "neck", "shoulder_left", "shoulder_right", "head",
        "upper_arm_left", "upper_arm_right", "forearm_left", "forearm_right", "hand_left", "hand_right")
FINGERS = {side: tuple(f"{finger}{i}_{side}" for finger in ("index", "middle", "pinky", "ring", "thumb")
                       for i in (1, 2, 3)) for side in ("left", "right")}
# the number of joints tells the members of the family apart
NAMES = {24: (*BODY, "fingers_left", "fingers_right"), 52: (*BODY, *FINGERS["left"], *FINGERS["right"]),
         55: (*BODY, "jaw", "eye_left", "eye_right", *FINGERS["left"], *FINGERS["right"])}


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
    """Import a linear body model in the layout of the SMPL family.

    `vertices` of the imported model follow the published formula exactly.

    Parameters
    ----------
    path : str or Path
        `.npz` with v_template (N, 3), shapedirs (N, 3, K), J_regressor (J, N), weights (N, J), kintree_table (2, J) and
        f (F, 3), in metres. posedirs is optional: (N, 3, 9 (J - 1)) or (N, 3, 4 (J - 1) + 1).

    Returns
    -------
    SkinningModel
        With the file's joints, betas and pose correctives; `save` writes it as one of our model files.

    Raises
    ------
    StorageError
        A pickle, missing arrays, arrays that do not fit, or a joint before its parent. The message names the array
        and what was expected.

    Examples
    --------
    >>> import tempfile
    >>> from model import load_built_in_model, write_body_npz
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     arrays = write_body_npz(f"{folder}/body.npz", load_built_in_model(), draws=0)
    ...     import_model(f"{folder}/body.npz").n_betas
    30

    Loper et al., SMPL, 2015.
    """
    published = read_published(path)
    model = as_skinning(published, {"imported": Path(path).name, "notes": "; ".join(published.notes)})
    families = {24: "smpl", 52: "smplh", 55: "smplx"}
    family = "star" if model.features.lift.kind == QuaternionLift.kind else families.get(len(published.parents), "")
    if model.skeleton.names == NAMES.get(len(published.parents)):
        model.info["family"] = family        # motions of this family apply to the model without retargeting
    return model


def as_skinning(published: Published, info: dict[str, Any]) -> SkinningModel:
    """Build the skinning model of published arrays."""
    mesh, K, C = find_up(published.mesh), published.shapes.shape[2], published.bends.shape[2]
    skeleton = _skeleton(published)
    J, shapes, bends = len(published.parents), np.moveaxis(published.shapes, -1, 0), np.moveaxis(published.bends, -1, 0)
    joint_components = np.stack([published.regressor @ each for each in shapes]) if K else np.zeros((0, J, 3))
    lift: Lift = RotationLift()
    # STAR: correctives by quaternions; the last column belongs to the second beta, so it joins the shapes
    if C == 4 * (J - 1) + 1:
        lift, shapes, bends = QuaternionLift(), shapes.copy(), bends[:-1]
        if K > 1:
            shapes[1] += published.bends[..., -1]
    # every part has the lifted numbers of its own joint as features; the root has none
    axes = [np.zeros((lift.width, 0)), *[np.eye(lift.width) if C else np.zeros((lift.width, 0))] * (J - 1)]
    features = part_features(skeleton, lift, axes, [[j] for j in range(J)])
    variances = (shapes.astype(np.float64)**2).sum(axis=(1, 2))
    mean, covariance, examples = _poses(mesh, skeleton, published.hands)
    return SkinningModel(
        mesh, skeleton, mesh.vertices, published.weights, features, np.ascontiguousarray(bends), mesh.vertices,
        np.ascontiguousarray(shapes), variances, float(variances.sum()), mean, covariance, info,
        pose_examples=examples, regressor=published.regressor, joint_components=joint_components)


def _skeleton(published: Published) -> Skeleton:
    """Build the skeleton: each triangle belongs to the part with its largest weight.

    A part that is the largest nowhere gets one triangle: that with most of its weight, else the nearest to its joint.
    """
    mesh, J = published.mesh, len(published.parents)
    joints, on_face = published.regressor @ mesh.vertices, published.weights[mesh.faces].sum(axis=1)
    part, centre = on_face.argmax(axis=1), mesh.corners.mean(axis=1)
    for j in np.setdiff1d(np.arange(J), part):
        shared = np.bincount(part, minlength=J)[part] > 1
        best = on_face[:, j] if on_face[:, j].any() else -np.linalg.norm(centre - joints[j], axis=1)
        part[np.where(shared, best, -np.inf).argmax()] = j
    # names: those of the file, those of the family if the tree is the known one, else guessed from the shape
    plain = Skeleton(part, published.parents, joints, published.names)
    known = NAMES.get(J, ())
    if not published.names and np.array_equal(published.parents[:22], PARENTS) and known:
        return Skeleton(part, published.parents, joints, known)
    return plain if published.names else Skeleton(part, published.parents, joints,
                                                  name_parts(mesh, plain, find_symmetry(mesh)))


def _poses(mesh: Mesh, skeleton: Skeleton, hands: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute a pose prior from the poses of people: mean (J, 3), covariance (3J, 3J) and examples, radians.

    Published files hold no training poses. Fingers and face stay at rest.
    """
    J = len(skeleton.parents)
    # 60 examples stand for training poses
    examples = human_poses(mesh, skeleton, 60, np.random.default_rng(0))
    if examples is None:      # no person: every joint turns by half a radian, standard deviation
        examples, covariance = np.zeros((0, J, 3)), 0.5**2 * np.eye(3 * J)
        covariance[:3, :3] = 0
        return np.zeros((J, 3)), covariance, examples
    mean, covariance = with_human_poses(mesh, skeleton, 0, np.zeros((J, 3)), np.zeros((3 * J, 3 * J)))
    # hands that are half closed at rest, where the file has their mean pose
    for side, pose in hands.items():
        fingers = [skeleton.names.index(name) for name in FINGERS[side] if name in skeleton.names]
        if len(pose) == 3 * len(fingers):
            mean[fingers] = examples[:, fingers] = pose.reshape(-1, 3)
    held = np.repeat([is_held(name) for name in skeleton.names], 3)
    covariance[held], covariance[:, held] = 0, 0
    # fingers and face leave their mean by 0.05 rad, standard deviation: nothing is known of them
    covariance[held, held] = 0.05**2
    return mean, covariance, examples


def read_published(path: str | Path) -> Published:
    """Read and check the arrays of a file in the layout of the SMPL family; as for `import_model`."""
    convert = ("convert it once where the library it came with is installed: python -c \"import pickle, numpy as np; "
               f"m = pickle.load(open('{path}', 'rb'), encoding='latin1'); np.savez('{Path(path).stem}.npz', **{{k: "
               f"np.array(m[k].todense() if hasattr(m[k], 'todense') else m[k]) for k in {WANTED}}})\"")
    check_regular(path, what="a body model as .npz")
    with taking_apart(path, "a body model as .npz"):
        # a pickle is recognised by its first bytes and refused, with the command that converts it
        with open(path, "rb") as file:
            start = file.read(4)
        if start[:2] != b"PK" or not zipfile.is_zipfile(path):
            if start[:1] == b"\x80" or Path(path).suffix == ".pkl":
                raise StorageError(f"{path}: a pickle can run any program, so it is not opened; {convert}")
            raise StorageError(f"{path}: expected a body model as .npz, found another kind of file")
        # only arrays that matter are read, so that objects elsewhere in the file do no harm
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
    """Check the arrays and convert them; KeyError for a missing array, ValueError for one that does not fit."""
    for name in NEEDED:
        if name not in a:
            raise KeyError(name)
    notes = [f"{name} is float16: read as it is, good to {1000 * 2**-11 * np.abs(a[name]).max():.1g} mm"
             for name in sorted(a) if a[name].dtype == np.float16]
    a = {name: value.astype(np.float32) if value.dtype == np.float16 else value for name, value in a.items()}
    # mesh and kinematic tree, whose sizes N and J all other arrays must have
    vertices = _numbers(a, "v_template", None, 3).astype(np.float64)
    N, parents = len(vertices), _parents(a["kintree_table"])
    J = len(parents)
    faces = a["f"]
    if faces.ndim != 2 or faces.shape[1:] != (3,) or (faces != np.round(faces)).any() or faces.min() < 0 \
            or faces.max() >= N:
        raise ValueError(f"f: expected (F, 3) vertices of 0..{N - 1}, found {faces.dtype} {faces.shape}")
    weights = _numbers(a, "weights", N, J).astype(np.float64)
    # blend weights; 1e-4 and 1e-6 leave room for files in single precision
    off = float(np.abs(weights.sum(axis=1) - 1).max())
    if off > 1e-4 or weights.min() < -1e-6:
        raise ValueError(f"weights: expected rows of at least 0 that sum to 1, found sums up to {off:.2g} off and "
                         f"{weights.min():.2g}")
    weights = np.maximum(weights, 0)
    shapes = _numbers(a, "shapedirs", N, 3, None)
    if shapes.shape[2] > 300:            # SMPL-X has 300 shape coefficients; further ones are expressions
        notes.append("betas from number 301 on are taken for expressions")
    bends, kinds = np.zeros((N, 3, 0), np.float32), {9 * (J - 1), 4 * (J - 1) + 1}
    if "posedirs" in a:
        bends = _numbers(a, "posedirs", N, 3, None)
        if bends.shape[2] not in kinds:
            raise ValueError(f"posedirs: expected {9 * (J - 1)} columns (rotations) or {4 * (J - 1) + 1} (quaternions) "
                             f"for {J} joints, found {bends.shape[2]}")
    hands = {side: a[name].ravel().astype(np.float64) for side, name in (("left", "hands_meanl"),
                                                                         ("right", "hands_meanr")) if name in a}
    # the regressor (J, N), dense or as a sparse matrix: data with row and col, or with indices and indptr
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
    """Return an array of finite numbers with this shape (None is any length), or raise ValueError."""
    value = a[name]
    wanted = ", ".join("any" if n is None else str(n) for n in shape)
    if value.dtype.kind not in "fiu" or value.ndim != len(shape) or any(
            n is not None and n != found for n, found in zip(shape, value.shape, strict=True)):
        raise ValueError(f"{name}: expected numbers of shape ({wanted}), found {value.dtype} {value.shape}")
    if not np.isfinite(value).all():
        raise ValueError(f"{name}: expected finite numbers")
    return value


def _parents(table: np.ndarray) -> np.ndarray:
    """Read the parents (J,) from a kintree_table (2, J); the root's is -1."""
    if table.ndim != 2 or len(table) != 2 or table.dtype.kind not in "iuf" or not table.shape[1]:
        raise ValueError(f"kintree_table: expected whole numbers of shape (2, J), found {table.dtype} {table.shape}")
    parents, own = table.astype(np.int64)
    J = len(own)
    if not np.array_equal(own, np.arange(J)):
        raise ValueError(f"kintree_table: expected joints 0..{J - 1} in order in its second row, found {own.tolist()}")
    # files write the root's parent as -1, as -1 in unsigned 32 bits, or as 0
    if parents[0] not in (-1, 2**32 - 1, 0):
        raise ValueError(f"kintree_table: expected the root first, its parent -1 or 2**32 - 1, found {parents[0]}")
    parents[0] = -1
    wrong = np.flatnonzero((parents[1:] < 0) | (parents[1:] >= np.arange(1, J))) + 1
    if len(wrong):
        raise ValueError(f"kintree_table: joint {wrong[0]} has parent {parents[wrong[0]]}, expected a joint listed "
                         "before it")
    return parents
