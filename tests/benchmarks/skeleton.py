"""Parts, tree and joints: on the real poses with every fifth held out, and on an embedded person.

    SCAPEKIT_DATA=... python tests/benchmarks/skeleton.py [OUT.json]

Real poses have no truth: reported are the number of parts per fold, the agreement with the parts from all
poses (adjusted Rand index), how far the held-out poses are from moving rigidly, and how unlike left and right
limbs are in area. The embedded person is disturbed by smooth noise and by sliding along the skin, as
registration does.
"""
from __future__ import annotations

import json
import platform
import sys
import time
from pathlib import Path

import numpy as np
import scipy
from protocols import load_real, scape_fold
from scipy.sparse import csc_array, diags_array, eye_array

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sparse import factor
from scanprep.geometry.surface import Surface
from scanprep.scanning.embedded import subject_pose
from scanprep.scanning.people import Person
from scanprep.skeleton.find import find_skeleton
from scanprep.skeleton.motions import PosedSurface
from scanprep.skeleton.tree import Skeleton


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


def real() -> dict[str, object]:
    data = load_real()
    start = time.process_time()
    whole = find_skeleton(data.template, data.poses)
    seconds = time.process_time() - start
    folds = []
    for fold in range(5):
        train, held = scape_fold(fold)
        skeleton = find_skeleton(data.template, data.poses[train])
        folds.append({"parts": len(skeleton.parents),
                      "agreement": adjusted_rand(whole.part_of_face, skeleton.part_of_face),
                      "held_out_rigid_mm": 1e3 * rigid_error(data.template, data.poses[held], skeleton)})
    return {"parts": len(whole.parents), "cpu_s": seconds, "folds": folds}


def embedded(noise: float, slide: float, seed: int = 1, count: int = 20) -> dict[str, object]:
    person, rng = Person(), np.random.default_rng(seed)
    poses = np.stack([person.posed(subject_pose(k, rng)[1]) for k in range(count)])
    if noise or slide:
        poses = disturbed(person.mesh, poses, noise, slide, rng)
    start = time.process_time()
    found = find_skeleton(person.mesh, poses)
    seconds = time.process_time() - start
    joints = joint_distances(person.skeleton, found, person.mesh.face_areas)
    return {"noise_mm": 1e3 * noise, "slide_mm": 1e3 * slide, "parts": len(found.parents), "cpu_s": seconds,
            "adjusted_rand": adjusted_rand(person.part_of_face, found.part_of_face),
            "joints_matched": len(joints), "joint_mm": {k: 1e3 * v for k, v in joints.items()}}


if __name__ == "__main__":
    report = {"machine": platform.machine(), "numpy": np.__version__, "scipy": scipy.__version__, "real": real(),
              "embedded": [embedded(n, s) for n, s in ((0, 0), (0.003, 0.005), (0.005, 0.01))]}
    text = json.dumps(report, indent=1)
    print(text)
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(text)
