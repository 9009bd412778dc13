"""The built-in body model of people, for users without scans of their own.

The shape space is exactly that of `scanprep.synthetic.population`: vertices at rest are linear in the betas. The
deformation by pose was learned from posed synthetic bodies by `tests/people/make_model.py`.
"""
from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_array, lil_array

from scanprep.geometry import storage
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.population import PARENTS, PARTS, Population, population

from .features import LIFTS, PoseFeatures
from .gradients import edges
from .importing import FINGERS, Published, as_skinning
from .pose_space import PoseSpace, faces_of_part
from .scape import ScapeModel
from .shape_space import ShapeSpace
from .skinning import SkinningModel

STORED = Path(__file__).with_name("built_in.npz")
KIND, VERSION = "built-in model", 1
NAME = "built-in people"


@lru_cache(maxsize=1)
def load_built_in_model() -> ScapeModel:
    """Read the model of the built-in people: MakeHuman's shapes (CC0) with the statistics of ANSUR II.

    Its first beta is stature, the second weight, the third leads from women to men; betas have mean 0 and standard
    deviation 1 over women and men together, and `info["sexes"]` holds mean and covariance of each sex. People of
    ANSUR II were soldiers of 17 to 58 years, who are leaner and younger than everybody.

    Returns
    -------
    ScapeModel
        About 5,000 vertices, 16 parts, 30 betas. `info` names landmarks and markers, and "people_vertices", those
        vertices of `Person` that it kept.

    Examples
    --------
    >>> model = load_built_in_model()
    >>> taller = model.vertices(np.zeros((16, 3)), np.array([1.0]))
    >>> bool(np.ptp(taller[:, 2]) > np.ptp(model.template.vertices[:, 2]))
    True

    [SCAPE] Eq. 6
    """
    header, a = storage.load(STORED, KIND, (VERSION,))
    # the template: vertices of the mean person that the coarser mesh keeps
    people, kept = population(), a["people_vertices"].astype(np.int64)
    rows = people.rows(np.zeros(0))
    template = Mesh(rows[kept], a["faces"].astype(np.int64))
    part = a["part_of_face"].astype(np.int64)
    # joints of the population; the root's is the centroid of its part's vertices
    skeleton = Skeleton(part, PARENTS, rows[len(people.weights):len(people.weights) + 16], PARTS)
    joints = skeleton.joints.copy()
    joints[0] = template.vertices[skeleton.part_of_vertex(template) == 0].mean(axis=0)
    skeleton = Skeleton(part, PARENTS, joints, PARTS)
    # learned deformation by pose, stored in 16 bits
    features = PoseFeatures(skeleton, LIFTS[header["lift"]], a["feature_part"].astype(np.int64), a["feature_mix"])
    space = PoseSpace(features, unpack_coefficients(features, a["pose_coefficients"], a["pose_scales"]))
    info = {"name": NAME, **header["info"], "people_vertices": kept.tolist(), "sexes": _sexes(people)}
    return ScapeModel(template, skeleton, space, shape_space(people, kept, template, space), a["pose_mean"],
                      a["pose_covariance"], info, pose_examples=a["pose_examples"].astype(np.float64))


def load_fingered_model() -> SkinningModel:
    """Read the built-in people with finger bones: for animators and for hands.

    They are the people of `load_built_in_model` with all 12,500 vertices, in linear blend skinning without correctives.
    So elbows and knees lose volume as they bend.

    Returns
    -------
    SkinningModel
        46 parts, 30 betas.

    Examples
    --------
    >>> [name for name in load_fingered_model().skeleton.names if name.startswith("thumb")]
    ['thumb1_left', 'thumb2_left', 'thumb3_left', 'thumb1_right', 'thumb2_right', 'thumb3_right']
    """
    header, a = storage.load(STORED, KIND, (VERSION,))
    people, n = population(), len(population().weights)
    parents, weights = list(PARENTS), np.hstack([people.weights, np.zeros((n, 30))])
    # 16 parts of the body, then 15 finger bones of each hand
    regressor = lil_array((46, n))
    for j in range(16):
        regressor[[j], a["joint_vertices"][j]] = a["joint_weights"][j]
    left, share = a["hand_vertices"].astype(np.int64), a["finger_weights"] / 255.0
    # the weight of a hand is divided among hand and finger bones; the right hand is the mirrored left
    for side, vertices, first in (("left", left, 16), ("right", people.mirror[left], 31)):
        hand, columns = PARTS.index(f"hand_{side}"), np.arange(first, first + 15)
        weights[vertices[:, None], columns] = weights[vertices, hand, None] * share[:, 1:]
        weights[vertices, hand] *= share[:, 0]
        parents += [hand if k % 3 == 0 else first + k - 1 for k in range(15)]
        # a finger joint is the mean of the skin that follows both of its parts
        for finger in columns:
            both = weights[:, finger] * weights[:, parents[finger]]
            near = np.flatnonzero(both)
            regressor[[finger], near] = both[near] / both.sum()
    weights /= weights.sum(axis=1, keepdims=True)
    rest, names = people.rows(np.zeros(0))[:n], (*PARTS, *FINGERS["left"], *FINGERS["right"])
    return as_skinning(
        Published(Mesh(rest, people.faces), np.moveaxis(people.directions[:, :n], 0, -1), np.zeros((n, 3, 0)),
                  csr_array(regressor), weights, np.array(parents), names, {}, ()),
        {"name": f"{NAME} with fingers", **{key: header["info"][key] for key in ("source", "recipe")},
         "landmarks": people.landmarks, "markers": people.markers, "sexes": _sexes(people)})


def _sexes(people: Population) -> dict[str, Any]:
    """Return mean and covariance of the betas of each sex, as model files keep them."""
    return {sex: {"mean": mean.tolist(), "covariance": covariance.tolist()}
            for sex, (mean, covariance) in people.moments.items()}


def shape_space(people: Population, kept: np.ndarray, template: Mesh, space: PoseSpace) -> ShapeSpace:
    """Compute shape components whose bodies at rest are those of the population, for some of its vertices (n,).

    Two edges do not determine how a triangle changes along its normal. As in [Sumner], the normal grows with the square
    root of the area. On 16 people that were left out, in random poses, the error is 2.5 mm; with Eq. 8 it is 2.7 mm.

    [SCAPE] Eq. 7
    """
    directions = people.directions[:, kept]
    at_rest = edges(template.vertices, template.faces) @ np.swapaxes(
        space.gradients(np.zeros((len(PARENTS), 3))), -1, -2)                                # rows (Q v̂)ᵀ
    e, f = at_rest[:, 0], at_rest[:, 1]
    de, df = np.moveaxis(edges(directions, template.faces), 2, 0)
    # the scaled normal n = c / sqrt(|c|) of c = e × f, and its derivative
    c, dc = np.cross(e, f), np.cross(de, f) + np.cross(e, df)
    size = np.linalg.norm(c, axis=-1, keepdims=True)
    n, dsize = c / np.sqrt(size), (c * dc).sum(axis=-1, keepdims=True) / size
    dn = (dc - 0.5 * c * dsize / size) / np.sqrt(size)
    # S maps the two edges and the normal, so its derivative by a beta is their change times their inverse
    before = np.stack([e, f, n], axis=-2)
    components = np.swapaxes(np.linalg.inv(before) @ np.stack([de, df, dn], axis=-2), -1, -2)
    # betas have unit variance, so a component's variance is its squared norm; S = I is the mean person
    variances = (components**2).sum(axis=(1, 2, 3))
    mean = np.broadcast_to(np.eye(3, dtype=np.float32), components.shape[1:]).copy()
    return ShapeSpace(mean, components.astype(np.float32), variances, float(variances.sum()))


def pack_coefficients(space: PoseSpace) -> tuple[np.ndarray, np.ndarray]:
    """Pack the coefficients of a pose space into 16 bits, with one unit (A,) a feature: a third of the bytes."""
    scales = np.concatenate([np.abs(a).max(axis=(1, 2, 3)) for a in space.coefficients]) / (2**15 - 1)
    scales = np.maximum(scales, np.finfo(np.float32).tiny)
    numbers = [a / scales[space.features.of_part(p)][:, None, None, None] for p, a in enumerate(space.coefficients)]
    return np.concatenate([np.round(a).astype(np.int16).ravel() for a in numbers]), scales


def unpack_coefficients(features: PoseFeatures, packed: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, ...]:
    """Unpack the coefficients of `pack_coefficients`, part by part (n_p, F_p, 3, 3)."""
    out, start = [], 0
    for p, faces in enumerate(faces_of_part(features.skeleton)):
        unit = scales[features.of_part(p)]
        numbers = packed[start:start + 9 * len(unit) * len(faces)].reshape(len(unit), len(faces), 3, 3)
        out.append((numbers * unit[:, None, None, None]).astype(np.float32))
        start += numbers.size
    return tuple(out)
