"""Tables of BENCHMARKS.md on scans: registration, correspondences, skeletons, decimation, holes."""
from __future__ import annotations

from typing import Any

import numpy as np

Rows = list[tuple[Any, ...]]


def table(header: tuple[str, ...], rows: Rows) -> str:
    """A Markdown table; fractions with three significant digits, nothing for what is not a number."""
    def text(value: Any) -> str:
        if not isinstance(value, float):
            return str(value)
        if np.isnan(value):
            return ""
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"

    lines = [header, tuple("---" for _ in header), *rows]
    return "\n".join("| " + " | ".join(map(text, line)) + " |" for line in lines)


def folders(report: dict) -> str:
    """`scape prep run` by the number of scans and workers."""
    names = {"scans": "scans", "triangles": "triangles of each", "workers": "workers", "wall_s": "all (s)",
             "cpu_s": "all (s CPU)", "cpu_s_each": "a scan (s CPU)", "scans_per_hour": "scans an hour",
             "parent_mb": "memory (MB)", "worker_mb": "largest worker (MB)", "page_mb": "page (MB)"}
    return table(tuple(names.values()), [tuple(row[name] for name in names) for row in report["rows"]])


def cluster(report: dict) -> str:
    """Commands on a folder of inputs: memory on the way, and whether a killed worker or process changes anything."""
    header = ("command", "inputs", "all (s)", "memory at a quarter (MB)", "at half", "at the end", "peak", "page (MB)",
              "files compared", "the same")
    return table(header, [(row["command"], row["count"], row["wall_s"], *row["memory_mb"], row["page_mb"],
                           row["compared"], row["same"]) for row in report["rows"]])


def registration(report: dict) -> str:
    """Every scan, and the means of poses and men."""
    names = ("all_mm", "seen_mm", "unseen_mm", "beyond_50mm", "surface_seen_mm", "max_mm", "flipped", "cpu_s")
    rows: Rows = [(r["scan"], *(r[n] for n in names)) for r in report["rows"]]
    for kind, figures in report["summary"].items():
        kinds = {"pose": "poses", "man": "men"}[kind]
        rows.append((f"mean of {kinds}", *(figures[n] for n in names)))
        rows.append((f"{kinds} below 15 mm", f"{figures['below_15mm']:.0%}", *([""] * (len(names) - 1))))
    errors = table(("scan", "all (mm)", "where data (mm)", "elsewhere (mm)", "share beyond 50 mm",
                    "to the true surface, where data (mm)", "worst vertex (mm)", "flipped", "time (s CPU)"), rows)
    return f"{errors}\n\n{verdicts(report)}" if "flags" in report else errors


def verdicts(report: dict) -> str:
    """How often scans that went wrong were told, and what was told."""
    wrong = {"off": "30 mm off on average, or a limb 150 mm", "rolled": "a limb 50 mm off on average"}
    rates = table(("wrong", "scans", "told to be looked at", "of them wrong", "precision", "recall"),
                  [(text, *(report["flags"][name][key] for key in ("wrong", "flagged", "both", "precision", "recall")))
                   for name, text in wrong.items()])
    told: Rows = [(r["scan"], r["worst_limb"], r["worst_limb_mm"], r["verdict"]) for r in report["rows"]
                  if r["verdict"] != "good" or r["worst_limb_mm"] > 50 or r["all_mm"] > 30]
    return f"{rates}\n\n{table(('scan', 'worst limb', 'off (mm)', 'verdict'), told)}" if told else rates


def rolled_limbs(report: dict) -> str:
    """A row for every limb and angle."""
    return table(("limb", "rolled by (degrees)", "bodies", "told", "limb off (mm)"),
                 [tuple(r[n] for n in ("limb", "degrees", "bodies", "told", "limb_off_mm")) for r in report["rows"]])


def peers(report: dict) -> str:
    """A row for every tool: its error on every body, or why there is none, and its time."""
    def cell(row: dict) -> float | str:
        return row.get("all_mm") or next(why for why in ("missing", "stopped", "failed") if why in row)

    bodies = list(dict.fromkeys(r["body"] for r in report["rows"]))
    rows: Rows = []
    for tool in dict.fromkeys(r["tool"] for r in report["rows"]):
        mine = {r["body"]: r for r in report["rows"] if r["tool"] == tool}
        done = [r for r in mine.values() if "all_mm" in r]
        rows.append((tool, *(cell(mine[b]) if b in mine else "" for b in bodies),
                     float(np.mean([r["surface_seen_mm"] for r in done])) if done else "",
                     float(np.mean([r["cpu_s"] for r in done])) if done else ""))
    return table(("mean vertex error (mm)", *bodies, "to the true surface, where data (mm)", "time (s CPU)"), rows)


def correspondences(report: dict) -> str:
    """Pairs of every scan."""
    rows: Rows = [(name, r["count"], r["median_mm"], r["p90_mm"], r["beyond_100mm"], r["flipped"], r["seconds"])
                  for name, r in report["scans"].items()]
    return table(("scan", "pairs", "median (mm)", "90% (mm)", "share beyond 100 mm", "flipped", "time (s CPU)"), rows)


def coregistration(report: dict) -> str:
    """What came out before there was a model, after every round, and without a landmark in the end."""
    names = ("scans", "failed", "all_mm", "median_mm", "worst_mm", "shown_mm", "shown_failed", "surface_seen_mm",
             "cpu_s")
    rows: Rows = [(r["what"], *(r[n] for n in names), sum(e < 15 for e in r["each_mm"].values()))
                  for r in report["rows"]]
    return table(("", "scans", "failed", "mean (mm)", "median (mm)", "worst scan (mm)", "held out, mean (mm)",
                  "held out, failed", "to the true surface, where data (mm)", "time so far (s CPU)",
                  "scans below 15 mm"), rows)


def skeletons(report: dict) -> str:
    """Real poses from several seeds, exactly sixteen parts, synthetic people and animals."""
    out = []
    if "real" in report:
        seeds, exact = report["real"], report["real"]["sixteen"]
        named = [*(f"seed {k}" for k in range(len(seeds["runs"]))), "sixteen asked for"]
        many = zip(named, [*seeds["runs"], exact], [*seeds["agreement_with_first"], ""], [*seeds["same_links"], ""],
                   strict=True)
        out.append(table(
            ("71 real poses", "parts", "left and right, areas differ by", "agreement with seed 0", "same tree", "loops",
             "rigid residual (mm)", "time (s CPU)"),
            [(name, r["parts"], r["left_and_right_differ_in_area"], agreement, same, len(r["loops"]), r["rigid_mm"],
              r["cpu_s"]) for name, r, agreement, same in many]))
    rows: Rows = []
    for kind in ("embedded", "animals"):
        for r in report.get(kind, []):
            what = (f"person, noise {r['noise_mm']:.0f} mm, slide {r['slide_mm']:.0f} mm" if kind == "embedded"
                    else "animal, head " + ("aside" if r["head_aside"] else "straight"))
            joints = list(r["joint_mm"].values())
            rows.append((what, r["parts"], r["adjusted_rand"], float(np.mean(joints)), float(np.max(joints)),
                         r["cpu_s"], *_of_bones(r["dem_bones"])))
    return "\n\n".join([*out, table(("against the truth", "parts", "adjusted Rand", "joints, mean (mm)", "worst (mm)",
                                     "time (s CPU)", "py-dem-bones: Rand", "RMSE (mm)", "time (s CPU)"), rows)])


def _of_bones(found: dict | str) -> tuple[Any, ...]:
    return ("", "", "") if isinstance(found, str) else (found["adjusted_rand"] or "", found["rmse_mm"], found["cpu_s"])


def decimation(report: dict) -> str:
    """One closed body, the same cut open, and a registered set, every tool a row."""
    names = ("cpu_s", "mean_mm", "p95_mm", "to_original_max_mm", "closed", "edge_manifold",
             "vertex_manifold", "intersecting_pairs", "turned_faces")
    header = ("", "time (s CPU)", "mean (mm)", "95% (mm)", "worst (mm)", "closed", "edges manifold",
              "vertices manifold", "pairs that cross", "turned")
    return table(header, [(tool, *(r.get(n, "") for n in names)) for tool, r in report["closed"].items()])


def decimated_set(report: dict) -> str:
    """A registered set in fewer triangles."""
    names = ("poses_mean_mm", "men_mean_mm", "poses_slide_mm", "men_slide_mm", "cpu_s")
    rows: Rows = [(faces, way, *(r[n] for n in names))
                  for faces, ways in report["set"].items() for way, r in ways.items()]
    return table(("", "way", "poses (mm)", "men (mm)", "slide along the skin, poses (mm)", "men (mm)", "time (s CPU)"),
                 rows)


def holes(report: dict) -> str:
    """Six holes of every body, every filler a row, at each size of the holes."""
    out = []
    for size in (name for name in report if name.startswith("holes")):
        rows: Rows = []
        for filler in dict.fromkeys(r["filler"] for r in report[size]):
            mine = [r for r in report[size] if r["filler"] == filler and "truth_mean_mm" in r]
            names = ("patch_mean_mm", "patch_max_mm", "truth_mean_mm", "truth_max_mm")
            known = {n: [r[n] for r in mine if n in r] for n in names}
            rows.append((filler, len(mine), *(float(np.mean(known[n])) if known[n] else "" for n in names),
                         sum(r.get("crossing", 0) for r in mine), sum(r["closed"] and r["manifold"] for r in mine),
                         sum(bool(r.get("untouched")) for r in mine)))
        out.append(table((size, "bodies", "patch to truth, mean (mm)", "worst, mean over bodies (mm)",
                          "truth to patch, mean (mm)", "worst, mean over bodies (mm)", "pairs that cross",
                          "closed and manifold", "rest untouched"), rows))
    return "\n\n".join(out)


def merging(report: dict) -> str:
    """Every way to bring four views together, means over bodies."""
    names = ("bodies", "trusted", "mean_mm", "p95_mm", "max_mm", "back_mean_mm", "back_p95_mm", "seconds")
    rows: Rows = [(way, *(r.get(n, "") for n in names)) for way, r in report["merge_means"].items()]
    return table(("cameras", "bodies", "trusted", "to the truth, mean (mm)", "95% (mm)", "worst (mm)",
                  "back from where data, mean (mm)", "95% (mm)", "time (s CPU)"), rows)


def fronts(report: dict) -> str:
    """How often pictures are not of the front."""
    rows: Rows = [(r["bodies"], r["given"], r["count"], r["median"], r["beyond_30"], r["beyond_60"],
                   ", ".join(map(str, r["which"])) or "none") for r in report["rows"]]
    return table(("bodies", "given as", "count", "off, median (degrees)", "beyond 30", "beyond 60", "which"), rows)


def predicted_landmarks(report: dict) -> str:
    """Every scan, and the median of all landmarks."""
    rows: Rows = [(r["scan"], *(r[n] for n in ("median_mm", "nine_of_ten_mm", "worst_mm", "worst")),
                   f"{r['within_10']:.0%}", r["cpu_s"]) for r in report["rows"]]
    for kind in dict.fromkeys(r["kind"] for r in report["rows"]):
        mine = [r for r in report["rows"] if r["kind"] == kind]
        every = np.concatenate([list(r["apart_mm"].values()) for r in mine])
        rows.append((f"all scans of a {kind}", float(np.median(every)), float(np.quantile(every, 0.9)),
                     float(every.max()), "", f"{(every <= 10).mean():.0%}", float(np.mean([r["cpu_s"] for r in mine]))))
    return table(("scan", "median (mm)", "nine of ten within (mm)", "worst (mm)", "the worst", "within 10 mm",
                  "time (s CPU)"), rows)


def found_landmarks(report: dict) -> str:
    """Groups of landmarks beside their expected errors, and every scan."""
    names = ("count", "median_mm", "mean_mm", "nine_of_ten_mm", "expected_mm")
    groups = table(("landmarks", "count", "median (mm)", "mean (mm)", "nine of ten within (mm)", "expected, mean (mm)",
                    "within once", "within twice"),
                   [(group, *(f[n] for n in names), f"{f['within_once']:.0%}", f"{f['within_twice']:.0%}")
                    for group, f in report["summary"].items()])
    names = ("scan", "verdict", "median_mm", "mean_mm", "worst_mm", "worst", "guessed", "cpu_s")
    scans = table(("scan", "verdict", "median (mm)", "mean (mm)", "worst (mm)", "the worst", "without data",
                   "time (s CPU)"), [tuple(row[n] for n in names) for row in report["rows"]])
    return f"{groups}\n\n{scans}"


def set_alone(report: dict) -> str:
    """What became of a set in all, and of every scan that was registered again or is not good."""
    f = report["summary"]
    summary = table(("scans", "failed at first", "registered again and better", "good at last", "good, beyond 30 mm",
                     "median (mm)", "worst (mm)", "time of registrations (s)"),
                    [(f["scans"], f["first_failed"], f["again"], f["good"], f["good_beyond_30mm"], f["median_mm"],
                      f["worst_mm"], f["wall_of_scans_s"])])
    scans = table(("scan", "first (mm)", "at last (mm)", "verdict"),
                  [(row["scan"], "failed" if row["first_mm"] is None else row["first_mm"],
                    "failed" if row["mean_mm"] is None else row["mean_mm"], row["verdict"].split(":")[0])
                   for row in report["rows"] if row["again"] or row["verdict"] != "good"])
    return f"{summary}\n\n{scans}"


def reliability(report: dict) -> str:
    """Verdicts against the truth, and what probabilities said beside what was."""
    f = report["summary"]
    verdicts = table(("registrations", "right", "wrong, called good", "right, called check", "right, called failed",
                      "Brier score", "that of the share"),
                     [tuple(f[n] for n in ("registrations", "right", "wrong_called_good", "right_called_check",
                                           "right_called_failed", "brier", "brier_of_the_mean"))])
    diagram = table(("probability from", "registrations", "said, mean", "right"),
                    [(row["from"], row["count"], f"{row['said']:.0%}", f"{row['were']:.0%}") for row in f["diagram"]])
    return f"{verdicts}\n\n{diagram}"


def signatures(report: dict) -> str:
    """Means over the poses of the correlation at every scale."""
    names = {"reference": "published registration", "slid": "the same, slid 4 mm at random", "ours": "ours"}
    scales = tuple(f"smoothed over {s:.0f} mm" for s in report["scales_mm"])
    return table((f"correlation, mean of {len(report['rows'])} poses", *scales),
                 [(names[name], *values) for name, values in report["means"].items()])
