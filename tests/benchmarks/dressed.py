"""Bodies found inside of clothes, hair and bags: known naked bodies that are dressed, scanned and completed.

    SCAPEKIT_DATA=... python tests/benchmarks/dressed.py -o dressed.json [--kinds skirt coat ...] [--people N]
        [--half] [--seed S] [--naked] [--each K] [--bodies FOLDER] [--pictures DIR]

The true bodies are SPRING men, completed naked from four views; without `SCAPEKIT_DATA` they are synthetic men and
women who stand relaxed. Each wears every kind of `dressing.KINDS`, or with `--each` K of them in turn. Scans are from
36 cameras, with `--half` from six in front. `--naked` adds each person without clothes. `--bodies` keeps the true
bodies, FOLDER/NAME/completed.ply, and takes those that lie there.

*found* says whether anything was taken for hair or clothes; *cloth* is the share of the points more than 8 mm out of
the true body that was marked, *skin* that of the others. Distances are from true vertices to the completed surface:
*mean*, and of each part the 95th percentile, of which the *worst* is given. Girths are compared with those of the true
body; *told* is the error that the result expects itself.
"""
from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from dressing import KINDS, dress, facing, scan_dressed
from protocols import load_real, machine, write_report

from completion.partial.completion import Completion, complete
from model import find_tapes, load_built_in_model, measure
from scanprep.geometry.files import PointCloud, read_mesh, write_mesh
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface

MODEL = load_built_in_model()
TAPES = find_tapes(MODEL.template, MODEL.info["landmarks"])
GIRTHS = ("waist_girth", "hip_girth", "chest_girth")
MEASURES = (*GIRTHS, "stature")
CLOTH = 0.008                        # metres out of the true body: clothes, whatever the noise of 1 mm
BEYOND = 50.0                        # mm: a part that is off by more is wrong
TOLD = (5, 10, 20, 50, 1000)         # mm: upper limits of the classes of told errors


def true_bodies(count: int, folder: Path | None) -> Iterator[tuple[str, Mesh]]:
    """Name and naked body of each person, in the triangles of the built-in model; kept in a folder, if there is one."""
    scans = real_scans() if os.environ.get("SCAPEKIT_DATA") else synthetic_scans()
    for name, scan in (next(scans) for _ in range(count)):
        path = folder / name / "completed.ply" if folder else None
        if path is not None and path.exists():
            yield name, read_mesh(path, unit="m")
            continue
        body = complete(MODEL, scan(), masked=np.zeros(len(scan().vertices), dtype=bool)).completed
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_mesh(path, body)
        yield name, body


def real_scans() -> Iterator[tuple[str, Any]]:
    """Name and scan of SPRING men, in a random order that is always the same; scans are made when called."""
    from functools import cache

    from scans import test_scan

    data = load_real()
    for i in np.random.default_rng(0).permutation(len(data.shapes)):
        yield f"man_{i:03d}", cache(lambda i=i: test_scan(data, "man", i).scan)


def synthetic_scans() -> Iterator[tuple[str, Any]]:
    """Name and scan of men and women who stand relaxed, lean and heavy ones in turn."""
    from functools import cache

    from scanprep.synthetic.people import BodyShape, SyntheticPerson, compose_pose
    from scanprep.synthetic.scanner import scan

    def make(i: int) -> Mesh:
        rng = np.random.default_rng([17, i])
        sex: Any = ("male", "female")[i % 2]
        weight = (-1.3, 0.0, 1.5, 2.5)[i // 2 % 4] + rng.uniform(-0.3, 0.3)
        person = SyntheticPerson(BodyShape.like(sex, float(rng.normal(1.76 if sex == "male" else 1.63, 0.06)), weight))
        arms = [{"direction": (rng.uniform(0.3, 0.55), rng.uniform(-0.05, 0.15), -1.0), "elbow": rng.uniform(0, 15)}
                for _ in range(2)]
        legs = [{"direction": (rng.uniform(0.08, 0.18), 0.0, -1.0)} for _ in range(2)]
        pose = compose_pose(*arms, *legs, back={"bend": rng.uniform(-2, 4)}, neck={"nod": rng.uniform(-5, 8)})
        return scan(Mesh(person.in_pose(pose), person.mesh.faces), rng=rng).merged

    i = 0
    while True:
        yield f"synthetic_{i:03d}", cache(lambda i=i: make(i))
        i += 1


def put_on(body: Mesh, kind: str, rng: np.random.Generator, half: bool) -> PointCloud:
    """Dress a body and scan it; the kind "naked" leaves it as it is."""
    mesh = body if kind == "naked" else dress(body, MODEL.skeleton, kind, rng)
    return scan_dressed(mesh, rng, half, facing(body, MODEL.skeleton))


def compare(body: Mesh, cloud: PointCloud, done: Completion) -> dict[str, Any]:
    """Figures of one completion against the true body: millimetres, and shares of points."""
    # what was taken for hair and clothes
    out_of = Surface(body).closest(cloud.points).distances > CLOTH
    marked = np.zeros(len(out_of), dtype=bool) if done.not_skin is None else done.not_skin
    row: dict[str, Any] = {"found": done.not_skin is not None, "worn": list(done.worn),
                           "verdict": done.judgement.verdict, "explained": done.explained,
                           "cloth_marked": marked[out_of].mean() if out_of.any() else 1.0,
                           "skin_marked": marked[~out_of].mean()}
    # the surface, over all and by part
    apart = 1e3 * Surface(done.completed).closest(body.vertices).distances
    part = MODEL.skeleton.part_of_vertex(body)
    far = [float(np.quantile(apart[part == p], 0.95)) for p in range(len(MODEL.skeleton.names))]
    row |= {"mean_mm": apart.mean(), "worst_mm": max(far), "worst_part": MODEL.skeleton.names[int(np.argmax(far))],
            "parts_mm": dict(zip(MODEL.skeleton.names, np.round(far, 1).tolist(), strict=True))}
    # measurements, and the errors that the result expects
    truth = measure(body, TAPES, only=MEASURES).values
    read = measure(done.completed, TAPES, expected_error=done.expected_error, only=MEASURES)
    for name in MEASURES:
        if name in read.values and name in truth:
            row |= {name: 1e3 * truth[name], f"{name}_error": 1e3 * (read.values[name] - truth[name]),
                    f"{name}_told": 1e3 * float(read.errors[name])}
    errors, told = readings([row])
    for times in (1, 2):
        row[f"within_{times}"] = (errors <= times * told).mean()
    return {name: round(float(value), 3) if isinstance(value, float | np.floating) else value
            for name, value in row.items()}


def readings(rows: list[dict[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """Sizes of the errors of all girths (n,) and the told errors (n,), mm."""
    pairs = [(abs(row[f"{name}_error"]), row[f"{name}_told"]) for row in rows for name in GIRTHS
             if f"{name}_error" in row]
    errors, told = np.array(pairs, dtype=float).reshape(-1, 2).T
    return errors, told


def summarise(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Figures of several rows: shares, and medians in mm."""
    def median(name: str) -> float:
        return float(np.median([abs(row[name]) for row in rows if name in row] or [np.nan]))

    errors, told = readings(rows)
    worst = [row["worst_mm"] for row in rows]
    out = {"rows": len(rows), "found": np.mean([row["found"] for row in rows]),
           "good": np.mean([row["verdict"] == "good" for row in rows]), "mean": median("mean_mm")}
    out |= {name.split("_")[0]: median(f"{name}_error") for name in MEASURES}
    out |= {"told": float(np.median(told)), "within_1": (errors <= told).mean(),
            "within_2": (errors <= 2 * told).mean(), "worst": float(np.median(worst)), "worst_max": max(worst),
            "good_but_wrong": sum(row["verdict"] == "good" and row["worst_mm"] > BEYOND for row in rows)}
    return {name: round(float(value), 3) for name, value in out.items()}


def by_told(rows: list[dict[str, Any]]) -> list[dict[str, float]]:
    """How well told errors of girths hold, by their size."""
    errors, told = readings(rows)
    out, low = [], 0.0
    for high in TOLD:
        of = (told >= low) & (told < high)
        if of.any():
            out.append({"told_from": low, "told_below": float(high), "count": int(of.sum()),
                        "share": of.mean(), "error": float(np.median(errors[of])),
                        "within_1": (errors[of] <= told[of]).mean(), "within_2": (errors[of] <= 2 * told[of]).mean()})
        low = high
    return [{name: round(float(value), 3) for name, value in row.items()} for row in out]


def picture(body: Mesh, cloud: PointCloud, done: Completion, path: Path) -> None:
    """The scan with what was marked in blue, the true body, the completed one and its error; front and back."""
    from scanprep.pictures.camera import Camera
    from scanprep.pictures.colors import heat
    from scanprep.pictures.shading import Dots, Solid, render
    from scanprep.pictures.sheets import contact_sheet, save_png

    marked = np.zeros(len(cloud.points), dtype=bool) if done.not_skin is None else done.not_skin
    color = np.where(marked[:, None], [0.25, 0.35, 0.8], [0.8, 0.62, 0.52])
    apart = Surface(body).closest(done.completed.vertices).distances
    shapes: list[Solid | Dots] = [Dots(cloud.points, color, 0.004, coarse=True), Solid(body), Solid(done.completed),
                                  Solid(done.completed, heat(apart, 0, 0.05))]
    ahead = facing(body, MODEL.skeleton)
    azimuth = float(np.degrees(np.arctan2(ahead[1], ahead[0])))
    images = [render([shape], Camera.around([cloud.points, body], azimuth + turn), width=300, height=440)
              for turn in (20, 200) for shape in shapes]
    path.parent.mkdir(parents=True, exist_ok=True)
    save_png(path, contact_sheet(images, ["scan", "true body", "completed", "error, 0 to 5 cm"] * 2, columns=4))


def try_all(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Return a row for each person and kind, and print it."""
    rows, each = [], args.each or len(args.kinds)
    for i, (name, body) in enumerate(true_bodies(args.people, args.bodies)):
        kinds = [args.kinds[(i * each + k) % len(args.kinds)] for k in range(each)]
        for kind in kinds + ["naked"] * args.naked:
            # what a person wears depends on seed, person and kind only
            number = list(KINDS).index(kind) if kind in KINDS else len(KINDS)
            cloud = put_on(body, kind, np.random.default_rng([args.seed, i, number]), args.half)
            start = time.process_time()
            done = complete(MODEL, cloud)
            seconds = round(time.process_time() - start, 2)
            row = {"kind": kind, "person": name, "seconds": seconds, **compare(body, cloud, done)}
            rows.append(row)
            girths = " ".join(f"{what.split('_')[0]} {row[f'{what}_error']:+.0f}~{row[f'{what}_told']:.0f}"
                              for what in MEASURES if f"{what}_error" in row)
            print(f"{kind:18s} {name} {'found' if row['found'] else '-':5s} {row['verdict']:6s} {seconds:5.1f} s  mean "
                  f"{row['mean_mm']:5.1f}  worst {row['worst_mm']:5.1f} {row['worst_part']:17s} {girths}  within "
                  f"{row['within_1']:.2f} {row['within_2']:.2f}  {'; '.join(done.worn)}", flush=True)
            if args.pictures:
                picture(body, cloud, done, args.pictures / f"{kind.replace(', ', '_').replace(' ', '_')}_{name}.png")
    return rows


def print_table(lines: dict[str, dict[str, float]]) -> None:
    """Print lines of the same figures under one head."""
    names = list(next(iter(lines.values())))
    print(" " * 18, *(f"{name:>9s}"[:14] for name in names))
    for label, line in lines.items():
        print(f"{label:18s}", *(f"{line[name]:{max(9, len(name))}.{2 if line[name] % 1 else 0}f}" for name in names))


def main() -> None:
    """Dress, scan and complete everybody, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="dressed.json")
    parser.add_argument("--kinds", nargs="*", choices=list(KINDS), default=list(KINDS), metavar="KIND",
                        help=f"of {'; '.join(KINDS)}")
    parser.add_argument("--people", type=int, default=3)
    parser.add_argument("--each", type=int, help="kinds that each person wears, in turn; by default all")
    parser.add_argument("--half", action="store_true", help="seen from the front only")
    parser.add_argument("--naked", action="store_true", help="also each person without clothes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bodies", type=Path, help="folder that keeps the true bodies")
    parser.add_argument("--pictures", type=Path, help="folder for a picture of each")
    args = parser.parse_args()
    rows = try_all(args)
    worn = [row for row in rows if row["kind"] != "naked"]
    kinds = {kind: summarise([row for row in rows if row["kind"] == kind])
             for kind in dict.fromkeys(row["kind"] for row in rows)}
    kinds |= {"all dressed": summarise(worn)} if worn else {}
    told = by_told(worn or rows)
    print_table(kinds)
    print_table({f"told below {row['told_below']:.0f} mm": row for row in told})
    print(f"good, with a part's 95% beyond {BEYOND:.0f} mm: "
          f"{sum(row['verdict'] == 'good' and row['worst_mm'] > BEYOND for row in rows)} of {len(rows)}")
    write_report(args.output, {"protocol": "dressed people", "half": args.half, "seed": args.seed,
                               "people": args.people, "real": bool(os.environ.get("SCAPEKIT_DATA")),
                               "machine": machine(), "by_kind": kinds, "by_told": told, "rows": rows})


if __name__ == "__main__":
    main()
