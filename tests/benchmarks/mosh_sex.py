"""Sex from markers: synthetic women and men who were not learned from, walking with 41 markers.

    python tests/benchmarks/mosh_sex.py --models FOLDER -o mosh_sex.json

The models of both sexes are learned once and kept in FOLDER. Every subject walks; markers of the set cmu41 sit on their
skin a few millimetres from where the layout has them, other places on everybody. Beside the plane of `guess_sex` stands
the other way to tell, to fit the women's and the men's model and to take the one with the lower residual.
"""
from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from protocols import machine, write_report

from completion.mocap.files.markers import MarkerSequence
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.subject.person import find_person
from model.body import BodyModel
from model.files import load_model
from model.learning.config import LearnConfig
from model.learning.sexes import guess_sex, learn_by_sex, sex_plane
from scanprep.geometry.surface import Surface
from scanprep.synthetic.data_set import SUBJECT, near_rest, subject_pose
from scanprep.synthetic.people import BodyShape, SyntheticPerson, synthesise_walk

sys.path.insert(0, str(Path(__file__).parents[1] / "people"))
MM = 1000.0
RATE = 20.0
NAMES = ("neutral", "female", "male")


def learned(folder: Path) -> dict[str, BodyModel]:
    """The models of the synthetic people by sex, from the folder or learned now, of 40 poses and 120 people."""
    paths = {name: folder / f"{name}.npz" for name in NAMES}
    if not all(path.exists() for path in paths.values()):
        folder.mkdir(parents=True, exist_ok=True)
        from make_model import decimate_person

        rng = np.random.default_rng(5)
        man, sexes = SyntheticPerson(SUBJECT), [("female", "male")[k % 2] for k in range(120)]
        poses = np.stack([man.in_pose(subject_pose(k, rng)[1]) for k in range(40)])
        shapes = np.stack([SyntheticPerson(BodyShape.random(rng, sex=sex)).in_pose(near_rest(rng))
                           for sex in sexes])
        small = decimate_person(man, poses, 10000)
        found = learn_by_sex(small.template, small.transfer(poses), small.transfer(shapes), sexes, small.skeleton,
                             LearnConfig(components=30, refinements=2))
        for name, model in found.items():
            model.info["people_vertices"] = small.vertex_map.tolist()
            model.save(paths[name])
    return {name: load_model(path) for name, path in paths.items()}


def walking(person: SyntheticPerson, layout: MarkerLayout, rng: np.random.Generator, error: float, frames: int
            ) -> MarkerSequence:
    """A person who walks in a way of their own, with markers so far (root mean square, metres) beside their places."""
    normals = person.mesh.vertex_normals[layout.vertices]
    beside = rng.normal(0, error / np.sqrt(2), (len(layout.labels), 3))       # in the two directions of the skin
    beside -= (beside * normals).sum(axis=1, keepdims=True) * normals
    on = Surface(person.mesh).closest(person.mesh.vertices[layout.vertices] + beside)
    worn = MarkerLayout(layout.labels, person.mesh.faces[on.faces], layout.distances, on.bary)
    poses, trans = synthesise_walk(frames, RATE / rng.uniform(0.8, 1.2))
    poses = poses + 0.04 * rng.normal(size=poses.shape[1:])
    bodies = [person.mesh.with_vertices(person.in_pose(p, t)) for p, t in zip(poses, trans, strict=True)]
    return MarkerSequence(np.stack([worn.place(body) for body in bodies]), layout.labels, RATE)


def told(models: dict[str, BodyModel], sex: float, seed: int, args: argparse.Namespace) -> dict:
    """One subject: truth, guess, and residuals with the models of both sexes."""
    rng = np.random.default_rng([seed, 61])
    person = SyntheticPerson(BodyShape.random(rng, sex=sex))
    layout = load_layout("cmu41", person.mesh)
    sequence = walking(person, layout, rng, args.error, args.frames)
    kept = np.array(models["neutral"].info["people_vertices"])
    places = load_layout("cmu41", models["neutral"].template, kept)
    start = time.process_time()
    found = find_person(models["neutral"], sequence, places)
    seconds = time.process_time() - start
    guess = guess_sex(models["neutral"], found.betas)
    row = {"subject": seed, "sex": sex, "guess": guess.sex, "margin": guess.margin, "probability": guess.probability,
           "right": (guess.sex == "male") == (sex > 0), "neutral_mm": MM * found.residual, "cpu_s": seconds}
    if args.both:
        for name in ("female", "male"):
            row[f"{name}_mm"] = MM * find_person(models[name], sequence, places).residual
        row["residual_right"] = (row["male_mm"] < row["female_mm"]) == (sex > 0)
    return row


def main() -> None:
    """Run and print a row a subject."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="mosh_sex.json")
    parser.add_argument("--models", type=Path, required=True, help="folder for the models, learned when not there")
    parser.add_argument("--count", type=int, default=48, help="subjects of each strength of sex, women and men in turn")
    parser.add_argument("--strength", type=float, nargs="*", default=[1.0], help="1 all the sex there is, 0 none")
    parser.add_argument("--error", type=float, default=0.005, help="of marker places, metres")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--both", action="store_true", help="also tell by the residuals of the two models")
    args = parser.parse_args()
    models, rows = learned(args.models), []
    print(sex_plane(models["neutral"]))
    for strength in args.strength:
        for k in range(args.count):
            rows.append({"strength": strength, **told(models, (-strength, strength)[k % 2], 1000 + k, args)})
            print(rows[-1], flush=True)
        mine = [row for row in rows if row["strength"] == strength]
        print(strength, "right", np.mean([row["right"] for row in mine]), "women",
              np.mean([row["right"] for row in mine if row["sex"] < 0]), "by residual",
              np.mean([row.get("residual_right", np.nan) for row in mine]), flush=True)
    write_report(args.output, {"protocol": f"{args.count} subjects, cmu41, {1e3 * args.error:g} mm, walking",
                               "machine": machine(), "plane": sex_plane(models["neutral"]).to_arrays(),
                               "subjects": rows})


if __name__ == "__main__":
    main()
