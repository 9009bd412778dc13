"""Tables of BENCHMARKS.md on completion: half views, people, markers, frames of points."""
from __future__ import annotations

from tables_scans import Rows, table


def half_views(report: dict) -> str:
    """Half views of the held-out poses of one fold."""
    names = ("completed_seen_mm", "completed_unseen_mm", "predicted_seen_mm", "predicted_unseen_mm", "worst_part_mm",
             "cpu_seconds")
    rows: Rows = [(r["k"], *(r[n] for n in names)) for r in report["rows"]]
    rows.append(("mean", *(report["mean"][n] for n in names)))
    rows.append((f"below 30 mm: {report['mean']['below_30_mm']:.0%}", f"flipped limbs: {report['mean']['flipped']:.0%}",
                 *[""] * 5))
    return table(("view", "completed, seen (mm)", "completed, unseen (mm)", "predicted, seen (mm)",
                  "predicted, unseen (mm)", "worst part (mm)", "time (s CPU)"), rows)


def imported_models(report: dict) -> str:
    """Our own SCAPE model and imported ones on synthetic people not learned."""
    names = [name for name in report if isinstance(report[name], dict) and "MoSh" in report[name]]
    rows: Rows = []
    for name in names:
        one, half = report[name], report[name].get("half views", {})
        rows.append((name, one["fit of whole bodies"]["mean_mm"], half.get("seen_mm", ""), half.get("unseen_mm", ""),
                     half.get("seconds", ""), *(one[what][figure] for what in ("markers, shape known", "MoSh")
                                                for figure in ("mean_mm", "seconds")),
                     one["256 bodies of one person"]["seconds"] * 1000))
    return table(("model", "whole body (mm)", "half view, seen (mm)", "unseen (mm)", "s",
                  "47 markers, shape known (mm)", "s", "MoSh (mm)", "s", "256 bodies (ms)"), rows)


def half_people(report: dict) -> str:
    """Half views of people: ours, the nearest training body, plain hole filling; then every man."""
    mean = report["mean"]
    kinds = [(label, name) for label, name in (
        ("completed", "completed"), ("predicted", "predicted"), ("nearest training body, moved", "nearest_rigid"),
        ("nearest training body, bent", "nearest_posed")) if f"{name}_seen_mm" in mean]
    rows: Rows = [(label, mean[f"{name}_seen_mm"], mean.get(f"{name}_unseen_mm", ""), mean[f"{name}_closest_mm"])
                  for label, name in kinds]
    if "poisson_seen_mm" in mean:
        rows.append(("screened Poisson", mean["poisson_seen_mm"], "", mean["poisson_closest_mm"]))
    facts: Rows = [(r["k"], r["completed_seen_mm"], r["completed_unseen_mm"], r["predicted_unseen_mm"],
                    r.get("nearest_posed_unseen_mm", ""), r["expected_mm"], r["rms_mm"], r["cpu_seconds"])
                   for r in report["rows"]]
    facts.append(("mean", mean["completed_seen_mm"], mean["completed_unseen_mm"], mean["predicted_unseen_mm"],
                  mean.get("nearest_posed_unseen_mm", ""), mean["expected_mm"], mean["rms_mm"], mean["cpu_seconds"]))
    summary = table(("mean of all", "seen (mm)", "unseen (mm)", "unseen, to the closest point (mm)"), rows)
    return summary + "\n\n" + table(
        ("man", "completed, seen (mm)", "completed, unseen (mm)", "predicted, unseen (mm)",
         "nearest body bent, unseen (mm)", "expected error, unseen (mm, RMS)", "real (mm, RMS)", "time (s CPU)"), facts)


def few_scans(report: dict) -> str:
    """What a model of few scans does."""
    mean = report["mean"]
    figures = (("held-out poses, the model fitted", "poses_error"), ("held-out men, the model fitted", "men_error"),
               ("half views of the known man: seen", "known_seen"), ("unseen", "known_unseen"),
               ("worst part", "known_limb"), ("half views of unknown men: seen", "unknown_seen"),
               ("unseen", "unknown_unseen"), ("worst part", "unknown_limb"),
               ("shape of a man from 47 markers", "mosh_error"))
    rows: Rows = [(label, mean[f"{name}_mm"], mean[f"{name}_mm_worst"]) for label, name in figures
                  if f"{name}_mm" in mean]
    told: Rows = [(label, mean[name]) for label, name in (
        ("share of unseen vertices within the expected error, known man", "known_within_once"),
        ("within twice", "known_within_twice"), ("the same of unknown men", "unknown_within_once"),
        ("within twice", "unknown_within_twice"), ("half views", "views"),
        ("with a part beyond 150 mm", "limbs_beyond_150_mm"),
        ("of them judged good", "limbs_beyond_150_mm_said_good"),
        ("wrong: unseen beyond 30 mm, or a part beyond 150 mm", "wrong"), ("judged check or failed", "flagged"),
        ("both", "wrong_and_flagged"), ("rank correlation, expected and true error, unseen", "correlation_expected_mm"),
        ("the same, worst part", "correlation_expected_limb_mm")) if name in mean]
    return table(("", "mean (mm)", "worst (mm)"), rows) + "\n\n" + table(("", ""), told)


def markers(report: dict) -> str:
    """The whole surface from some of its points; with markers missing, exchanged, astray; real files."""
    rows: Rows = [tuple(row[n] for n in ("pose", "surface_mm", "worst_mm", "markers_mm")) for row in report["poses"]]
    rows.append(("mean", *(report["mean"][n] for n in ("surface_mm", "worst_mm", "markers_mm"))))
    out = [table(("pose", "whole surface (mm)", "worst vertex (mm)", "markers (mm)"), rows)]
    moving: Rows = [tuple(row[n] for n in ("way", "markers", "surface_mm", "p95_mm", "worst_mm", "per_s", "per_cpu_s"))
                    for row in report.get("motion", [])]
    if moving:
        out.append(table(("way", "markers", "surface (mm)", "95% of frames below (mm)", "worst frame (mm)",
                          "frames/s", "frames/s CPU"), moving))
    real: Rows = [tuple(row[n] for n in ("file", "frames", "way", "mean_mm", "p95_mm", "settled", "per_s", "per_cpu_s"))
                  for row in report.get("real", [])]
    if real:
        out.append(table(("file", "frames", "way", "markers, mean (mm)", "p95 (mm)", "settled", "frames/s",
                          "frames/s CPU"), real))
    return "\n\n".join(out)


def recordings(report: dict) -> str:
    """Real marker files: the person and the motion."""
    rows: Rows = [(f["file"], f["frames"], f["mean_mm"], f["p95_mm"], f["worst_frame_mm"], f["subject_cpu_s"],
                   f["frames_per_cpu_s"], f["beta_rms"]) for f in report["files"]]
    return table(("file", "frames", "markers, mean (mm)", "p95 (mm)", "worst frame (mm)", "the person (s CPU)",
                  "frames/s CPU", "betas (RMS)"), rows)


def tracking(report: dict) -> str:
    """Frames of points: a row for every way to disturb them."""
    names = ("surface", "surface, worst frame", "seen part", "vertices", "vertices, worst frame",
             "surface in the disturbed frames", "lost frames", "CPU s a frame")
    rows: Rows = [(kind, *("" if run[n] is None else run[n] for n in names)) for kind, run in report["runs"].items()]
    return table(("frames", *(n if n in ("lost frames", "CPU s a frame") else f"{n} (mm)" for n in names)), rows)


def depth_camera(report: dict) -> str:
    """Shares of right results and errors by what was told: only the picture, the way up, four or seven landmarks."""
    mean, rows = report["mean"], []
    for marks, label in (("blind", "nothing"), ("up", "up"), ("4", "4 landmarks"), ("7", "7 landmarks")):
        if f"{marks}_cases" in mean:
            rows.append((label, *(mean[f"{marks}_{name}"] for name in (
                "cases", "right", "within_right", "all_right", "within_median_mm", "beyond_median_mm", "right_not",
                "right_not_and_flagged", "within_right_not", "within_right_not_and_flagged", "right_but_flagged",
                "cpu_seconds"))))
    return table(("told", "pictures", "seen parts right", "parts within right", "all right", "within, median (mm)",
                  "beyond, median (mm)", "seen parts wrong", "flagged", "parts within wrong", "flagged",
                  "right but flagged", "time (s CPU)"), rows)


def worn_markers(report: dict) -> str:
    """Kinds of scans, by the way that markers were carried to the model."""
    names = ("what", "way", "scans", "markers", "mean_mm", "median_mm", "nine_of_ten_mm", "worst_mm", "flagged",
             "cpu_s")
    return table(("scan", "carried by", "scans", "markers", "mean (mm)", "median (mm)", "nine of ten within (mm)",
                  "worst (mm)", "flagged scans", "completion (s CPU)"),
                 [tuple(r[n] for n in names) for r in report["means"]])


def measures(report: dict) -> str:
    """By where the bodies come from; then of every girth; then repeated; then the errors that half views stated."""
    means = [(r["how"], "girths" if r["girth"] else "others", r["count"], r["mean_mm"], r["bias_mm"], r["largest_mm"])
             for r in report["means"]]
    names = list(dict.fromkeys(r["name"] for r in report["by_name"] if "girth" in r["name"]))
    hows = list(dict.fromkeys(r["how"] for r in report["by_name"]))
    of = {(r["how"], r["name"]): r["mean_mm"] for r in report["by_name"]}
    again = {r["name"]: r["mean_mm"] for r in report["repeated_by_name"]}
    each: Rows = [(name.replace("_", " "), *(of.get((how, name), "") for how in hows), again.get(name, ""))
                  for name in names]
    way: Rows = [(r["way"], "girths" if r["girth"] else "others", r["count"], r["mean_mm"], r["largest_mm"])
                 for r in report["repeated"]]
    told: Rows = [(f"{r['how']}, {r['people']}", "girths" if r["girths"] else "others", r["stated_rms_mm"],
                   r["true_rms_mm"], 100 * r["within_1"], 100 * r["within_2"]) for r in report["stated"]]
    return "\n\n".join((
        table(("bodies", "", "count", "mean error (mm)", "bias (mm)", "largest (mm)"), means),
        table(("mean error (mm)", *hows, "men, repeated"), each),
        table(("men, repeated: carried by", "", "count", "apart, mean (mm)", "largest (mm)"), way),
        table(("half views, people", "", "stated, RMS (mm)", "true, RMS (mm)", "within 1 (%)", "within 2 (%)"), told)))


def wrong_landmarks(report: dict) -> str:
    """Kinds of faults: how many were flagged by the completion, and told rightly by the body found without them."""
    rows: Rows = []
    for case in dict.fromkeys(r["case"] for r in report["rows"]):
        mine = [r for r in report["rows"] if r["case"] == case]
        count = [sum(r["verdict"] == verdict for r in mine) for verdict in ("good", "check", "failed")]
        seconds = sum(r["cpu_s"] for r in mine) / len(mine)
        rows.append((case, len(mine), *count, sum(r["right"] for r in mine), seconds))
    return table(("landmarks", "views", "judged good", "check", "failed", "told rightly", "time (s CPU)"), rows)


def verdicts(report: dict) -> str:
    """Every input, the wrong ones first: what was said of it, why, and how far the body is off."""
    ordered = sorted(report["rows"], key=lambda r: not r["wrong"])
    rows: Rows = [("wrong" if r["wrong"] else "right", r["case"], r["verdict"], "; ".join(r["reasons"][:1]),
                   r.get("mean_mm", ""), r.get("part_mm", "")) for r in ordered]
    counts = ", ".join(f"{name}: {len(value) if isinstance(value, list) else value}"
                       for name, value in report["summary"].items())
    return f"{counts}.\n\n" + table(("input", "case", "verdict", "first reason", "off (mm)", "worst part (mm)"), rows)


def viewer_speed(report: dict) -> str:
    """Round trips of sliders."""
    rows: Rows = [(kind, report[kind]["a_second"], report[kind]["median_ms"], report[kind]["p95_ms"])
                  for kind in ("shape", "pose", "both")]
    return table(("slider", "round trips a second", "median (ms)", "95th percentile (ms)"), rows)
