"""Makes the built-in model: how the built-in people move, learned from the posed bodies of the generator.

    python tests/people/make_model.py -o model/built_in.npz [--poses 100] [--faces 10000]

The mean person is posed by `scanprep.synthetic.posing` (dual quaternions, swelling muscles, skin that slides over
bones), which is not what is learned here (SCAPE: gradients of triangles, linear in the twists of joints). No scan is
used. The shape space is not stored: it is that of the population, see `model.built_in`.
"""
from __future__ import annotations

import argparse
import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from model.built_in import KIND, STORED, VERSION, pack_coefficients, shape_space
from model.learning.config import LearnConfig
from model.learning.scape import learn_scape, pose_prior
from model.scape import ScapeModel
from scanprep.decimation.registered_set import DecimatedSet, decimate_set
from scanprep.geometry import storage
from scanprep.synthetic.data_set import near_rest, subject_pose
from scanprep.synthetic.landmarks import landmarks, markers
from scanprep.synthetic.people import BodyShape, Person
from scanprep.synthetic.population import STORED as PEOPLE
from scanprep.synthetic.population import population

STANDING = 0.4                       # poses near rest, as a share of the others: bodies at rest are 0.3 mm off, 0.5 without
LEARN = LearnConfig(refinements=3)


def learn_people_model(poses: int, faces: int, config: LearnConfig = LEARN, n_betas: int | None = None,
                       seed: int = 5) -> ScapeModel:
    """The model of the built-in people: poses of the mean person, and the population's shape space."""
    rng, person = np.random.default_rng(seed), Person(BodyShape("male", (0.0,) * len(population().directions)))
    at = [subject_pose(k, rng)[1] for k in range(poses)] + [near_rest(rng) for _ in range(round(STANDING * poses))]
    posed = np.stack([person.posed(pose) for pose in at])
    small = decimate_person(person, posed, faces)
    assert small.skeleton is not None, "a skeleton was given"
    model = learn_scape(small.template, small.transfer(posed), None, small.skeleton, config)
    mean, covariance = pose_prior(small.template, small.skeleton, model.pose_examples, poses)
    info = {key: value for key, value in model.info.items() if key not in ("digest", "digests")}
    return replace(
        model, shape_space=shape_space(population(), small.vertex_map, model.template,
                                       model.pose_space).first(n_betas),
        pose_mean=mean, pose_covariance=covariance,
        info={**info, "landmarks": small.landmarks(landmarks()), "markers": small.landmarks(markers()),
              "people_vertices": small.vertex_map.tolist()})


def decimate_person(person: Person, posed: np.ndarray | None, faces: int) -> DecimatedSet:
    """The person with fewer triangles; landmarks and markers stay where they are."""
    kept = np.unique([*landmarks().values(), *markers().values()])
    return decimate_set(person.mesh, posed, faces, keep=kept, skeleton=person.skeleton)


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
    parser.add_argument("-o", "--output", type=Path, default=STORED)
    parser.add_argument("--poses", type=int, default=100)
    parser.add_argument("--faces", type=int, default=10000)
    args = parser.parse_args()
    arrays, header = stored_arrays(learn_people_model(args.poses, args.faces))
    header["info"] |= {"recipe": recipe_digest(), "people": population().source}
    storage.save(args.output, KIND, VERSION, arrays, header)


if __name__ == "__main__":
    main()
