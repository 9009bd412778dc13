"""The figures that come first in BENCHMARKS.md, each read from the result of one benchmark; the README quotes some."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

Lines = list[tuple[str, str]]        # what was measured, and one figure with its unit


def _mm(value: float) -> str:
    return f"{value:.1f} mm"


def registration(report: dict) -> Lines:
    pose, man = (report["summary"][kind] for kind in ("pose", "man"))
    poses = sum(r["scan"].startswith("pose") for r in report["rows"])
    return [(f"scans of a man in {poses} poses registered with 10 landmarks: vertices off", _mm(pose["all_mm"])),
            ("scans of other men, registered with 10 landmarks: vertices off", _mm(man["all_mm"])),
            (f"the {poses} poses: distance to the true surface", _mm(pose["surface_seen_mm"])),
            ("the other men: distance to the true surface", _mm(man["surface_seen_mm"])),
            ("time to register a scan", f"{np.mean([r['cpu_s'] for r in report['rows']]):.0f} s")]


def poses(report: dict) -> Lines:
    kinds = {"SCAPE": "SCAPE, linear", "skinning with corrective shapes": "LBS + linear correctives"}
    return [(f"known man in poses never seen ({len(report['folds'])} of 5 folds), {name}",
             _mm(np.concatenate([fold["kinds"][kind]["error_mm"] for fold in report["folds"].values()]).mean()))
            for name, kind in kinds.items()]


def learning(report: dict) -> Lines:
    count, command = report["people"][0]["people"], report["command"]
    people = [(f"{count} men never seen, model of 182 men with {row['components']} shape components",
               _mm(row["mean_mm"])) for row in report["people"]]
    whole = "`scape learn` from 71 poses and 182 men, choice of parts included, two cores"
    return [*people, (f"{whole}: by the clock", f"{command['wall_s']:.0f} s"),
            (f"{whole}: of the processor", f"{command['cpu_s']:.0f} s"),
            ("bodies of a fixed person computed a second", f"{report['fast_path']['float64_meshes_per_s']:,.0f}")]


def folder(report: dict) -> Lines:
    most = max(report["rows"], key=lambda row: row["scans"])
    what = f"`scape prep run`, {most['scans']:,} scans of {most['triangles']:,} triangles, {most['workers']} workers"
    return [(f"{what}: memory", f"{most['parent_mb']:.0f} MB"),
            (f"{what}: memory of a worker", f"{most['worker_mb']:.0f} MB")]


def _seen_and_unseen(what: str, mean: dict) -> Lines:
    return [(f"{what}: {where} surface", _mm(mean[f"completed_{where}_mm"])) for where in ("seen", "unseen")]


def half_views(report: dict) -> Lines:
    return _seen_and_unseen(f"half view of the known man, {len(report['rows'])} poses never seen, 7 landmarks",
                            report["mean"])


def half_people(report: dict) -> Lines:
    seconds, what = [row["cpu_seconds"] for row in report["rows"]], f"half view of {len(report['rows'])} men never seen"
    return [*_seen_and_unseen(what, report["mean"]), (f"{what}: time, median", f"{np.median(seconds):.1f} s"),
            (f"{what}: time of nine in ten, at most", f"{np.quantile(seconds, 0.9):.1f} s"),
            (f"{what}: time of the slowest", f"{max(seconds):.1f} s")]


def few_scans(report: dict) -> Lines:
    return [(f"half views, model of 8 poses and 10 men, {who} men: unseen surface",
             _mm(report["mean"][f"{who}_unseen_mm"])) for who in ("known", "unknown")]


def depth_camera(report: dict) -> Lines:
    mean, what = report["mean"], "depth picture of a dressed man, cut off, with `--up`"
    right = mean["up_right"] * mean["up_cases"]
    return [(f"{what}: surface within the picture", _mm(mean["up_within_median_mm"])),
            (f"{what}: pictures with all seen parts in their place", f"{right:.0f} of {mean['up_cases']:.0f}")]


def markers(report: dict) -> Lines:
    return [("56 markers, known man: whole surface", _mm(report["mean"]["surface_mm"]))]


def people(report: dict) -> Lines:
    line = next(r for r in report["mean"] if r["markers"] == 47)
    return [(f"shape of {line['men']} men never seen from 47 markers in 12 frames", _mm(line["error_mm"]))]


def tracking(report: dict) -> Lines:
    run, what = report["runs"]["unknown shape"], "walk of a synthetic person of unknown shape from two depth cameras"
    return [(f"{what}: distance to the true surface", _mm(run["surface"])),
            (f"{what}: frames a second", f"{1 / run['CPU s a frame']:.1f}")]


def mosh(report: dict) -> Lines:
    synthetic = {"walk.c3d": "a simulated walk", "faulty.c3d": "a simulated walk with faults"}
    lines, most = list[tuple[str, str]](), max(row["peak_MiB"] for row in report["files"])
    for row in report["files"]:
        name = synthetic.get(row["file"], f"recording {row['file'].removesuffix('.c3d')}")
        what = f"`scape mosh` with soft tissue, {name} of {row['frames']:,} frames"
        lines += [(f"{what}: frames a second, pages too", f"{row['frames_per_s_all']:.0f}"),
                  (f"{what}: frames a second, files alone", f"{row['frames_per_s']:.0f}")]
    return [*lines, ("`scape mosh`, the same: most memory", f"{most:,.0f} MiB")]


def recordings(report: dict) -> Lines:
    mean = {name: both["of_files"] for name, both in report["mean"].items()}
    kinds = {"markers left out, places calibrated": "calibrated",
             "markers left out, places as in the layout": "held_out", "markers used": "observed"}
    return [(f"four recordings of actors, soft tissue too: {what}", _mm(mean[f"soft_{name}_mm"]))
            for what, name in kinds.items()]


def peer_markers(report: dict) -> Lines:
    lines = list[tuple[str, str]]()
    for tool in dict.fromkeys(row["tool"] for row in report["rows"]):
        used, calibrated = np.mean([[row["used_mm"], row["held_out_mm"]] for row in report["rows"]
                                    if row["tool"] == tool and "used_mm" in row], axis=0)
        lines += [(f"the same with fixed shape, {tool}: markers used", _mm(used)),
                  (f"the same with fixed shape, {tool}: markers left out, calibrated", _mm(calibrated))]
    return lines


def soft_tissue(report: dict) -> Lines:
    lines = list[tuple[str, str]]()
    for row in report["rows"]:
        if row["where"] == "spacing below 12 cm":
            what = f"soft tissue of 10 mm, 2 to 15 Hz, {row['markers']} markers nearer than 12 cm"
            lines += [(f"{what}: movement found", f"{row['amplitude']:.0%}"),
                      (f"{what}: phase error", f"{row['phase_deg']:.0f}°")]
    return lines


def statues(report: dict) -> Lines:
    finest = [row["levels"][-1]["mean_mm"] for row in report["rows"]]
    return [(f"{len(finest)} scans as statues, 400,000 triangles: distance to the scan, {which}", f"{value:.2f} mm")
            for which, value in (("best", min(finest)), ("worst", max(finest)))]


def measures(report: dict) -> Lines:
    return [(f"girths of synthetic people, {row['how']}", _mm(row["mean_mm"]))
            for row in report["means"] if row["girth"]]


HEADLINES: dict[str, Callable[[dict], Lines]] = {
    "registration_10": registration, "folder_of_1000": folder, "scape_5fold": poses, "learning": learning,
    "half_views": half_views, "half_people": half_people, "few_scans": few_scans, "depth_camera": depth_camera,
    "tracking": tracking, "markers": markers, "mosh_people": people, "mosh_c3d": recordings,
    "peer_markers": peer_markers, "mosh_soft": soft_tissue, "mosh_speed": mosh, "mosh_memory": mosh,
    "measures": measures, "statues": statues}

# benchmark -> how many of its lines, from the first on, the README has
IN_README = {"learning": 1, "mosh_speed": 1, "scape_5fold": 1, "registration_10": 2, "half_people": 3, "tracking": 1,
             "mosh_people": 1, "mosh_c3d": 2}
