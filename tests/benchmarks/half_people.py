"""Half views of men of unknown shape, ours against the nearest training body and against plain hole filling.

    SCAPEKIT_DATA=... python tests/benchmarks/half_people.py -m MODEL.npz -o half_people.json [--inner] [--only K ...]
        [--peers] [--pictures DIR] [--set NAME=VALUE ...]

`--inner` takes every fifth of the 182 training men, for tuning, with a model learned from the others; else the 45
held-out men. Each row of the table: *seen* is the mean distance of the seen vertices to the true surface, *unseen*
that of corresponding unseen vertices, *closest* that of the true unseen vertices to the nearest point of the mesh,
which is also defined for meshes without correspondence.

- nearest rigid: of all training bodies, each laid on the landmarks and moved rigidly by closest points (point to
  plane, trimmed), the one nearest to the scan.
- nearest posed: that body then bent at its joints by our own solver: it is made the template of a pose-only model.
- Poisson: screened Poisson of the scan's points and normals, depth 8, everything that it invents is kept. It has no
  vertices in common with the truth: only the distances to the closest point are given.
"""
from __future__ import annotations

import argparse
import dataclasses
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np
from protocols import HalfView, half_view, load_real, machine, spring_split, write_report


def men(count: int, inner: bool) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the men that train and of those that are tried."""
    train, held = spring_split(count)
    if not inner:
        return train, held
    tried = np.arange(len(train)) % 5 == 0
    return train[~tried], train[tried]


def figures(body: Any, mesh: Any, view: HalfView) -> dict[str, float]:
    """Errors of one mesh in the triangles of the body, millimetres."""
    from scanprep.geometry.surface import Surface

    apart = 1e3 * np.linalg.norm(mesh.vertices - body.vertices, axis=1)
    return {"seen_mm": 1e3 * Surface(body).closest(mesh.vertices[view.seen]).distances.mean(),
            "unseen_mm": apart[~view.seen].mean(),
            "closest_mm": 1e3 * Surface(mesh).closest(body.vertices[~view.seen]).distances.mean()}


def nearest(bodies: list[Any], cloud: Any, landmarks: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, int]:
    """The body (N, 3) that comes nearest to the scan when it is moved rigidly, and its place in the list.

    It is the scan that is moved onto each body (`OrientedPoints` of its vertices), and the body with the inverse.
    """
    from scanprep.geometry import rotations

    scan, best = cloud.thin(800), (np.inf, np.zeros(0), -1)
    for i, body in enumerate(bodies):
        R, t = rotations.procrustes(landmarks[1], body.points[landmarks[0]])
        for _ in range(7):
            y, n = scan.points @ R.T + t, scan.normals @ R.T
            found = body.match(y, n, 0.1, 0.6)
            near = found.valid & (found.distances < np.quantile(found.distances[found.valid], 0.9))
            at, to, up = y[near], body.points[found.index[near]], body.normals[found.index[near]]
            rows = np.hstack([np.cross(at, up), up])
            step = np.linalg.lstsq(rows, np.einsum("nd,nd->n", up, to - at), rcond=None)[0]
            turn = rotations.exp(step[:3])
            R, t = turn @ R, turn @ t + step[3:]
        found = body.match(scan.points @ R.T + t, scan.normals @ R.T, 0.1, 0.6)
        apart = np.minimum(found.distances, 0.1).mean()
        if apart < best[0]:
            best = (apart, (body.points - t) @ R, i)
    return best[1], best[2]


def bent(model: Any, vertices: np.ndarray, view: HalfView) -> Any:
    """The nearest body bent at its joints: the predicted mesh of a pose-only model whose template it is."""
    from completion.partial.completion import complete
    from model.shape_space import ShapeSpace

    template = model.template.with_vertices(vertices)
    joints = model.skeleton.joint_regressor(model.template) @ vertices
    skeleton = dataclasses.replace(model.skeleton, joints=joints)
    features = dataclasses.replace(model.pose_space.features, skeleton=skeleton)
    own = dataclasses.replace(model, template=template, skeleton=skeleton,
                              pose_space=dataclasses.replace(model.pose_space, features=features),
                              shape_space=ShapeSpace.empty(len(template.faces)))
    return complete(own.subject(None), view.points, view.landmarks).predicted


def poisson(cloud: Any) -> Any:
    """Screened Poisson of a scan's points and normals; everything that it invents is kept."""
    import open3d

    from scanprep.geometry.mesh import Mesh

    points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points))
    points.normals = open3d.utility.Vector3dVector(cloud.normals)
    mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(points, depth=8)
    return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles))


def tried(args: argparse.Namespace) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """A row for every man, and the settings."""
    from half_views import picture

    from completion.partial.completion import complete
    from completion.partial.settings import CompletionConfig
    from model.files import load_model
    from model.fitting.scan import prepare_scan
    from model.scape import ScapeModel
    from scanprep.geometry.surface import OrientedPoints, Surface

    data, model, config = load_real(), load_model(args.model), CompletionConfig(**dict(args.set or []))
    assert isinstance(model, ScapeModel)
    train, bodies = men(len(data.shapes), args.inner)
    meshes = [data.template.with_vertices(data.shapes[i]) for i in train] if args.peers else []
    others = [OrientedPoints(mesh.vertices, mesh.vertex_normals) for mesh in meshes]
    rows = []
    for k in args.only if args.only is not None else range(len(bodies)):
        body = data.template.with_vertices(data.shapes[bodies[k]])
        view = half_view(body, k, data.landmarks, np.random.default_rng(k))
        start, cpu = time.perf_counter(), time.process_time()
        result = complete(model, view.points, view.landmarks, config)
        row: dict[str, Any] = {"k": k, "seconds": time.perf_counter() - start,
                               "cpu_seconds": time.process_time() - cpu, "rounds": result.iterations,
                               "converged": result.converged, "betas": np.linalg.norm(np.asarray(result.betas))}
        found = {"completed": result.completed, "predicted": result.predicted}
        if args.peers:
            cloud = prepare_scan(view.points)
            rigid, row["nearest"] = nearest(others, cloud, view.landmarks)
            found |= {"nearest_rigid": data.template.with_vertices(rigid), "nearest_posed": bent(model, rigid, view)}
            surface = Surface(poisson(cloud))
            for part, shown in (("seen", view.seen), ("closest", ~view.seen)):
                row[f"poisson_{part}_mm"] = 1e3 * surface.closest(body.vertices[shown]).distances.mean()
        apart = np.linalg.norm(result.completed.vertices - body.vertices, axis=1)[~view.seen]
        assert result.expected_error is not None and result.confidence is not None
        row |= {"expected_mm": 1e3 * np.sqrt((result.expected_error[~view.seen]**2).mean()),
                "rms_mm": 1e3 * np.sqrt((apart**2).mean()),
                "correlation": np.corrcoef(result.expected_error[~view.seen], apart)[0, 1],
                "confidence": result.confidence[~view.seen].mean(), "within": (apart < config.tolerance).mean()}
        for name, mesh in found.items():
            row |= {f"{name}_{what}": value for what, value in figures(body, mesh, view).items()}
        if args.pictures:
            picture(body, view, result, args.pictures / f"person_{k:02d}.png")
        rows.append({name: round(float(value), 3) for name, value in row.items()})
        print(rows[-1], flush=True)
    return rows, dataclasses.asdict(config)


def setting(text: str) -> tuple[str, Any]:
    """A `name=value` of `CompletionConfig`."""
    name, value = text.split("=")
    return name, value if value.isalpha() else float(value) if "." in value or "e" in value else int(value)


def main() -> None:
    """Complete every half view and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="half_people.json")
    parser.add_argument("-m", "--model", help="learned from the training part alone")
    parser.add_argument("--inner", action="store_true", help="the tuning men instead of the held-out ones")
    parser.add_argument("--only", type=int, nargs="*", help="indices in the list of men")
    parser.add_argument("--peers", action="store_true", help="also the nearest training body, and screened Poisson")
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each")
    parser.add_argument("--set", type=setting, nargs="*", help="name=value of CompletionConfig")
    args = parser.parse_args()
    rows, facts = tried(args)
    mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0] if name != "k"}
    for name, value in mean.items():
        print(f"{name:28s} {value:8.2f}")
    write_report(args.output, {"protocol": "half views of people", "inner": args.inner, "machine": machine(),
                               "peak_memory_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
                               "mean": mean, "rows": rows, "config": facts})


if __name__ == "__main__":
    main()
