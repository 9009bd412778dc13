"""The fit of the control mesh to a scan: which way gives the better control mesh, and the paper's Fig. 6 and 7.

    SCAPEKIT_DATA=... python tests/benchmarks/statue_fit.py [--men 12,...] [--poses 29,...] [-o FILE]
        [--picture FILE]

Every scan is a real body subdivided once (50,000 vertices), the start a registration that has not followed the details
(its graph stages only). "register" is the whole registration, "settle" its last pass from the same start. What we lose
at: registration meets larger differences of pose; a hand with fingers is not one-to-one with a mitten.
"""
from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from protocols import data_folder, load_real, machine, write_report
from scanned_shapes import distortion
from scipy.sparse import csc_array, diags_array, eye_array

from model.statue.control.files import humanoid
from model.statue.registration.local_shape import LocalShape, local_shape
from model.statue.registration.surface_fit import fit_surface
from scanprep.alignment.icp import align_landmarks, apply
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sparse import Factored, conjugate_gradients
from scanprep.geometry.surface import Surface
from scanprep.geometry.target import target_of
from scanprep.registration.final_fit import final_fit
from scanprep.registration.folds import find_inverted_triangles, unfold
from scanprep.registration.nonrigid import register
from scanprep.registration.schedule import RegistrationConfig

# Landmarks of the control model and their names on the real bodies.
NAMES = {"right toe": "toe in right leg", "left toe": "toe in left leg", "right knee": "knee in right leg",
         "left knee": "knee in left leg", "right middle finger": "middle finger right hand",
         "left middle finger": "middle finger left hand", "right elbow outside": "elbow (outside) right arm",
         "left elbow outside": "elbow (outside) left arm", "top of head": "top of head", "crotch": "between two legs",
         "right heel": "heel in right leg", "left heel": "heel in left leg", "nose tip": "tip of nose",
         "right shoulder": "shoulder (upper) right side", "left shoulder": "shoulder (upper) left side",
         "right waist": "waist right side", "left waist": "waist left side", "neck back": "neck (back)"}
WAYS = {"ours": False, "published, their slack": True}       # whether the paper's steps are taken


def quality(rest: Mesh, x: np.ndarray, scan: Mesh) -> dict[str, float]:
    """Misfit both ways, distortion, inverted triangles, and the share of the scan that turns away from the mesh."""
    mesh, surface = rest.with_vertices(x), Surface(scan)
    points, face, _ = scan.sample(30_000, np.random.default_rng(0))
    found, own = Surface(mesh).closest(points), surface.closest(x).distances
    normals = np.einsum("pc,pcd->pd", found.bary, mesh.vertex_normals[mesh.faces[found.faces]])
    against = np.einsum("pd,pd->p", normals, scan.face_normals[face]) <= 0
    return {"vertices_rms_mm": 1e3 * np.sqrt(np.mean(own**2)), "vertices_p99_mm": 1e3 * np.quantile(own, 0.99),
            "vertices_max_mm": 1e3 * own.max(), "scan_rms_mm": 1e3 * np.sqrt(np.mean(found.distances**2)),
            "scan_max_mm": 1e3 * found.distances.max(), "distortion": distortion(rest, x),
            "inverted": float(find_inverted_triangles(rest, x).sum()), "scan_against_percent": 100 * against.mean()}


def timed(make: Callable[[], np.ndarray]) -> tuple[np.ndarray, dict[str, float]]:
    """What was made, and the seconds it took."""
    wall, cpu = time.perf_counter(), time.process_time()
    made = make()
    return made, {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall}


def fitted(rest: Mesh, start: np.ndarray, scan: Mesh, published: bool) -> np.ndarray:
    """Vertices of one fit."""
    return fit_surface(rest, start, scan, published).vertices


def fits(name: str, body: Mesh, marks: tuple[np.ndarray, np.ndarray]) -> list[dict[str, object]]:
    """Every way to fit the humanoid to one body."""
    import igl

    rest = humanoid().mesh
    scan = Mesh(*igl.loop(body.vertices, body.faces, 1))
    start = register(rest, body, marks, RegistrationConfig(final_fit=False)).mesh.vertices

    def finally_fitted() -> np.ndarray:
        x = final_fit(rest, start, target_of(scan)).vertices
        return unfold(rest, x)

    made = {"start": (start, {}), "register": timed(lambda: register(rest, scan, marks).mesh.vertices),
            "final fit": timed(finally_fitted)}
    for way, published in WAYS.items():
        made[way] = timed(partial(fitted, rest, start, scan, published))
    return [{"scan": name, "way": way, **quality(rest, x, scan), **seconds} for way, (x, seconds) in made.items()]


def restored(shape: LocalShape, x: np.ndarray, steps: int) -> np.ndarray:
    """Gauss-Newton on the exact energy of the local shape alone."""
    w = shape.weights[:, None]
    K = shape.plane.T @ diags_array(shape.weights) @ shape.plane
    nearly = Factored(csc_array(K + 1e-6 * eye_array(shape.count)))
    for _ in range(steps):
        curved = partial(_curved, shape, w, x)
        x = x + conjugate_gradients(curved, -shape.gradient(x) / 2, nearly.solve, 300)
    return x


def _curved(shape: LocalShape, w: np.ndarray, x: np.ndarray, d: np.ndarray) -> np.ndarray:
    return shape.apply_transpose(x, w * shape.derivative(x, d)) + 1e-9 * d


def figure_6(noise: float = 0.005) -> dict[str, float]:
    """What is left of noise on the humanoid, as a share of it, up to similarity."""
    mesh = humanoid().mesh
    shape, x = local_shape(mesh), mesh.vertices
    noisy = x + noise * np.random.default_rng(1).standard_normal(x.shape)

    def off(y: np.ndarray) -> float:
        return float(np.sqrt(np.mean((apply(align_landmarks(y, x, scale=True).T_target_source, y) - x) ** 2)))

    left, y = {}, noisy
    for k in range(1, 1001):
        y = y + 0.5 * shape.paper_force(y)
        if k in (10, 100, 1000):
            left[f"published_{k}"] = off(y) / off(noisy)
    return {**left, "exact_10": off(restored(shape, noisy, 10)) / off(noisy)}


def figure_7(picture: str | None) -> list[dict[str, object]]:
    """A regular sphere to a head."""
    import igl

    from scanprep.synthetic.people import SyntheticPerson

    person = SyntheticPerson()
    keep = person.part_of_face == person.names.index("head")
    head, _ = person.mesh.submesh(keep)
    v, f = _icosahedron()
    for _ in range(3):
        v, f = igl.upsample(v, f)[:2]
    v = v / np.linalg.norm(v, axis=1, keepdims=True)
    middle = (head.vertices.max(axis=0) + head.vertices.min(axis=0)) / 2
    rest = Mesh(middle + 0.13 * v, f)
    rows: list[dict[str, object]] = []
    meshes = [head]
    for way, published in reversed(WAYS.items()):
        fit = fit_surface(rest, rest.vertices, head, published)
        meshes.append(rest.with_vertices(fit.vertices))
        rows.append({"way": way, **quality(rest, fit.vertices, head)})
    if picture:
        from scanprep.pictures.shading import Camera, Solid, contact_sheet, render, save_png

        camera = Camera.around(head, azimuth=-60)
        save_png(picture, contact_sheet([render(Solid(m, smooth=False), camera, 420, 520) for m in meshes],
                                        ["head", *reversed(WAYS)]))
    return rows


def _icosahedron() -> tuple[np.ndarray, np.ndarray]:
    """Corners and triangles."""
    from scipy.spatial import ConvexHull

    g = (1 + 5**0.5) / 2
    v = np.array([[0, a, b * g] for a in (-1, 1) for b in (-1, 1)], dtype=float)
    v = np.vstack([np.roll(v, k, axis=1) for k in range(3)])
    f = ConvexHull(v).simplices.astype(np.int64)
    outward = np.einsum("fd,fd->f", np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]), v[f[:, 0]]) > 0
    return v, np.where(outward[:, None], f, f[:, ::-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--men", default="12", help="numbers of SPRING men")
    parser.add_argument("--poses", default="29", help="numbers of SCAPE poses")
    parser.add_argument("-o", "--output", help="write all figures here")
    parser.add_argument("--picture", help="write the picture of Fig. 7 here")
    args = parser.parse_args()
    sixth, seventh = figure_6(), figure_7(args.picture)
    print("Fig. 6, share of the noise that is left:", json.dumps({k: float(f"{v:.3g}") for k, v in sixth.items()}))
    for row in seventh:
        print("Fig. 7:", _line(row))
    data, control = load_real(data_folder()), humanoid()
    rows: list[dict[str, object]] = []
    for name, bodies, numbers in (("man", data.shapes, args.men), ("pose", data.poses, args.poses)):
        for k in (int(number) for number in numbers.split(",") if number):
            body = data.template.with_vertices(bodies[k])
            marks = (np.array([control.landmarks[mine] for mine in NAMES]),
                     body.vertices[[data.landmarks[theirs] for theirs in NAMES.values()]])
            for row in fits(f"{name}{k:03d}", body, marks):
                rows.append(row)
                print(_line(row), flush=True)
    ways = list(dict.fromkeys(str(row["way"]) for row in rows))
    numbers_of = [key for key in rows[-1] if key not in ("scan", "way")]
    means = {way: {key: float(np.mean([row.get(key, 0) for row in rows if row["way"] == way])) for key in numbers_of}
             for way in ways}
    for way, figures in means.items():
        print("mean:", _line({"way": way, **figures}))
    if args.output:
        write_report(Path(args.output), {"machine": machine(), "figure_6": sixth, "figure_7": seventh, "means": means,
                                       "rows": rows})


def _line(row: dict[str, object]) -> str:
    return " ".join(f"{value:.3g}" if isinstance(value, float) else str(value) for value in row.values())


if __name__ == "__main__":
    main()
