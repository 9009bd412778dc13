"""Parts, tree and joints: on the real poses with every fifth held out, and on a synthetic person.

    SCAPEKIT_DATA=... python tests/benchmarks/skeleton.py [-o FILE] [--only real folds embedded animals]

Real poses have no truth: reported are the number of parts, the agreement over seeds and with the skeletons of
four fifths of the poses (adjusted Rand index), how far poses are from moving rigidly, and how unlike left and right
are in area. The synthetic person is disturbed by smooth noise and by sliding along the skin, as registration does.
Where py-dem-bones is installed it decomposes the same poses.
"""
from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from animal_bodies import Animal, Build, random_pose
from protocols import load_real, machine, scape_fold
from scipy.sparse import csc_array, diags_array, eye_array

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sparse import factor
from scanprep.geometry.surface import Surface
from scanprep.skeleton.find import SkeletonSearch, find_skeleton, search_skeleton
from scanprep.skeleton.motions import PosedSurface
from scanprep.skeleton.names import part_partners
from scanprep.skeleton.parts import SkeletonConfig
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.data_set import subject_pose
from scanprep.synthetic.people import SyntheticPerson


def adjusted_rand(a: np.ndarray, b: np.ndarray) -> float:
    """1 when two partitions (n,) agree, 0 on average for random ones."""
    table = np.zeros((a.max() + 1, b.max() + 1))
    np.add.at(table, (a, b), 1)
    together = [(t * (t - 1) / 2).sum() for t in (table, table.sum(axis=1), table.sum(axis=0))]
    n = table.sum()
    chance = together[1] * together[2] / (n * (n - 1) / 2)
    return float((together[0] - chance) / ((together[1] + together[2]) / 2 - chance))


def rigid_error(template: Mesh, poses: np.ndarray, skeleton: Skeleton) -> float:
    """Mean distance of vertices to where the rigid motion of their part carries them, metres."""
    surface = PosedSurface(template, poses)
    motions = surface.core_motions(skeleton.part_of_face)
    part = skeleton.part_of_vertex(template)
    carried = np.einsum("nmij,nj->nmi", motions.R[part], surface.x) + motions.t[part]
    return float(np.linalg.norm(carried - surface.y, axis=2).mean())


def joint_distances(true: Skeleton, found: Skeleton, areas: np.ndarray) -> dict[str, float]:
    """Metres between joints of links whose two parts correspond, by the name of the true child."""
    table = np.zeros((len(true.parents), len(found.parents)))
    np.add.at(table, (true.part_of_face, found.part_of_face), areas)
    twin = table.argmax(axis=0)
    distances = {}
    for j in range(1, len(found.parents)):
        a, b = twin[j], twin[found.parents[j]]
        for child, parent in ((a, b), (b, a)):
            if true.parents[child] == parent:
                distances[true.names[child]] = float(np.linalg.norm(found.joints[j] - true.joints[child]))
    return distances


def smooth_noise(mesh: Mesh, size: float, reach: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, N, 3) noise of RMS length `size` that varies over `reach` along the surface, metres."""
    A = mesh.vertex_adjacency
    degree = np.asarray(A.sum(axis=1)).ravel()
    n = len(degree)
    stiffness = 0.5 * (reach / mesh.mean_edge)**2 / degree.mean()
    solve = factor(csc_array(eye_array(n) + stiffness * (diags_array(degree) - A)))
    noise = solve(solve(rng.normal(size=(n, 3 * count)))).reshape(n, count, 3).transpose(1, 0, 2)
    return size * noise / np.sqrt((noise**2).sum(axis=2).mean())


def disturbed(mesh: Mesh, poses: np.ndarray, noise: float, slide: float, rng: np.random.Generator) -> np.ndarray:
    """Poses (M, N, 3) that slid along their surface and were moved by smooth noise."""
    moved, slid = (smooth_noise(mesh, size, reach, len(poses), rng) for size, reach in ((noise, 0.05), (slide, 0.08)))
    out = []
    for body, offset, along in zip(poses, moved, slid, strict=True):
        posed = mesh.with_vertices(body)
        normal = posed.vertex_normals
        tangent = along - normal * (along * normal).sum(axis=1, keepdims=True)
        out.append(Surface(posed).closest(body + tangent).points + offset)
    return np.stack(out)


def facts(found: SkeletonSearch, mesh: Mesh, poses: np.ndarray, seconds: float) -> dict[str, object]:
    """What can be said of a skeleton without knowing the truth."""
    skeleton = found.skeleton
    share = np.bincount(skeleton.part_of_face, mesh.face_areas) / mesh.face_areas.sum()
    partner = part_partners(mesh, skeleton, found.symmetry) if found.symmetry.holds else None
    uneven = None if partner is None else float((1 - share[partner] / np.maximum(share, share[partner])).max())
    return {"parts": len(skeleton.parents), "names": list(skeleton.names), "symmetric": found.symmetric,
            "left_and_right_differ_in_area": uneven,
            "restarts_ended_with": list(found.parts), "energies": list(found.energies), "cpu_s": seconds,
            "rigid_mm": 1e3 * rigid_error(mesh, poses, skeleton)}


def searched(mesh: Mesh, poses: np.ndarray, config: SkeletonConfig | None = None) -> tuple[SkeletonSearch, float]:
    """The search and its processor time, seconds."""
    start = time.process_time()
    found = search_skeleton(mesh, poses, config)
    return found, time.process_time() - start


def links(skeleton: Skeleton) -> set[frozenset[str]]:
    """The links by names, or where parts have none, by numbers."""
    return {frozenset((skeleton.names[j], skeleton.names[p])) for j, p in enumerate(skeleton.parents) if p >= 0}


def over_seeds(mesh: Mesh, poses: np.ndarray, seeds: int) -> dict[str, object]:
    """The same search begun from other seeds: agreement of every one with the first."""
    runs = [searched(mesh, poses, SkeletonConfig(seed=seed)) for seed in range(seeds)]
    first = runs[0][0].skeleton
    return {"runs": [facts(found, mesh, poses, seconds) for found, seconds in runs],
            "agreement_with_first": [adjusted_rand(first.part_of_face, f.skeleton.part_of_face) for f, _ in runs],
            "same_links": [links(first) == links(found.skeleton) for found, _ in runs]}


def real(seeds: int) -> dict[str, object]:
    data = load_real()
    exact, seconds = searched(data.template, data.poses, SkeletonConfig(parts=16))
    return {**over_seeds(data.template, data.poses, seeds),
            "sixteen": facts(exact, data.template, data.poses, seconds),
            "dem_bones": dem_bones(data.template, data.poses, len(exact.skeleton.parents))}


def held_out() -> list[dict[str, object]]:
    """Skeletons from four fifths of the real poses: parts, agreement with all poses, rigidity of the rest."""
    data = load_real()
    whole = find_skeleton(data.template, data.poses)
    folds = []
    for fold in range(5):
        train, held = scape_fold(fold)
        skeleton = find_skeleton(data.template, data.poses[train])
        folds.append({"parts": len(skeleton.parents),
                      "agreement": adjusted_rand(whole.part_of_face, skeleton.part_of_face),
                      "held_out_rigid_mm": 1e3 * rigid_error(data.template, data.poses[held], skeleton)})
    return folds


def against_truth(mesh: Mesh, poses: np.ndarray, truth: Skeleton) -> dict[str, object]:
    found, seconds = searched(mesh, poses)
    joints = joint_distances(truth, found.skeleton, mesh.face_areas)
    return {**facts(found, mesh, poses, seconds),
            "adjusted_rand": adjusted_rand(truth.part_of_face, found.skeleton.part_of_face),
            "joints_matched": len(joints), "joint_mm": {k: 1e3 * v for k, v in joints.items()},
            "dem_bones": dem_bones(mesh, poses, len(truth.parents), truth)}


def embedded(noise: float, slide: float, seed: int = 1, count: int = 20) -> dict[str, object]:
    person, rng = SyntheticPerson(), np.random.default_rng(seed)
    poses = np.stack([person.in_pose(subject_pose(k, rng)[1]) for k in range(count)])
    if noise or slide:
        poses = disturbed(person.mesh, poses, noise, slide, rng)
    return {"noise_mm": 1e3 * noise, "slide_mm": 1e3 * slide, **against_truth(person.mesh, poses, person.skeleton)}


def animal(aside: float, count: int = 40) -> dict[str, object]:
    """A four-legged animal, its head carried straight (0) or to one side (1)."""
    body, rng = Animal(Build(aside=aside)), np.random.default_rng(0)
    poses = np.stack([body.mesh.vertices, *(body.posed(random_pose(rng)) for _ in range(count - 1))])
    return {"head_aside": aside, **against_truth(body.mesh, poses, body.skeleton)}


def dem_bones(mesh: Mesh, poses: np.ndarray, bones: int, truth: Skeleton | None = None) -> dict[str, object] | str:
    """Parts by the largest weights of a skinning decomposition (it must be told how many bones, and has no joints)."""
    try:
        from py_dem_bones import solve_skinning
    except ImportError:
        return "not installed (pip install py-dem-bones)"
    start = time.process_time()
    solved = solve_skinning(mesh.vertices, poses, bones, faces=mesh.faces.tolist())
    seconds = time.process_time() - start
    x1 = np.c_[mesh.vertices, np.ones(len(mesh.vertices))]
    carried = np.einsum("bn,mbij,nj->mni", solved.weights, solved.transforms[:, :, :3], x1, optimize=True)
    part = solved.weights[:, mesh.faces].sum(axis=2).argmax(axis=0)
    return {"bones": len(solved.weights), "cpu_s": seconds,
            "rmse_mm": 1e3 * float(np.sqrt(((carried - poses)**2).sum(axis=2).mean())),
            "adjusted_rand": None if truth is None else adjusted_rand(truth.part_of_face, part)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", nargs="*", default=["real", "folds", "embedded", "animals"])
    asked = parser.parse_args()
    report: dict[str, object] = {"machine": machine()}
    sections = {"embedded": lambda: [embedded(n, s) for n, s in ((0, 0), (0.003, 0.005), (0.005, 0.01))],
                "animals": lambda: [animal(aside) for aside in (0.0, 1.0)],
                "real": lambda: real(asked.seeds), "folds": held_out}
    for section in (name for name in sections if name in asked.only):
        report[section] = sections[section]()
        print(section, json.dumps(report[section], indent=1), flush=True)
        if asked.output:
            asked.output.write_text(json.dumps(report, indent=1))
