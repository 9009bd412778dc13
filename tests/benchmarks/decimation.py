"""Decimation beside other libraries: a closed body, the same body cut open, and a whole registered set.

    SCAPEKIT_DATA=... python tests/benchmarks/decimation.py [--faces 50000] [--only closed,open,set] [-o FILE]

The body of about 400,000 triangles is mesh000, subdivided twice by Loop's rule, with relief of up to 1.4 mm. Libraries
that are not installed are left out by name. Times are of the process, not of the wall. What we lose at:
fast-simplification and pyfqmr are several times quicker, qslim is a little closer at the same count.
"""
from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from protocols import RealData, load_real, machine, write_report
from scipy.spatial import cKDTree

from scanprep.decimation.decimate import DecimateConfig, decimate
from scanprep.decimation.registered_set import decimate_set
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.repair.intersections import intersecting_faces

sys.path.insert(0, str(Path(__file__).parents[1]))
from surface_distances import surface_distance

Method = Callable[[Mesh, int], Mesh]
PEERS = {"fast-simplification": "fast_simplification", "pyfqmr": "pyfqmr", "igl.decimate": "igl", "igl.qslim": "igl",
         "open3d": "open3d", "pymeshlab": "pymeshlab"}


def large_body(data: RealData) -> Mesh:
    """mesh000 with sixteen times the triangles and some relief, which no mesh of fewer triangles can have."""
    import igl

    v, f = igl.loop(np.asfortranarray(data.template.vertices), np.asfortranarray(data.template.faces), 2)[:2]
    smooth = Mesh(v, f)
    x, y, z = smooth.vertices.T
    relief = 4e-4 * np.sin(400 * x) * np.sin(410 * y + 1) * np.sin(390 * z + 2)
    relief += 1e-3 * np.sin(90 * x + 1) * np.sin(80 * y) * np.sin(85 * z)
    return smooth.with_vertices(smooth.vertices + relief[:, None] * smooth.vertex_normals)


def ours(method: str) -> Method:
    def run(mesh: Mesh, faces: int) -> Mesh:
        return decimate(mesh, faces, DecimateConfig(method))       # type: ignore[arg-type]

    return run


def peer(name: str) -> Method:
    """The plain call of a library, as its documentation shows it."""
    def run(mesh: Mesh, faces: int) -> Mesh:
        v, f = np.array(mesh.vertices), np.array(mesh.faces)
        if name == "fast-simplification":
            import fast_simplification

            return Mesh(*fast_simplification.simplify(v, f, target_count=faces))
        if name == "pyfqmr":
            import pyfqmr

            simplifier = pyfqmr.Simplify()
            simplifier.setMesh(v, f)
            simplifier.simplify_mesh(target_count=faces, aggressiveness=7, preserve_border=True, verbose=False)
            return Mesh(*simplifier.getMesh()[:2])
        if name.startswith("igl"):
            import igl

            call = igl.qslim if name == "igl.qslim" else igl.decimate
            return Mesh(*call(np.asfortranarray(v), np.asfortranarray(f), faces)[:2])
        if name == "open3d":
            import open3d

            whole = open3d.geometry.TriangleMesh(open3d.utility.Vector3dVector(v),
                                                 open3d.utility.Vector3iVector(f.astype(np.int32)))
            smaller = whole.simplify_quadric_decimation(faces)
            return Mesh(np.asarray(smaller.vertices), np.asarray(smaller.triangles))
        import pymeshlab

        meshes = pymeshlab.MeshSet()
        meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=v, face_matrix=f.astype(np.int32)))
        meshes.meshing_decimation_quadric_edge_collapse(targetfacenum=faces, preservetopology=True,
                                                        preserveboundary=True)
        return Mesh(meshes.current_mesh().vertex_matrix(), meshes.current_mesh().face_matrix())

    return run


Row = dict[str, float | int | bool]


def measure(mesh: Mesh, run: Method, faces: int) -> Row:
    """Time, and what came out; distances in millimetres."""
    mesh = Mesh(mesh.vertices, mesh.faces)                       # nothing derived is there yet
    start = time.process_time()
    small = run(mesh, faces)
    spent = time.process_time() - start
    apart = surface_distance(mesh, small)
    middle = small.corners.mean(axis=1)
    faced = mesh.face_normals[Surface(mesh).closest(middle).faces]
    row: Row = {"cpu_s": spent, "faces": len(small.faces), "mean_mm": 1e3 * apart.mean, "p95_mm": 1e3 * apart.p95,
           "to_original_max_mm": 1e3 * apart.b_to_a.hausdorff, "from_original_max_mm": 1e3 * apart.a_to_b.hausdorff,
           "closed": small.is_closed, "edge_manifold": small.is_edge_manifold,
           "vertex_manifold": small.is_vertex_manifold, "intersecting_pairs": len(intersecting_faces(small)),
           "turned_faces": int((np.einsum("fd,fd->f", faced, small.face_normals) < 0).sum())}
    if len(mesh.boundary_vertices):
        row["borders"] = len(small.boundary_loops)
        row["border_mean_mm"], row["border_max_mm"] = border_distance(mesh, small)
    return row


def border_distance(a: Mesh, b: Mesh) -> tuple[float, float]:
    """Mean and largest distance of the borders of two meshes both ways, millimetres."""
    def points(mesh: Mesh) -> np.ndarray:
        ends = mesh.vertices[mesh.edges[mesh.edge_use == 1]]
        share = np.linspace(0, 1, 40, endpoint=False)[:, None, None]
        return ((1 - share) * ends[:, 0] + share * ends[:, 1]).reshape(-1, 3)

    p, q = points(a), points(b)
    if not len(q):
        return float("nan"), float("nan")
    far = np.concatenate([cKDTree(q).query(p)[0], cKDTree(p).query(q)[0]])
    return 1e3 * float(far.mean()), 1e3 * float(far.max())


def measure_set(data: RealData, faces: int, poses: np.ndarray | None) -> Row:
    """One decimation of the template and some poses, measured on the poses and men that it did not see."""
    keep = np.unique(list(data.landmarks.values()))
    start = time.process_time()
    small = decimate_set(data.template, poses, faces, keep)
    row: Row = {"cpu_s": time.process_time() - start, "faces": len(small.template.faces)}
    for name, bodies in (("poses", data.poses[1::10]), ("men", data.shapes[3::40])):
        found = unseen(data.template, small.template, bodies, small.transfer(bodies))
        row |= {f"{name}_{k}": v for k, v in found.items()}
    return row


def replayed(data: RealData, faces: int) -> Row:
    """The collapses that fast-simplification finds on the template, replayed on every other mesh."""
    import fast_simplification

    f = np.array(data.template.faces)
    start = time.process_time()
    v, small, collapses = fast_simplification.simplify(np.array(data.template.vertices), f, target_count=faces,
                                                       return_collapses=True)
    row: Row = {"cpu_s": time.process_time() - start, "faces": len(small)}
    for name, bodies in (("poses", data.poses[1::10]), ("men", data.shapes[3::40])):
        carried = [fast_simplification.replay_simplification(np.array(b), f, collapses)[0] for b in bodies]
        row |= {f"{name}_{k}": v for k, v in unseen(data.template, Mesh(v, small), bodies, carried).items()}
    return row


def unseen(template: Mesh, small: Mesh, before: np.ndarray, after: np.ndarray | list[np.ndarray]) -> dict[str, float]:
    """Distances of the surfaces, and how far vertices lie, brought back to the template, from where they lie there."""
    there = Surface(template).closest(small.vertices).points
    slid = [np.linalg.norm(Surface(template.with_vertices(b)).closest(a).transfer(template.vertices, template.faces)
                           - there, axis=1) for b, a in zip(before, after, strict=True)]
    apart = [surface_distance(template.with_vertices(b), small.with_vertices(a), 20_000)
             for b, a in zip(before, after, strict=True)]
    return {"mean_mm": 1e3 * float(np.mean([d.mean for d in apart])),
            "p95_mm": 1e3 * float(np.mean([d.p95 for d in apart])),
            "max_mm": 1e3 * float(np.max([d.hausdorff for d in apart])), "slide_mm": 1e3 * float(np.mean(slid))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--faces", type=int, default=50_000)
    parser.add_argument("--only", default="closed,open,set")
    parser.add_argument("-o", "--output", default="decimation.json")
    args = parser.parse_args()
    data = load_real()
    body = large_body(data)
    height = body.corners[:, :, 2].mean(axis=1)
    opened = body.submesh(height > np.median(height))[0]
    opened = opened.submesh(opened.vertex_component[opened.faces[:, 0]] == 0)[0]
    methods = {f"ours, {name}": ours(name) for name in ("quadric", "even")}
    methods |= {name: peer(name) for name, module in PEERS.items() if importlib.util.find_spec(module)}
    report: dict[str, object] = {"machine": machine(), "faces": args.faces, "body": len(body.faces),
                                 "missing": [n for n, m in PEERS.items() if not importlib.util.find_spec(m)]}
    for name, mesh, wanted in (("closed", body, args.faces), ("open", opened, args.faces // 2)):
        if name in args.only.split(","):
            report[name] = {label: measure(mesh, run, wanted) for label, run in methods.items()}
    if "set" in args.only.split(","):
        report["set"] = {f"{faces} faces": {
            "ours, vertices, 1 meshes": measure_set(data, faces, None),
            "ours, vertices, 8 meshes": measure_set(data, faces, data.poses[::2]),
            "fast-simplification, replayed": replayed(data, faces)} for faces in (12_000, 3_000)}
    write_report(args.output, report)


if __name__ == "__main__":
    main()
