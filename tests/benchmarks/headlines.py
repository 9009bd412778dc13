"""The figures that come first in BENCHMARKS.md, each read from the result of one benchmark; the README quotes some."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

Lines = list[tuple[str, str]]        # what was measured, and the figures


def _mm(*values: float) -> str:
    return ", ".join(f"{value:.1f}" for value in values) + " mm"


def registration(report: dict) -> Lines:
    pose, man = (report["summary"][kind] for kind in ("pose", "man"))
    return [("registration, 10 landmarks, four virtual views: one man in "
             f"{sum(r['scan'].startswith('pose') for r in report['rows'])} poses; other men; both to the surface; time",
             f"{_mm(pose['all_mm'])}; {_mm(man['all_mm'])}; {_mm(pose['surface_seen_mm'], man['surface_seen_mm'])}; "
             f"{np.mean([r['cpu_s'] for r in report['rows']]):.0f} s")]


def poses(report: dict) -> Lines:
    kinds = {kind: np.concatenate([fold["kinds"][kind]["error_mm"] for fold in report["folds"].values()])
             for kind in ("SCAPE, linear", "LBS + linear correctives")}
    folds = len(report["folds"])
    return [(f"known man in poses never seen ({folds} of 5 folds): SCAPE; skinning with corrective shapes",
             "; ".join(_mm(errors.mean()) for errors in kinds.values()))]


def learning(report: dict) -> Lines:
    people = {row["components"]: row["mean_mm"] for row in report["people"]}
    count, components = report["people"][0]["people"], ", ".join(map(str, people))
    command = report["command"]
    return [(f"{count} men never seen, model of 182 men: {components} components", _mm(*people.values())),
            ("`scape learn` from 71 poses and 182 men, choice of parts included, two cores; meshes of a fixed person",
             f"{command['wall_s']:.0f} s by the clock, {command['cpu_s']:.0f} s; "
             f"{report['fast_path']['float64_meshes_per_s']:,.0f} a second")]


def folder(report: dict) -> Lines:
    most = max(report["rows"], key=lambda row: row["scans"])
    what = f"{most['scans']:,} scans of {most['triangles']:,} triangles, {most['workers']} workers"
    return [(f"`scape prep run`, {what}: memory; of a worker", f"{most['parent_mb']:.0f}; {most['worker_mb']:.0f} MB")]


def half_views(report: dict) -> Lines:
    mean = report["mean"]
    return [(f"half view of the known man, {len(report['rows'])} poses never seen, 7 landmarks: seen; unseen surface",
             f"{_mm(mean['completed_seen_mm'])}; {_mm(mean['completed_unseen_mm'])}")]


def half_people(report: dict) -> Lines:
    mean, seconds = report["mean"], [row["cpu_seconds"] for row in report["rows"]]
    return [(f"half view of {len(seconds)} men never seen: seen; unseen surface; time: median, nine of ten, slowest",
             f"{_mm(mean['completed_seen_mm'])}; {_mm(mean['completed_unseen_mm'])}; "
             f"{np.median(seconds):.1f}, {np.quantile(seconds, 0.9):.1f}, {max(seconds):.1f} s")]


def few_scans(report: dict) -> Lines:
    mean = report["mean"]
    return [("half views, model of 8 poses and 10 men, unseen surface: known man; unknown men",
             f"{_mm(mean['known_unseen_mm'])}; {_mm(mean['unknown_unseen_mm'])}")]


def depth_camera(report: dict) -> Lines:
    mean = report["mean"]
    right = mean["up_right"] * mean["up_cases"]
    return [("depth picture of a dressed man, cut off, `--up` told: within the picture; seen parts in their place",
             f"{_mm(mean['up_within_median_mm'])}; {right:.0f} of {mean['up_cases']:.0f}")]


def markers(report: dict) -> Lines:
    return [("56 markers, known man: whole surface", _mm(report["mean"]["surface_mm"]))]


def people(report: dict) -> Lines:
    line = next(r for r in report["mean"] if r["markers"] == 47)
    return [(f"shape of {line['men']} men never seen from 47 markers in 12 frames", _mm(line["error_mm"]))]


def tracking(report: dict) -> Lines:
    run = report["runs"]["unknown shape"]
    return [("walk of a synthetic person from two depth cameras, unknown shape: distance to the true surface; frames",
             f"{_mm(run['surface'])}; {1 / run['CPU s a frame']:.1f} a second")]


def mosh(report: dict) -> Lines:
    synthetic = {"walk.c3d": "a simulated walk", "faulty.c3d": "the same with faults"}
    files = [f"{synthetic.get(row['file'], row['file'].removesuffix('.c3d'))}, {row['frames']:,} frames"
             for row in report["files"]]
    return [(f"`scape mosh` with soft tissue and files; with pages too: {'; '.join(files)}; most memory",
             "; ".join(f"{row['frames_per_s']:.0f}, {row['frames_per_s_all']:.0f}" for row in report["files"])
             + f" frames a second; {max(row['peak_MiB'] for row in report['files']):,.0f} MiB")]


def recordings(report: dict) -> Lines:
    mean = {name: both["of_files"] for name, both in report["mean"].items()}
    return [("four recordings of actors, soft tissue too: markers used; left out, by the layout's places; "
             "calibrated", "; ".join(_mm(mean[f"soft_{name}_mm"]) for name in ("observed", "held_out", "calibrated")))]


def peer_markers(report: dict) -> Lines:
    tools = list(dict.fromkeys(row["tool"] for row in report["rows"]))
    mean = {tool: np.mean([[row["used_mm"], row["held_out_mm"]] for row in report["rows"] if row["tool"] == tool
                           and "used_mm" in row], axis=0) for tool in tools}
    return [(f"the same with fixed shape, used and calibrated: {'; '.join(tools)}",
             "; ".join(_mm(*figures) for figures in mean.values()))]


def soft_tissue(report: dict) -> Lines:
    rows = [row for row in report["rows"] if row["where"] == "spacing below 12 cm"]
    return [(f"soft tissue of 10 mm, 2 to 15 Hz, markers nearer than 12 cm: found of it, {row['markers']} markers",
             f"{row['amplitude']:.0%}, {row['phase_deg']:.0f}° late or early") for row in rows]


def statues(report: dict) -> Lines:
    finest = [row["levels"][-1]["mean_mm"] for row in report["rows"] if not row["vectors"]]
    return [(f"{len(finest)} scans as statues, 400,000 triangles: distance to the scan",
             f"{min(finest):.2f} to {max(finest):.2f} mm")]


def measures(report: dict) -> Lines:
    girths = {row["how"]: row["mean_mm"] for row in report["means"] if row["girth"]}
    return [(f"girths of synthetic people: {'; '.join(girths)}", "; ".join(_mm(value) for value in girths.values()))]


HEADLINES: dict[str, Callable[[dict], Lines]] = {
    "registration_10": registration, "folder_of_1000": folder, "scape_5fold": poses, "learning": learning,
    "half_views": half_views, "half_people": half_people, "few_scans": few_scans, "depth_camera": depth_camera,
    "tracking": tracking, "markers": markers, "mosh_people": people, "mosh_c3d": recordings,
    "peer_markers": peer_markers, "mosh_soft": soft_tissue, "mosh_speed": mosh, "mosh_memory": mosh,
    "measures": measures, "statues": statues}

IN_README = ("scape_5fold", "learning", "registration_10", "half_views", "half_people", "tracking", "mosh_people",
             "mosh_c3d", "mosh_speed")
