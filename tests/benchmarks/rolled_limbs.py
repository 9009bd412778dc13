"""Limbs rolled about their own axis on true bodies: from which angle on a registration is doubted.

    SCAPEKIT_DATA=... python tests/benchmarks/rolled_limbs.py [--set tuning|held] [-o FILE]
    SCAPEKIT_DATA=... python tests/benchmarks/rolled_limbs.py --repair 3,8 [--degrees 180]

Registrations that roll a limb are rare, so they are made: every limb of every pose is rolled about its bone, the roll
beginning within 5 cm of its joint, and laid on the true surface again. Counted is a doubt that the pose itself did not
raise. What we lose at: half a right angle, which elbows and hands of real people do. With `--repair` the virtual scans
of some poses are given to `repair_limbs` with every such limb, and its error before and after is told.
"""
from __future__ import annotations

import argparse
import re
from dataclasses import replace

import numpy as np
from protocols import RealData, load_real, machine, write_report
from scans import HELD_POSES, TUNING_POSES, test_scan

from scanprep.geometry import rotations
from scanprep.geometry.surface import Surface
from scanprep.registration.graph_fit import start_fit
from scanprep.registration.limbs import limb_doubts
from scanprep.registration.matches import prepare_problem
from scanprep.registration.nonrigid import measure_fit
from scanprep.registration.person import PersonParts, person_parts
from scanprep.registration.repair import repair_limbs

LIMBS = ("forearm_left", "forearm_right", "hand_left", "hand_right", "shin_left", "shin_right", "head")
ANGLES = (45, 90, 135, 180)
BEGINS = -0.02, 0.03                    # metres along the bone between which a roll sets in


def rolled(data: RealData, parts: PersonParts, body: np.ndarray, limb: int, angle: float) -> np.ndarray:
    """Vertices (N, 3) of a body with the skin of a limb, and what hangs on it, rolled by an angle, radians."""
    skeleton, rest = parts.skeleton, data.template.vertices
    part = skeleton.part_of_vertex(data.template)
    joints = skeleton.joint_regressor(data.template) @ body
    below = np.flatnonzero(skeleton.parents == limb)
    ends = [(j[below[0]] if len(below) else x[part == limb].mean(axis=0)) - j[limb]
            for j, x in ((skeleton.joints, rest), (joints, body))]
    bone_rest, bone = (end / np.linalg.norm(end) for end in ends)
    along = (rest - skeleton.joints[limb]) @ bone_rest
    share = np.clip((along - BEGINS[0]) / (BEGINS[1] - BEGINS[0]), 0, 1) * skeleton.descends[part, limb]
    moved, out = share > 0, body.copy()
    R = rotations.exp((angle * share[moved])[:, None] * bone)
    turned = joints[limb] + np.einsum("nij,nj->ni", R, body[moved] - joints[limb])
    out[moved] = Surface(data.template.with_vertices(body)).closest(turned).points
    return out


def doubted(data: RealData, parts: PersonParts, vertices: np.ndarray) -> set[str]:
    """What is doubted, whatever the figures in it."""
    return {re.sub(r"\d+", "", doubt.words) for doubt in limb_doubts(data.template, parts, vertices)}


def put_right(data: RealData, parts: PersonParts, pose: int, degrees: int) -> None:
    """Every limb of one pose rolled and repaired: how far it is off before and after, by ten landmarks."""
    item, part = test_scan(data, "pose", pose), parts.skeleton.part_of_vertex(data.template)
    landmarks = item.landmarks(data, "10")
    given = prepare_problem(data.template, item.scan, landmarks)
    for limb in LIMBS:
        p = parts.skeleton.names.index(limb)
        x = rolled(data, parts, item.truth.vertices, p, np.radians(degrees))
        before = measure_fit(given, replace(start_fit(data.template, np.eye(4), 300), x=x, moved=0.0), item.scan)
        after = repair_limbs(data.template, item.scan, before, parts, landmarks)
        off = [1e3 * np.linalg.norm(fit.mesh.vertices - item.truth.vertices, axis=1)[part == p].mean()
               for fit in (before, after)]
        print(f"{item.name} {limb} {degrees} degrees: {off[0]:.1f} mm, after {off[1]:.1f} mm", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", choices=("tuning", "held"), default="tuning", dest="chosen")
    parser.add_argument("--repair", help="numbers of poses whose limbs are rolled and repaired, instead")
    parser.add_argument("--degrees", type=int, default=180, help="by which they are rolled")
    parser.add_argument("-o", "--output", help="write all figures here")
    args = parser.parse_args()
    data = load_real()
    parts = person_parts(data.template)
    assert parts is not None, "the template is a person"
    if args.repair:
        for pose in args.repair.split(","):
            put_right(data, parts, int(pose), args.degrees)
        return
    part, rows = parts.skeleton.part_of_vertex(data.template), []
    poses = {"tuning": TUNING_POSES, "held": HELD_POSES}[args.chosen]
    for limb in LIMBS:
        p = parts.skeleton.names.index(limb)
        for angle in ANGLES:
            told, off = [], []
            for body in data.poses[list(poses)]:
                before = doubted(data, parts, body)
                found = rolled(data, parts, body, p, np.radians(angle))
                told.append(bool(doubted(data, parts, found) - before))
                off.append(1e3 * np.linalg.norm(found - body, axis=1)[part == p].mean())
            rows.append({"limb": limb, "degrees": angle, "bodies": len(told), "told": sum(told),
                         "limb_off_mm": float(np.mean(off))})
            print(rows[-1], flush=True)
    if args.output:
        write_report(args.output, {"set": args.chosen, "machine": machine(), "rows": rows})


if __name__ == "__main__":
    main()
