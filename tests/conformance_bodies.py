"""The worm as a model of every kind, with the same skeleton and rest pose: what the conformance suite runs on."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from completion_bodies import MEAN, SD
from model_bodies import worm, worm_model, worm_skeleton
from toy_kind import ToyModel

from model.blend_weights import diffuse_weights
from model.body import BodyModel
from model.features import Lift, PoseFeatures, QuadraticLift, QuaternionLift
from model.learning.skinning import corrective_features
from model.pose_space import PoseSpace
from model.scape import BlendScapeModel, ScapeModel
from model.skinning import SkinningModel
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

LEARNED = {"pose_mean": MEAN, "pose_covariance": np.diag(np.r_[np.zeros(3), np.full(9, SD**2)]),
           "info": {"ridge": 0.1, "landmarks": {"nose": 3}}}


def outward(mesh: Mesh) -> Mesh:
    """The mesh with its outside out, as scans have it."""
    return mesh if mesh.volume > 0 else Mesh(mesh.vertices, mesh.faces[:, [0, 2, 1]])


def scape_worm(lift: Lift | None = None, bulge: float = 0.05) -> ScapeModel:
    """A SCAPE worm whose Q is a random function of every lifted number of the joints of its part, I at rest."""
    plain = worm_model(bulge=bulge)
    plain = replace(plain, template=outward(plain.template))
    if lift is None:
        return replace(plain, **LEARNED)
    rng, skeleton = np.random.default_rng(1), plain.skeleton
    part, columns = [], []
    for p, joints in enumerate(skeleton.joints_of_part):
        for j, number in [(0, None)] + [(j, i) for j in joints for i in range(lift.width)]:
            part.append(p)
            columns.append(np.zeros((len(skeleton.parents), lift.width)))
            if number is not None:
                columns[-1][j, number] = 1
    features = PoseFeatures(skeleton, lift, np.array(part), np.stack(columns, axis=-1))
    centre, rest = plain.template.corners.mean(axis=1), features.evaluate(np.zeros((4, 3)))
    coefficients = []
    for p in range(4):
        mine, faces = features.of_part(p), np.flatnonzero(skeleton.part_of_face == p)
        joint = features.uses[mine].argmax(axis=1)
        far = np.linalg.norm(centre[faces] - skeleton.joints[joint][:, None], axis=2)
        a = np.exp(-far**2 / 0.04)[..., None, None] * rng.normal(0, bulge, (len(joint), 1, 3, 3))
        a[0] = np.eye(3) - np.tensordot(rest[mine][1:], a[1:], axes=1)
        coefficients.append(a)
    return replace(plain, pose_space=PoseSpace(features, tuple(coefficients)), **LEARNED)


def blendscape_worm() -> BlendScapeModel:
    """The SCAPE worm with rotations blended over 10 cm around the borders."""
    m = scape_worm()
    smooth = diffuse_weights(m.template, m.skeleton, 0.1)[m.template.faces].mean(axis=1)
    blend = 0.1 * np.eye(4)[m.skeleton.part_of_face] + 0.9 * smooth
    return BlendScapeModel(m.template, m.skeleton, m.pose_space, m.shape_space, m.pose_mean, m.pose_covariance,
                           m.info, blend=blend)


def skinned_worm(correctives: bool) -> SkinningModel:
    """A skinned worm with random smooth correctives around the joints, and people who are waves on its skin."""
    template, rng = outward(worm()), np.random.default_rng(2)
    skeleton = worm_skeleton(template)
    poses = rng.normal(0, 0.5, (20, 4, 3))
    features = corrective_features(skeleton, poses, correctives)
    x = template.vertices
    joint = features.uses[features.constant == 0].argmax(axis=1)
    far = np.linalg.norm(x - skeleton.joints[joint][:, None], axis=2)
    bumps = (np.exp(-far**2 / 0.04) * (far < 0.3))[..., None] * rng.normal(0, 0.02, (len(joint), 1, 3))
    waves = np.cos(x[:, :1] * [1, 2, 3]).T[..., None] * rng.normal(0, 0.02, (3, 1, 3))
    people = waves + 0.03 * (x - skeleton.joints[0]) * rng.normal(0, 1, (3, 1, 3))
    variances = (people**2).sum(axis=(1, 2))
    return SkinningModel(template, skeleton, x, diffuse_weights(template, skeleton, 0.08), features,
                         bumps.astype(np.float32), x * [1.02, 0.97, 1.03], people, variances,
                         float(variances.sum()), **LEARNED)


def toy_worm() -> ToyModel:
    """The worm as the kind that only the tests know."""
    skin = skinned_worm(False)
    return ToyModel(skin.template, skin.skeleton, skin.weights, **LEARNED)


def stiff_bodies() -> dict[str, BodyModel]:
    """Models of one part, without anything that deforms it."""
    plain = scape_worm()
    x = plain.template.vertices
    one = Skeleton(np.zeros(len(plain.template.faces), dtype=int), [-1], [x.mean(axis=0)])
    still, none = PoseSpace.identity(one), np.zeros((0, *x.shape))
    skin = SkinningModel(plain.template, one, x, np.ones((len(x), 1)), still.features, none, x, none, np.zeros(0), 0.0,
                         np.zeros((1, 3)), np.zeros((3, 3)))
    return {"scape": ScapeModel(plain.template, one, still, plain.shape_space, np.zeros((1, 3)), np.zeros((3, 3))),
            "skinning": skin}


# a new kind of model is one more line here
KINDS: dict[str, Callable[[], BodyModel]] = {
    "scape-linear": scape_worm,
    "scape-quadratic": lambda: scape_worm(QuadraticLift()),
    "scape-quaternion": lambda: scape_worm(QuaternionLift()),
    "blendscape": blendscape_worm,
    "skinning-plain": lambda: skinned_worm(False),
    "skinning-linear": lambda: skinned_worm(True),
    "toy": toy_worm,
}
