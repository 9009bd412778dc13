"""Measurements against cuts of the true surface, repeated, and against the errors that they state.

    SCAPEKIT_DATA=... python tests/benchmarks/measures.py --bodies FOLDER [--people 20] [--men 6] [-o FILE]

Bodies are those of `measured_bodies.py`, made in FOLDER where they are missing. The truth of a girth is the convex hull
of a section of the true triangles by trimesh, in the plane that the true vertices carry. Registered people are measured
as they stood; half views and markers in the rest pose, after `repose`, against the person at rest. Stated errors are
those of half views: the constants of `model/measurement/measure.py` were chosen on the even people, the odd ones
are told apart. Men: two registrations of two scans of one man, and two ways of carrying a girth beside ours.
"""
from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np
from measured_bodies import of_man, of_person, somebody
from protocols import load_real, machine, write_report
from scans import HELD_MEN

from model.body import BodyModel
from model.built_in import load_built_in_model
from model.measurement.catalogue import CATALOGUE
from model.measurement.find import find_tapes
from model.measurement.measure import Measurements, laid_on, measure
from model.measurement.section import tape, tape_length
from model.measurement.tapes import Girth, Tapes
from model.posing.transfer import own_body
from scanprep.geometry.mesh import Mesh
from scanprep.synthetic.landmarks import landmarks
from scanprep.synthetic.people import SyntheticPerson

TRUNK = ("chest_girth", "under_bust_girth", "waist_girth", "hip_girth")


def cut(mesh: Mesh, origin: np.ndarray, normal: np.ndarray, all_parts: bool = False) -> float:
    """Tape (metres) around the part of a surface that a plane cuts nearest to a point of it, with trimesh and scipy."""
    import trimesh
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import ConvexHull

    lines = trimesh.intersections.mesh_plane(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), normal, origin)
    points, ends = np.unique(np.round(lines.reshape(-1, 3), 9), axis=0, return_inverse=True)
    a, b = ends.reshape(-1, 2).T
    part = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(len(points),) * 2), directed=False)[1]
    mine = min((points[part == p] for p in np.unique(part) if (part == p).sum() > 3),
               key=lambda some: float(np.linalg.norm(0.5 * (some.min(axis=0) + some.max(axis=0)) - origin)))
    mine = points if all_parts else mine
    flat = mine @ np.linalg.svd(normal[None])[2][1:].T
    return float(ConvexHull(flat).area)                                   # of a polygon in the plane: its perimeter


def true_girths(tapes: Tapes, carriers: np.ndarray, surface: Mesh, axes: np.ndarray) -> dict[str, float]:
    """Girths of a surface in the planes that vertices (N, 3) in the triangles of the tapes carry, metres.

    Those of the trunk without the arms, which the plane of the chest may meet.
    """
    out, part = {}, SyntheticPerson().part_of_face
    trunk = Mesh(surface.vertices, surface.faces[~np.isin(part, [p for p, name in enumerate(SyntheticPerson.names)
                                                                if "arm" in name or "hand" in name])])
    for name, found in tapes.found.items():
        if isinstance(found, Girth):
            normal = axes[0]
            if found.axis is not None:
                normal = found.axis[1].at(carriers) - found.axis[0].at(carriers)
            normal = normal / np.linalg.norm(normal)
            out[name] = cut(trunk if name in TRUNK else surface, found.centre.at(carriers), normal, name in TRUNK)
    return out


@lru_cache(maxsize=1)
def fine_tapes() -> Tapes:
    """On the average person, with all vertices."""
    return find_tapes(SyntheticPerson().mesh, landmarks())


def upright(model: BodyModel, vertices: np.ndarray) -> np.ndarray:
    """A body in the pose of the template."""
    return own_body(model, vertices).subject.vertices(np.zeros((len(model.skeleton.parents), 3)))


def of_somebody(model: BodyModel, tapes: Tapes, folder: Path, k: int) -> Iterator[dict[str, object]]:
    """Rows (girth, how, found and true, stated error) of one synthetic person."""
    person, _ = somebody(k)
    ids, rest = np.array(model.info["people_vertices"]), person.mesh.vertices
    files = {how: dict(np.load(folder / f"person{k:02d}_{how}.npz"))
             for how in ("registered", "known", "unknown", "markers")}
    stood = files["registered"]
    true_axes = fine_tapes().axes @ laid_on(fine_tapes().template, stood["truth"]).T
    yield from rows_of(k, "registered", measure(stood["vertices"], fine_tapes()), true_girths(
        fine_tapes(), stood["truth"], person.mesh.with_vertices(stood["truth"]), true_axes))
    truth = true_girths(tapes, rest[ids], person.mesh, tapes.axes)
    at_rest = measure(rest[ids], tapes, tapes.axes)
    for how in ("registered", "known", "unknown"):
        error = files[how].get("expected_error")
        vertices = stood["vertices"][ids] if how == "registered" else files[how]["vertices"]
        found = measure(upright(model, vertices), tapes, tapes.axes, error)
        yield from rows_of(k, "registered, reposed" if how == "registered" else how, found, truth, at_rest)
    made = model.vertices(np.zeros((len(model.skeleton.parents), 3)), files["markers"]["betas"])
    yield from rows_of(k, "markers", measure(made, tapes, tapes.axes), truth, at_rest)


def rows_of(k: int, how: str, found: Measurements, girths: dict[str, float], others: Measurements | None = None
            ) -> Iterator[dict[str, object]]:
    """A row for every girth, and for what else was measured of the true vertices."""
    true = {**(others.values if others else {}), **girths}
    for name, value in true.items():
        if name in found.values and CATALOGUE[name].unit == "m":
            yield {"person": k, "how": how, "name": name, "girth": name in girths,
                   "off_mm": 1e3 * (found.values[name] - value),
                   **({"stated_mm": 1e3 * found.errors[name]} if name in found.errors else {})}
        else:
            print(f"person {k}, {how}: no {name}: {found.missing[name]}")


def carried_otherwise(tapes: Tapes, body: np.ndarray, axes: np.ndarray) -> dict[str, dict[str, float]]:
    """Girths (metres) from the template's own points on edges, not cut anew; and from its nearest vertex alone."""
    polygon, vertex = {}, {}
    for name, found in tapes.found.items():
        if not isinstance(found, Girth):
            continue
        points = found.ring.at(body)
        flat = np.linalg.svd(points - points.mean(axis=0))[2][2]
        polygon[name] = tape_length(points[tape(points, flat)])[0]
        nearest = body[found.ring.edges[0, 0]]
        normal = axes[0] if found.axis is None else found.axis[1].at(body) - found.axis[0].at(body)
        normal = normal / np.linalg.norm(normal)
        middle = found.centre.at(body)
        vertex[name] = cut(Mesh(body, tapes.template.faces), middle + (nearest - middle) @ normal * normal, normal)
    return {"points on edges": polygon, "plane of one vertex": vertex}


def of_men(folder: Path, men: list[int]) -> list[dict[str, object]]:
    """Differences between two registrations, by the way that girths are carried."""
    data, rows = load_real(), list[dict[str, object]]()
    tapes = find_tapes(data.template, data.landmarks)
    for man in men:
        both = []
        for turn in range(2):
            body = np.load(folder / f"man{man:03d}_{turn}.npz")["vertices"]
            axes = tapes.axes @ laid_on(tapes.template, body).T
            both.append({"cut anew": measure(body, tapes, axes).values, **carried_otherwise(tapes, body, axes)})
        rows += [{"man": man, "way": way, "name": name, "girth": isinstance(tapes.found[name], Girth),
                  "apart_mm": 1e3 * abs(value - both[1][way][name])}
                 for way, values in both[0].items() for name, value in values.items()
                 if name in both[1][way] and CATALOGUE[name].unit == "m"]
    return rows


def summed(rows: list[dict], by: tuple[str, ...], value: str) -> list[dict[str, object]]:
    """Mean size, mean and largest of a value, over the rows that have the same `by`."""
    out = []
    for key in dict.fromkeys(tuple(row[name] for name in by) for row in rows):
        found = np.array([row[value] for row in rows if tuple(row[name] for name in by) == key])
        out.append({**dict(zip(by, key, strict=True)), "count": len(found), "mean_mm": float(np.abs(found).mean()),
                    "bias_mm": float(found.mean()), "largest_mm": float(np.abs(found).max())})
    return out


def honesty(rows: list[dict], odd: bool) -> list[dict[str, object]]:
    """Of half views: root mean square of true errors over stated ones, and shares within one and two of them."""
    out = []
    for how in ("known", "unknown"):
        for girth in (True, False):
            mine = [r for r in rows if r["how"] == how and r["girth"] == girth and bool(r["person"] % 2) == odd]
            ratio = np.array([abs(r["off_mm"]) / r["stated_mm"] for r in mine])
            out.append({"how": how, "girths": girth, "people": "odd" if odd else "even", "count": len(ratio),
                        "stated_rms_mm": float(np.sqrt(np.mean([r["stated_mm"]**2 for r in mine]))),
                        "true_rms_mm": float(np.sqrt(np.mean([r["off_mm"]**2 for r in mine]))),
                        "within_1": float((ratio <= 1).mean()), "within_2": float((ratio <= 2).mean())})
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bodies", type=Path, required=True)
    parser.add_argument("--people", type=int, default=20)
    parser.add_argument("--men", type=int, default=6)
    parser.add_argument("-o", "--output")
    args = parser.parse_args()
    args.bodies.mkdir(parents=True, exist_ok=True)
    model = load_built_in_model()
    tapes = find_tapes(model.template, model.info["landmarks"])
    rows = list[dict]()
    for k in range(args.people):
        of_person(model, args.bodies, k)
        rows += of_somebody(model, tapes, args.bodies, k)
    for man in HELD_MEN[:args.men]:
        of_man(args.bodies, man)
    men = of_men(args.bodies, list(HELD_MEN[:args.men]))
    report = {"machine": machine(), "means": summed(rows, ("how", "girth"), "off_mm"),
              "by_name": summed(rows, ("how", "name"), "off_mm"),
              "stated": [*honesty(rows, False), *honesty(rows, True)],
              "repeated": summed(men, ("way", "girth"), "apart_mm"),
              "repeated_by_name": summed([r for r in men if r["way"] == "cut anew"], ("name",), "apart_mm")}
    for part in ("by_name", "repeated_by_name", "means", "repeated", "stated"):
        for row in report[part]:
            print("  ".join(f"{name} {value:.2f}" if isinstance(value, float) else f"{name} {value}"
                            for name, value in row.items()))
    if args.output:
        write_report(args.output, report)


if __name__ == "__main__":
    main()
