"""Other people's registration tools and ours on the same virtual scans, in one run.

    SCAPEKIT_DATA=... python tests/benchmarks/peers.py [--bodies pose2,pose22,pose47,pose67,man52] [--bcpd PROGRAM]
        [--limit 1800] [-o peers.json]

Peers, each given the ten landmarks where it can take them, and the template placed by them rigidly where it cannot:

- trimesh `nricp_amberg` and `nricp_sumner`, default steps (pip install trimesh rtree);
- coherent point drift: Bayesian, with the geodesic kernel, accelerated (the program of github.com/ohirose/bcpd,
  built with `make`), and the classic one on 2,000 and 4,000 points (pip install pycpd), carried to all vertices
  by the three nearest points;
- MeshMonk `pyramid_register`, default settings, in millimetres (pip install meshmonk);
- functional maps: wave kernel signatures, landmarks, ZoomOut to 120 functions (pip install pyfmaps), on the views
  merged and closed by us, because it needs one connected surface.

A peer that is not there is listed as missing. Writes peers.json beside the call.
"""
from __future__ import annotations

import argparse
import importlib.util
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from alone import MissingError, alone
from protocols import RealData, load_real, machine, write_report
from scans import TestScan, errors, test_scan
from scipy.spatial import cKDTree

from scanprep.alignment.icp import align_landmarks


def need(package: str) -> None:
    if importlib.util.find_spec(package) is None:
        raise MissingError(package)


def placed(data: RealData, item: TestScan) -> np.ndarray:
    """The template, moved rigidly by its landmarks."""
    vertices, points = item.landmarks(data, "10") or (np.zeros(0, int), np.zeros((0, 3)))
    T = align_landmarks(data.template.vertices[vertices], points).T_target_source
    return data.template.vertices @ T[:3, :3].T + T[:3, 3]


def ours(data: RealData, item: TestScan, _: str) -> np.ndarray:
    from scanprep import register

    return register(data.template, item.scan, item.landmarks(data, "10")).mesh.vertices


def ours_automatic(data: RealData, item: TestScan, _: str) -> np.ndarray:
    from scanprep import find_correspondences, register

    found = find_correspondences(data.template, item.scan)
    return register(data.template, item.scan, correspondences=found).mesh.vertices


def _nricp(data: RealData, item: TestScan, name: str) -> np.ndarray:
    need("trimesh")
    need("rtree")
    import trimesh

    vertices, points = item.landmarks(data, "10") or (None, None)
    source = trimesh.Trimesh(placed(data, item), data.template.faces, process=False)
    target = trimesh.Trimesh(item.scan.vertices, item.scan.faces, process=False)
    return np.asarray(getattr(trimesh.registration, name)(source, target, vertices, points))


def nricp_amberg(data: RealData, item: TestScan, _: str) -> np.ndarray:
    return _nricp(data, item, "nricp_amberg")


def nricp_sumner(data: RealData, item: TestScan, _: str) -> np.ndarray:
    return _nricp(data, item, "nricp_sumner")


def geodesic_drift(data: RealData, item: TestScan, bcpd: str) -> np.ndarray:
    """Bayesian coherent point drift with the geodesic kernel of the template's triangles, accelerated."""
    if not bcpd or not Path(bcpd).exists():
        raise MissingError("bcpd")
    with tempfile.TemporaryDirectory() as folder:
        np.savetxt(Path(folder, "x.txt"), item.scan.vertices)
        np.savetxt(Path(folder, "y.txt"), placed(data, item))
        np.savetxt(Path(folder, "f.txt"), data.template.faces + 1, fmt="%d", delimiter="\t")
        subprocess.run([str(Path(bcpd).resolve()), "-x", "x.txt", "-y", "y.txt", "-Ggeodesic,0.2,f.txt",
                        "-w0.05", "-b1.2", "-l10", "-g0.1", "-A", "-n300", "-c1e-6", "-ux", "-DB,5000,0.02"],
                       cwd=folder, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        return np.loadtxt(Path(folder, "output_y.txt"))[:, :3]


def classic_drift(data: RealData, item: TestScan, _: str) -> np.ndarray:
    """Deformable coherent point drift between samples of both, carried to all vertices."""
    need("pycpd")
    from pycpd import DeformableRegistration

    from scanprep.geometry.farthest_points import farthest_points

    start = placed(data, item)
    mine = farthest_points(start, 2000)
    theirs = item.scan.vertices[np.random.default_rng(0).permutation(len(item.scan.vertices))[:4000]]
    moved, _ = DeformableRegistration(X=theirs, Y=start[mine], alpha=2, beta=0.2, max_iterations=100).register()
    distance, near = cKDTree(start[mine]).query(start, 3)
    share = 1 / np.maximum(distance, 1e-9)
    return start + np.einsum("nk,nkd->nd", share / share.sum(axis=1, keepdims=True), (moved - start[mine])[near])


def meshmonk_pyramid(data: RealData, item: TestScan, _: str) -> np.ndarray:
    """MeshMonk from coarse to fine; its width of smoothing is meant for millimetres."""
    need("meshmonk")
    import meshmonk

    meshmonk.set_log_level("error")
    start, scan = data.template.with_vertices(1e3 * placed(data, item)), item.scan
    found = meshmonk.pyramid_register(
        floating_features=meshmonk.features_from_vertices(start.vertices, start.faces), floating_faces=start.faces,
        target_features=meshmonk.features_from_vertices(1e3 * scan.vertices, scan.faces), target_faces=scan.faces)
    return found.aligned_vertices.astype(float) / 1e3


def functional_maps(data: RealData, item: TestScan, _: str) -> np.ndarray:
    need("pyFM")
    from pyFM.functional import FunctionalMapping
    from pyFM.mesh import TriMesh

    vertices, points = item.landmarks(data, "10") or (np.zeros(0, int), np.zeros((0, 3)))
    surface = item.merged()
    theirs = cKDTree(surface.vertices).query(points)[1]
    model = FunctionalMapping(TriMesh(data.template.vertices, data.template.faces),
                              TriMesh(surface.vertices, surface.faces))
    model.preprocess(n_descr=100, descr_type="WKS", subsample_step=5, k_process=130,
                     landmarks=np.stack([vertices, theirs], axis=1))
    model.fit(K=(30, 30))
    refined = model.zoomout_refine(nit=18, step=5)
    # which vertex of the scan lies where each vertex of the template goes
    return surface.vertices[_to_scan(model, refined)]


def _to_scan(model, refined: np.ndarray) -> np.ndarray:  # type: ignore[no-untyped-def]
    """For every template vertex the scan vertex with the nearest spectral embedding."""
    k2, k1 = refined.shape
    return cKDTree(model.mesh2.eigenvectors[:, :k2]).query(model.mesh1.eigenvectors[:, :k1] @ refined.T)[1]


TOOLS: dict[str, Callable[[RealData, TestScan, str], np.ndarray]] = {
    "scapekit, 10 landmarks": ours, "scapekit, none": ours_automatic, "trimesh nricp_amberg": nricp_amberg,
    "trimesh nricp_sumner": nricp_sumner, "BCPD geodesic, accelerated": geodesic_drift,
    "CPD 2,000 x 4,000 points": classic_drift, "MeshMonk pyramid": meshmonk_pyramid,
    "functional maps + ZoomOut": functional_maps}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bodies", default="pose2,pose22,pose47,pose67,man52")
    parser.add_argument("--only", default="", help="part of a tool's name")
    parser.add_argument("--bcpd", default=shutil.which("bcpd") or "",
                        help="program of Bayesian coherent point drift; else the one on the path")
    parser.add_argument("--limit", type=float, default=1800.0, help="seconds after which a tool is stopped")
    parser.add_argument("-o", "--output", default="peers.json")
    args = parser.parse_args()
    data = load_real()
    template = replace(data, poses=data.poses[:0], shapes=data.shapes[:0])           # what a tool may know
    rows: list[dict[str, object]] = []
    for body in args.bodies.split(","):
        kind = body.rstrip("0123456789")
        item = test_scan(data, kind, int(body.removeprefix(kind)))
        for name, tool in TOOLS.items():
            if args.only not in name:
                continue
            done = alone(args.limit, tool, template, item, args.bcpd)
            row: dict[str, object] = {"body": item.name, "tool": name, **done.why}
            if not done.why:
                row |= {"seconds": done.seconds, "cpu_s": done.cpu_s, **errors(done.value, item)}
            rows.append(row)
            print(" ".join(f"{k}={v:.2f}" if isinstance(v, float) else str(v) for k, v in row.items()), flush=True)
            write_report(args.output, {"machine": machine(), "rows": rows})


if __name__ == "__main__":
    main()
