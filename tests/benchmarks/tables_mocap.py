"""Tables of BENCHMARKS.md on markers alone: people, recordings, speed, faults, sex, characters, marker sets."""
from __future__ import annotations

import numpy as np
from tables_scans import Rows, table


def people(report: dict) -> str:
    """The error by the number of markers, and two sequences of the same men."""
    rows: Rows = []
    for line in report["mean"]:
        errors = [r["error_mm"] for r in report["rows"] if r["markers"] == line["markers"]]
        rows.append((line["markers"], line["men"], line["error_mm"], max(errors), line["residual_mm"], line["moved_mm"],
                     line["beta_rms"], line["cpu_s"]))
    names = ("man", "two_bodies_fitted_mm", "true_from_mean_fitted_mm", "first_share_fitted", "second_share_fitted",
             "two_bodies_mm", "true_from_mean_mm", "first_share", "second_share")
    twice: Rows = [tuple(r[n] for n in names) for r in report["rows"] if "two_bodies_mm" in r]
    return table(("markers", "men", "vertices (mm)", "worst man (mm)", "markers (mm)", "markers moved (mm)",
                  "betas (RMS)", "time (s CPU)"), rows) + "\n\n" + table(
        ("man moved twice", "two bodies, poses fitted (mm)", "true body from mean person (mm)",
         "first body's share of that", "second's", "two bodies at rest (mm)", "true body from mean person at rest (mm)",
         "first body's share of that", "second's"), twice)


def recordings(report: dict) -> str:
    """Observed and held-out markers of real files."""
    names = ("held_out_mm", "soft_held_out_mm", "calibrated_mm", "soft_calibrated_mm")
    rows: Rows = [(f["file"], f["frames"], f["observed_mm"], f.get("soft_observed_mm", ""), f["p95_mm"],
                   f["worst_frame_mm"], *(f.get(name, "") for name in names),
                   ", ".join(f"{label} {far:.0f}" for label, far in f["each_mm"].items()), f["beta_rms"])
                  for f in report["files"]]
    mean = {name: both["of_files"] for name, both in report["mean"].items()}
    rows.append(("mean", "", mean["observed_mm"], mean.get("soft_observed_mm", ""), "", "",
                 *(mean.get(name, "") for name in names), "", ""))
    return table(("file", "frames", "markers, fixed shape (mm)", "with soft tissue (mm)", "p95 (mm)",
                  "worst frame (mm)", "held out, plain (mm)", "the same, soft tissue", "calibrated (mm)",
                  "the same, soft tissue", "each, plain (mm)", "betas (RMS)"), rows)


def speed(report: dict) -> str:
    """Where the processor's time went, and how much memory it took."""
    stages = ("person", "artefacts", "poses", "soft tissue", "files", "pages")
    rows: Rows = [(f["file"], f["frames"], *(f["stages_cpu_s"].get(stage, "") for stage in stages), f["cpu_s"],
                   f["wall_s"], f["frames_per_s"], f["frames_per_s_all"], f["peak_MiB"], f["fixed shape"],
                   f["soft tissue"]) for f in report["files"]]
    return table(("file", "frames", *(f"{stage} (s CPU)" for stage in stages), "all (s CPU)", "all (s)",
                  "frames/s CPU, without pages", "with pages", "peak (MiB)", "fixed shape (mm)", "soft tissue (mm)"),
                 rows)


def soft_tissue(report: dict) -> str:
    """Bumps by their markers, and the whole skin."""
    names = {"markers": "markers", "where": "bumps", "bumps": "number", "amplitude": "amplitude found",
             "least": "least", "with_pose": "with what the pose moves", "phase_deg": "phase off (degrees)",
             "betas_share": "energy that betas could have"}
    skins = {"markers": "markers", "where": "skin", "fixed_mm": "fixed shape (mm)", "soft_mm": "with soft tissue (mm)",
             "moved_rms_mm": "moved by soft tissue (RMS, mm)"}
    return "\n\n".join(table(tuple(of.values()), [tuple(row[name] for name in of) for row in report["rows"]
                                                   if ("bumps" in row) == ("bumps" in of)]) for of in (names, skins))


def faults(report: dict) -> str:
    """Exchanges and bad spans, found and there."""
    rows: Rows = []
    for row in report["rows"]:
        for kind in ("random", "close"):
            r = row[kind]
            rows.append((row["case"], f"exchanged, {kind} pairs", r["true"], r["found"], r["right"], row["clean_mm"],
                         r["raw_mm"], r["mended_mm"], r["frames_per_cpu_s"]))
        for kind in ("slipped", "noisy", "stray"):
            r = row[kind]
            rows.append((row["case"], kind, r["true"], r["found"], r["right"], "", "", "", ""))
    return table(("sequence", "fault", "there", "found", "right", "surface, no fault (mm)", "not mended (mm)",
                  "mended (mm)", "all of it, frames/s CPU"), rows)


def worn_elsewhere(report: dict) -> str:
    """Moved and renamed markers, found and there; and alarms without disturbance."""
    names = ("moved", "right", "place_mm", "pairs", "pairs_right", "false", "ratio", "ratio_worst", "shape_mm",
             "surface_mm")
    rows: Rows = [(kind, *("" if values[name] is None else values[name] for name in names))
                  for kind, values in report["total"].items()]
    alarms: Rows = [(f["file"], len(f["alarms"]), len(f["unplaced"]), f["mm"]) for f in report["undisturbed"]]
    return table(("disturbance", "markers moved", "found within 20 mm", "off (mm)", "pairs renamed", "found", "false",
                  "markers untouched, times undisturbed", "worst", "shape, from undisturbed (mm)",
                  "shape and pose (mm)"), rows) + "\n\n" + table(
        ("undisturbed", "alarms", "not placed", "markers (mm)"), alarms)


def sex(report: dict) -> str:
    """Women and men told apart."""
    rows: Rows = []
    for strength in sorted({s["strength"] for s in report["subjects"]}, reverse=True):
        mine = [s for s in report["subjects"] if s["strength"] == strength]
        share = [f"{np.mean([s['right'] for s in mine if s['sex'] * sign > 0]):.0%}" for sign in (-1, 1)]
        rows.append((strength, len(mine), f"{np.mean([s['right'] for s in mine]):.0%}", *share,
                     min(abs(s["margin"]) for s in mine), float(np.mean([s["cpu_s"] for s in mine]))))
    return table(("strength of sex", "people", "right", "of the women", "of the men", "smallest margin",
                  "time (s CPU)"), rows)


def characters(report: dict) -> str:
    """Two figures that make a motion."""
    names = ("figure", "frames", "factor", "joints_inside", "limb_joints_off_mm", "turned_on_person", "turned",
             "turned, smoothed", "deformed_mean", "register_s")
    rows: Rows = [tuple(r[n] for n in names) for r in report["rows"]]
    return table(("figure", "frames", "soft tissue times", "joints inside", "limb joints off (mm)",
                  "turned triangles, person", "figure", "figure, smoothed", "skin stretched", "registering (s CPU)"),
                 rows)


def marker_sets(report: dict) -> str:
    """Greedy sets against full refits and random ones."""
    rows: Rows = []
    for r in report["rows"]:
        if "cpu_s" in r:
            rows.append((r["what"], "", "", "", "", "", r["cpu_s"]))
        elif "random_median_mm" in r:
            bodies = r.get("bodies", report["bodies"])
            rows.append((r["what"], r["count"], bodies, r["greedy_mm"], r["random_median_mm"], r["random_best_mm"], ""))
        else:
            rows.append((r["what"], r["count"], report["bodies"], r.get("full_mm", r["linearised_mm"]), "", "", ""))
    return table(("what", "markers", "bodies", "RMS of all vertices (mm)", "median of 50 random sets (mm)",
                  "best of them (mm)", "time (s CPU)"), rows)


def opensim_angles(report: dict) -> str:
    """Marker errors of both, and how far the angles are apart."""
    errors: Rows = [("OpenSim", report["opensim_rms_mm"], report["opensim_max_mm"]),
                    ("ours", report["ours_rms_mm"], report["ours_max_mm"])]
    rows: Rows = [(name, off, report["rms_degrees_without_offset"][name], report["range_degrees"][name])
                  for name, off in report["rms_degrees"].items()]
    return table(("markers", "RMS (mm)", "largest (mm)"), errors) + "\n\n" + table(
        ("angle", "apart, RMS (°)", "without the mean (°)", "range of ours (°)"), rows)


def other_programs(report: dict) -> str:
    """Every file: how far it is from the exact bodies in each program."""
    programs = report["programs"]
    rows: Rows = [(name, one["size_MB"], *(f"{one[p]['mean_mm']:.3g} / {one[p]['largest_mm']:.3g}" if p in one else ""
                                           for p in programs)) for name, one in report["files"].items()]
    return table(("file", "size (MB)", *(f"{p}, mean / largest (mm)" for p in programs)), rows)


def threads(report: dict) -> str:
    """Whole commands by the number of threads, alone and beside busy processes."""
    names = ("command", "busy", "threads", "wall_s", "cpu_s", "same")
    return table(("command", "busy processes beside", "threads", "wall (s)", "processor (s)", "same files"),
                 [tuple(r[n] for n in names) for r in report["commands"]])


def peer_markers(report: dict) -> str:
    """A row for every tool and recording, and each tool's means."""
    names = ("used_mm", "used_p95_mm", "held_out_mm", "held_out_p95_mm", "acceleration", "cpu_s", "frames_per_cpu_s")
    rows: Rows = [(r["file"], r["tool"], *(r.get(n, "") for n in names)) for r in report["rows"]]
    for tool in dict.fromkeys(r["tool"] for r in report["rows"]):
        done = [r for r in report["rows"] if r["tool"] == tool and "used_mm" in r]
        if done:
            rows.append(("mean", tool, *(float(np.mean([r[n] for r in done])) for n in names[:-1]),
                         sum(r["frames"] for r in done) / sum(r["cpu_s"] for r in done)))
    return table(("file", "tool", "markers (mm)", "p95 (mm)", "held out, calibrated (mm)", "p95 (mm)",
                  "acceleration of joints, RMS (rad/s²)", "time (s CPU)", "frames/s CPU"), rows)


def label_stream(report: dict) -> str:
    """Labels frame by frame, and people who leave and return."""
    rows: Rows = [(r["file"], r["markers"], r["rate"], "20% gone, 5 ghosts" if r["disturbed"] else "", r["frames"],
                   r["right"], r["wrong"], r["ghosts"], r["wrong_doubted"], r["right_doubted"], r["per_cpu_s"],
                   r["per_cpu_s_all"], r["slow"], r["slowest_s"]) for r in report["rows"]]
    back: Rows = []
    for r in report["returns"]:
        each = r["returns"]
        back.append((r["file"], "20% gone, 5 ghosts" if r["disturbed"] else "", len(each),
                     sum(one["frames"] == 0 for one in each), max(one["frames"] for one in each),
                     float(np.median([one["right"] for one in each])), min(one["right"] for one in each),
                     sum(one["labels_away"] for one in each), max(one["search_s"] for one in each)))
    return table(("file", "markers", "rate (Hz)", "disturbed", "frames", "right (%)", "wrong (% of labels)",
                  "ghosts (% of labels)", "doubted of wrong (%)", "of right (%)", "frames/s CPU, median", "all",
                  "frames with a search", "longest (s)"), rows) + "\n\n" + table(
        ("file", "disturbed", "returns", "found in the first frame", "latest found (frames)",
         "right in the second after (%), median", "least", "labels while away", "longest (s)"), back)
