"""Learning from a random mix of people and poses against the separated design, on synthetic people.

    python tests/benchmarks/mixed.py -o mixed.json

30 people in 3 poses each, against as many meshes of one person in many poses and of others in about one. Held out are
new people in new poses, met by `fit_shape`; and known people in new poses, whose betas come from other scans. The
meshes are true, in one topology, and so is the skeleton.
"""
from __future__ import annotations

import argparse
import dataclasses
import time

import numpy as np
from protocols import machine, write_report

from model import learn_scape
from model.body import BodyModel
from model.fitting.vertices import FitConfig, PoseFitter, ShapeFitter
from model.learning.mixing import MIX, learn_scape_mix
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.people import BodyShape, SyntheticPerson, random_pose

NEARLY_ONE_POSE = 0.15               # share of a random pose in which the people of the separated design stand
FIT = FitConfig(sample=400, polish=0)


class Stage:
    """Template, skeleton and bodies of synthetic people, on a coarser triangulation of some of their vertices."""

    def __init__(self, faces: int) -> None:
        import igl

        self.first = SyntheticPerson()
        mesh, parts, self.kept = self.first.mesh, self.first.part_of_face, np.arange(len(self.first.mesh.vertices))
        if faces < len(mesh.faces):
            _, triangles, whose, self.kept = (np.asarray(a) for a in igl.decimate(mesh.vertices, mesh.faces, faces)[:4])
            mesh, parts = Mesh(mesh.vertices[self.kept], triangles.astype(np.int64)), parts[whose]
        joints = self.first.joints.copy()
        joints[0] = mesh.vertices[Skeleton(parts, self.first.parents, joints).part_of_vertex(mesh) == 0].mean(axis=0)
        self.template, self.skeleton = mesh, Skeleton(parts, self.first.parents, joints, self.first.names)

    def bodies(self, person: SyntheticPerson, count: int, rng: np.random.Generator, spread: float = 1.0) -> np.ndarray:
        """One person in random poses (count, N, 3)."""
        return np.stack([person.in_pose(spread * random_pose(rng))[self.kept] for _ in range(count)])

    def people(self, count: int, each: int, rng: np.random.Generator, spread: float = 1.0) -> np.ndarray:
        """New people in poses of their own (count * each, N, 3)."""
        return np.concatenate([self.bodies(SyntheticPerson(BodyShape.random(rng)), each, rng,
                                           spread) for _ in range(count)])


def strangers(model: BodyModel, bodies: np.ndarray, count: int | None) -> dict[str, float]:
    """Mean and worst error in mm of new people in new poses."""
    fitter = ShapeFitter(model, dataclasses.replace(FIT, n_betas=None if count is None else min(count, model.n_betas)))
    errors = 1e3 * np.array([fitter.fit(body).mean for body in bodies])
    return {"mean_mm": float(errors.mean()), "worst_mm": float(errors.max())}


def acquaintances(model: BodyModel, scans: np.ndarray) -> float:
    """Mean error in mm of people (P, 3, N, 3) in their last pose, with betas fitted to the two before."""
    shaper, errors = ShapeFitter(model, FIT), []
    for scan in scans:
        betas = np.mean([shaper.fit(body).betas for body in scan[:-1]], axis=0)
        errors.append(1e3 * PoseFitter(model.subject(betas), FIT).fit(scan[-1]).mean)
    return float(np.mean(errors))


def run(stage: Stage, seed: int, held: int) -> dict[str, object]:
    """One seed: both designs, learned and measured."""
    rng = np.random.default_rng(seed)
    mixed, who = stage.people(30, 3, rng), np.repeat(np.arange(30), 3)
    poses, others = stage.bodies(stage.first, 60, rng), stage.people(45, 1, rng, NEARLY_ONE_POSE)
    new, known = stage.people(held, 1, rng), stage.people(held // 2, 3, rng)
    known = known.reshape(held // 2, 3, *known.shape[1:])
    result = dict[str, object](seed=seed)
    designs = {"mixed 30 x 3": lambda: learn_scape_mix(stage.template, mixed, who.tolist(), stage.skeleton)}
    for count in (45, 60):
        designs[f"separated {count} + {90 - count}"] = lambda count=count: learn_scape(
            stage.template, poses[:count], others[:90 - count], stage.skeleton)
    for name, learn in designs.items():
        begin = time.perf_counter()
        model = learn()
        seconds = time.perf_counter() - begin
        result[name] = {"learn_s": seconds, "n_betas": model.n_betas, "new_people": strangers(model, new, None),
                        "new_people_20_betas": strangers(model, new, 20),
                        "new_people_29_betas": strangers(model, new, 29),
                        "known_people_mm": acquaintances(model, known),
                        **{k: model.info[k] for k in ("rounds", "ridge", "pruning", "features")
                           if k in model.info}}
        print(seed, name, result[name], flush=True)
    return result


def main() -> None:
    """Run all seeds and print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="mixed.json")
    parser.add_argument("--faces", type=int, default=2000, help="triangles of the bodies; all of them at 18756")
    parser.add_argument("--held", type=int, default=20, help="new people in new poses")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    args = parser.parse_args()
    stage = Stage(args.faces)
    runs = [run(stage, seed, args.held) for seed in args.seeds]
    report: dict[str, object] = {
        "protocol": "synthetic people, 90 meshes, true skeleton", "faces": len(stage.template.faces), "held": args.held,
        "config": dataclasses.asdict(MIX), "machine": machine(), "runs": runs}
    for against in [name for name in runs[0] if name.startswith("separated")]:
        for what in ("new_people", "new_people_20_betas", "new_people_29_betas"):
            ratio = [r["mixed 30 x 3"][what]["mean_mm"] / r[against][what]["mean_mm"] for r in runs]
            report[f"{what}, mixed over {against}"] = ratio
            print(f"{what:20s} mixed over {against}: {np.mean(ratio):.3f}")
    write_report(args.output, report)


if __name__ == "__main__":
    main()
