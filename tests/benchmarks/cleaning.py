"""Merging four virtual views and filling six holes, ours beside other tools; with --held on the held-out bodies.

    python tests/benchmarks/cleaning.py -o cleaning.json [--held] [--merge N] [--holes N]

Peers are measured where they can be imported: open3d, pymeshlab, pymeshfix, trimesh. Times are of the processor.
"""
from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from holes import HoledBody, distances, embedded_body, real_body
from protocols import RealData, load_real, machine, write_report
from scans import HELD_MEN, HELD_POSES, TUNING_MEN, TUNING_POSES

from scanprep.alignment.views import align_views
from scanprep.fusion.tsdf import merge_views
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.repair.hole_filling import fill_report
from scanprep.repair.intersections import intersecting_faces
from scanprep.synthetic.scanner import RangeView, scan

sys.path.insert(0, str(Path(__file__).parents[1]))
from surface_distances import surface_distance

SEEN = 0.007           # metres: true surface with a scan point this close was seen


def knocked(views: list[tuple[Mesh, np.ndarray]], degrees: float, metres: float, rng: np.random.Generator
            ) -> list[tuple[Mesh, np.ndarray]]:
    """The views but the first turned about their middles and moved, each its own way."""
    out = [views[0]]
    for mesh, camera in views[1:]:
        axis, way = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
        R, middle = rotations.exp(np.radians(degrees) * axis), mesh.vertices.mean(axis=0)
        t = middle - R @ middle + metres * way
        out.append((mesh.with_vertices(mesh.vertices @ R.T + t), R @ camera + t))
    return out


def merge_errors(merged: Mesh, truth: Mesh, points: np.ndarray, free: bool) -> dict[str, float]:
    """Millimetres from the merged to the true surface, and back from where there were data.

    Parameters
    ----------
    free : bool
        The views were aligned to each other, not to the truth: the whole is moved onto it first.
    """
    from scipy.spatial import cKDTree

    from scanprep.alignment.icp import align_rigid

    if free:
        T = align_rigid(merged.vertices[::7], truth).T_target_source
        merged, points = (merged.with_vertices(merged.vertices @ T[:3, :3].T + T[:3, 3]),
                          points @ T[:3, :3].T + T[:3, 3])
    there = surface_distance(merged, truth).a_to_b
    sample = truth.sample(50_000, np.random.default_rng(0))[0]
    sample = sample[cKDTree(points).query(sample)[0] < SEEN]
    back = Surface(merged).closest(sample).distances
    return {"mean_mm": 1e3 * there.mean, "p95_mm": 1e3 * there.p95, "max_mm": 1e3 * there.hausdorff,
            "back_mean_mm": 1e3 * float(back.mean()), "back_p95_mm": 1e3 * float(np.percentile(back, 95))}


def merging(data: RealData, bodies: list[tuple[str, int]]) -> list[dict[str, object]]:
    """Rows: body, way, errors, whether the alignment says it can be trusted."""
    rows: list[dict[str, object]] = []
    for kind, index in bodies:
        truth = data.template.with_vertices((data.poses if kind == "pose" else data.shapes)[index])
        views = list(scan(truth, rng=np.random.default_rng(index)).views)
        pairs = [(view.mesh, view.camera) for view in views]
        marks = [{name: point + np.random.default_rng(k).normal(0, 0.003, 3) for name, v in data.landmarks.items()
                  if np.linalg.norm(mesh.vertices - (point := truth.vertices[v]), axis=1).min() < SEEN}
                 for k, (mesh, _) in enumerate(pairs)]
        rng = np.random.default_rng(index)
        ways: dict[str, Callable[[], list[tuple[Mesh, np.ndarray]] | None]] = {
            "known cameras": lambda pairs=pairs: pairs,
            "4 degrees, 4 cm off": lambda pairs=pairs, rng=rng: aligned(knocked(pairs, 4, 0.04, rng)),
            "10 degrees, 10 cm off": lambda pairs=pairs, rng=rng: aligned(knocked(pairs, 10, 0.10, rng)),
            "unknown, landmarks": lambda pairs=pairs, marks=marks, rng=rng: aligned(*lost(pairs, marks, rng))}
        for way, make in ways.items():
            start = time.process_time()
            try:
                found = make()
            except ValueError as error:                          # too few landmarks seen by two views, say
                print(f"{kind}{index:03d}, {way}: {error}", flush=True)
                found = None
            row: dict[str, object] = {"body": f"{kind}{index:03d}", "way": way, "trusted": found is not None}
            if found is not None:
                merged = merge_views(found)
                row["seconds"] = time.process_time() - start
                row |= merge_errors(merged, truth, np.concatenate([m.vertices for m, _ in found]), way[0] != "k")
            rows.append(row)
            print(row, flush=True)
        rows += [{"body": f"{kind}{index:03d}", "way": way} | row for way, row in merge_peers(views, truth)]
    return rows


def aligned(views: list[tuple[Mesh, np.ndarray]], landmarks: list[dict[str, np.ndarray]] | None = None
            ) -> list[tuple[Mesh, np.ndarray]] | None:
    """The views brought together, or None when the alignment says that it failed."""
    result = align_views(views, landmarks=landmarks)
    return result.views if result.trusted.all() else None


def lost(views: list[tuple[Mesh, np.ndarray]], marks: list[dict[str, np.ndarray]], rng: np.random.Generator
         ) -> tuple[list[tuple[Mesh, np.ndarray]], list[dict[str, np.ndarray]]]:
    """Views in frames of their own, except the first, with the landmarks that were clicked on each."""
    moved, clicked = [], []
    for number, ((mesh, camera), points) in enumerate(zip(views, marks, strict=True)):
        R, t = rotations.exp(2 * rng.normal(size=3) * (number > 0)), rng.normal(size=3) * (number > 0)
        moved.append((mesh.with_vertices(mesh.vertices @ R.T + t), R @ camera + t))
        clicked.append({name: R @ point + t for name, point in points.items()})
    return moved, clicked


def merge_peers(views: list[RangeView], truth: Mesh) -> Iterator[tuple[str, dict[str, object]]]:
    """open3d's volume with the true cameras, where it is installed."""
    try:
        import open3d as o3d
    except (ImportError, OSError):
        return
    start = time.process_time()
    core = o3d.core
    volume = o3d.t.geometry.VoxelBlockGrid(("tsdf", "weight"), (core.float32, core.float32), ((1,), (1,)), 0.004, 16,
                                           50_000, core.Device("CPU:0"))
    for view in views:
        depth = o3d.t.geometry.Image(core.Tensor(np.nan_to_num(view.depth).astype(np.float32)))
        camera = core.Tensor(view.intrinsics), core.Tensor(np.linalg.inv(view.T_world_camera)), 1.0, 10.0
        volume.integrate(volume.compute_unique_block_coordinates(depth, *camera), depth, *camera)
    mesh = volume.extract_triangle_mesh(0.5)
    merged = Mesh(mesh.vertex.positions.numpy().astype(float), mesh.triangle.indices.numpy().astype(np.int64))
    row: dict[str, object] = {"seconds": time.process_time() - start}
    if not len(merged.faces):
        print("open3d TSDF: no surface came out", flush=True)
        return
    row |= merge_errors(merged, truth, np.concatenate([v.mesh.vertices for v in views]), False)
    print("open3d TSDF", row, flush=True)
    yield "open3d TSDF, known cameras", row


def fillers() -> dict[str, Callable[[Mesh], tuple[Mesh, bool]]]:
    """Name -> function to a filled mesh and whether the triangles of the old one come first in it."""
    found = {"scapekit": lambda mesh: (fill_report(mesh).mesh, True), "trimesh fill_holes": trimesh_fill}
    try:
        import open3d  # noqa: F401

        found |= {"open3d fill_holes": open3d_fill, "open3d Poisson": open3d_poisson}
    except (ImportError, OSError):
        pass
    try:
        import pymeshlab  # noqa: F401

        found["pymeshlab close_holes"] = pymeshlab_fill
    except (ImportError, OSError):
        pass
    try:
        import pymeshfix  # noqa: F401

        found["pymeshfix"] = pymeshfix_fill
    except (ImportError, OSError):
        pass
    return found


def trimesh_fill(mesh: Mesh) -> tuple[Mesh, bool]:
    import trimesh

    other = trimesh.Trimesh(np.array(mesh.vertices), np.array(mesh.faces), process=False)
    other.fill_holes()
    return Mesh(other.vertices, other.faces), True


def open3d_fill(mesh: Mesh) -> tuple[Mesh, bool]:
    import open3d as o3d

    legacy = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(np.array(mesh.vertices)),
                                       o3d.utility.Vector3iVector(mesh.faces.astype(np.int32)))
    given = o3d.t.geometry.TriangleMesh.from_legacy(legacy)          # what comes back may point into it
    filled = given.fill_holes(1e6)
    return Mesh(filled.vertex.positions.numpy().astype(float), filled.triangle.indices.numpy()), False


def open3d_poisson(mesh: Mesh) -> tuple[Mesh, bool]:
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.array(mesh.vertices)))
    cloud.normals = open3d.utility.Vector3dVector(np.array(mesh.vertex_normals))
    closed, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=8, n_threads=1)
    return Mesh(np.asarray(closed.vertices), np.asarray(closed.triangles)), False


def pymeshlab_fill(mesh: Mesh) -> tuple[Mesh, bool]:
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.faces.astype(np.int32)))
    meshes.meshing_close_holes(maxholesize=100_000, selfintersection=False)
    current = meshes.current_mesh()
    return Mesh(current.vertex_matrix(), current.face_matrix()), True


def pymeshfix_fill(mesh: Mesh) -> tuple[Mesh, bool]:
    import pymeshfix

    return Mesh(*pymeshfix.clean_from_arrays(np.array(mesh.vertices), np.array(mesh.faces))), False


def filling(bodies: list[HoledBody]) -> list[dict[str, object]]:
    """Rows: body, filler, errors, whether closed, pairs of triangles that cross because of the patch."""
    rows: list[dict[str, object]] = []
    for item in bodies:
        for name, fill in fillers().items():
            start = time.process_time()
            filled, appended = fill(item.holed)
            old = len(item.holed.faces)
            row: dict[str, object] = {"body": item.name, "filler": name, "seconds": time.process_time() - start,
                                      "closed": filled.is_closed, "manifold": filled.is_edge_manifold}
            if appended and len(filled.faces) > old:
                row["crossing"] = len(intersecting_faces(filled, np.arange(old, len(filled.faces))))
                row["untouched"] = np.array_equal(filled.vertices[:len(item.holed.vertices)], item.holed.vertices)
            row |= distances(item, filled, old if appended else None)
            rows.append(row)
            print({key: round(v, 2) if isinstance(v, float) else v for key, v in row.items()}, flush=True)
    return rows


def summary(rows: list[dict[str, object]], by: str, keys: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Means over the bodies, and the worst of what ends in max_mm."""
    out: dict[str, dict[str, float]] = {}
    for name in dict.fromkeys(str(row[by]) for row in rows):
        mine = [row for row in rows if row[by] == name]
        out[name] = {"bodies": len(mine)}
        for key in keys:
            values = np.array([float(row[key]) for row in mine if key in row])               # type: ignore[arg-type]
            if len(values):
                out[name][key] = float(values.mean())
                if key.endswith("max_mm"):
                    out[name][f"worst {key}"] = float(values.max())
        print(f"{name:28s}", {key: round(value, 2) for key, value in out[name].items()}, flush=True)
    return out


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", default="cleaning.json")
    parser.add_argument("--held", action="store_true")
    parser.add_argument("--merge", type=int, default=2, help="poses and as many men to merge")
    parser.add_argument("--holes", type=int, default=3, help="poses, men and procedural people each to fill")
    options = parser.parse_args()
    data = load_real()
    poses, men = (HELD_POSES, HELD_MEN) if options.held else (TUNING_POSES, TUNING_MEN)
    report: dict[str, object] = {"machine": machine(), "held_out": options.held}
    if options.merge:
        rows = merging(data, [("pose", k) for k in poses[:options.merge]] + [("man", k) for k in men[:options.merge]])
        report |= {"merge": rows, "merge_means": summary(rows, "way", (
            "trusted", "mean_mm", "p95_mm", "max_mm", "back_mean_mm", "back_p95_mm", "seconds"))}
    keys = ("closed", "manifold", "crossing", "untouched", "patch_mean_mm", "patch_max_mm", "truth_mean_mm",
            "truth_max_mm", "seconds")
    for scale in (1.0, 0.7) if options.holes else ():
        bodies = [real_body(data, "pose", k, scale) for k in (0, *poses[:options.holes])]
        bodies += [real_body(data, "man", k, scale) for k in men[:options.holes]]
        bodies += [embedded_body(100 * options.held + k, scale) for k in range(options.holes)]
        rows = filling(bodies)
        report |= {f"holes x {scale}": rows, f"hole_means x {scale}": summary(rows, "filler", keys)}
    write_report(options.output, report)


if __name__ == "__main__":
    main()
