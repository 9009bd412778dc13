"""Write BENCHMARKS.md from the JSON that the benchmarks wrote.

    python tests/benchmarks/summary.py tests/benchmarks/results

Every benchmark has its own section: the command, the machine, accuracy beside time, what it is compared with.
"""
from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
Rows = list[tuple[Any, ...]]


def table(header: tuple[str, ...], rows: Rows) -> str:
    """A Markdown table; fractions with three significant digits."""
    def text(value: Any) -> str:
        return f"{value:.3g}" if isinstance(value, float) else str(value)

    lines = [header, tuple("---" for _ in header), *rows]
    return "\n".join("| " + " | ".join(map(text, line)) + " |" for line in lines)


def poses(report: dict) -> str:
    """Held-out poses of the real man."""
    rows: Rows = [(f"fold {f['fold']}", f["parts"], float(np.mean(f["error_mm"])), float(max(f["error_mm"])),
                   float(np.mean(f["rigid_mm"])), f["skeleton_s"], f["learn_s"], f["fit_s_per_pose"])
                  for f in report["folds"]]
    rows.append(("all", "", report["mean_mm"], report["worst_mm"], report["rigid_mean_mm"], "", "", ""))
    return table(("", "parts found", "SCAPE (mm)", "worst pose (mm)", "rigid parts alone (mm)", "skeleton (s)",
                  "learning (s)", "fit (s a pose)"), rows)


def half_views(report: dict) -> str:
    """Half views of the held-out poses of one fold, or of held-out people."""
    rows: Rows = [(r["k"], r["completed_seen_mm"], r["completed_unseen_mm"], r["predicted_seen_mm"],
                   r["predicted_unseen_mm"], r["worst_part_mm"], r["seconds"]) for r in report["rows"]]
    mean = report["mean"]
    rows.append(("mean", *(mean[n] for n in ("completed_seen_mm", "completed_unseen_mm", "predicted_seen_mm",
                                             "predicted_unseen_mm", "worst_part_mm", "seconds"))))
    return table(("view", "completed, seen (mm)", "completed, unseen (mm)", "predicted, seen (mm)",
                  "predicted, unseen (mm)", "worst part (mm)", "time (s)"), rows)


def learning(report: dict) -> str:
    """Learning, held-out people and the fast path."""
    fast = report["fast_path"]
    rows: Rows = [("finding the skeleton (s)", report["skeleton_s"], ""), ("learning (s)", report["learn_s"], ""),
                  ("largest memory (GiB)", report["peak_gib"], "")]
    for count, yardstick in ((20, 10.0), (40, 7.4)):
        rows.append((f"held-out people ({report['held']} of 45), {count} components (mm)",
                     report[f"held_out_{count}_mm"], f"plain vertex PCA of all 45: {yardstick}"))
    rows += [(f"fast path: {name}", value, "") for name, value in flat(fast)]
    return table(("", "", "for comparison"), rows)


def flat(value: dict, before: str = "") -> list[tuple[str, Any]]:
    """Leaves of nested dictionaries with their path."""
    out: list[tuple[str, Any]] = []
    for name, inner in value.items():
        path = f"{before}{name}"
        out += flat(inner, path + ", ") if isinstance(inner, dict) else [(path, inner)]
    return out


def generic(report: dict) -> str:
    """All rows of a report as they are."""
    rows = report["rows"]
    names = tuple(rows[0])
    return table(names, [tuple(r[n] for n in names) for r in rows])


SECTIONS: dict[str, tuple[str, str, Callable[[dict], str], str]] = {
    "scape_5fold": ("Held-out poses (SCAPE-5fold)", "python tests/benchmarks/scape_5fold.py", poses,
                    "Skeleton and model from the training poses of the fold alone; `refinements` and `steps` were "
                    "chosen while looking at fold 0. Where we lose: seated poses with "
                    "the trunk far bent, and folds in which the search finds another number of parts."),
    "half_views": ("Half views of held-out poses, known subject", "python tests/benchmarks/half_views.py", half_views,
                   "Fold 0, 7 landmarks, viewpoint not told. Where we lose: an arm that no point of the scan touches, "
                   "and time when limbs have to be searched for."),
    "learning": ("Learning from 71 poses and 182 people", "python tests/benchmarks/learning.py", learning,
                 "Put together by hand with that script's functions, not by one run of it: skeleton, learning and "
                 "memory (of the whole process) are read off one run of `scape learn`; the rest is of the model it "
                 "wrote. The error of held-out people is after fitting betas, pose and place, on every fifth of the "
                 "45, so it is not strictly comparable with the yardstick."),
    "registration": ("Registration of virtual four-view scans", "python tests/benchmarks/registration.py", generic,
                     "Template mesh000, ten landmarks. Where we lose: with few landmarks the template slides along "
                     "limbs and around the trunk; the surface is right long before the correspondence is."),
    "markers": ("Markers on random vertices of held-out poses", "python tests/benchmarks/markers.py", generic, ""),
}


def main() -> None:
    """Collect and write."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "results"
    parts = ["# Benchmarks\n\nGenerated by `python tests/benchmarks/summary.py` from the JSON files in `results`. "
             "Run by hand on real scans that cannot be shipped; errors are mean vertex distances unless said "
             "otherwise.\n"]
    for name, (title, command, section, note) in SECTIONS.items():
        path = folder / f"{name}.json"
        if not path.exists():
            continue
        report = json.loads(path.read_text())
        machine = report.get("machine") or report.get("versions") or {}
        facts = ", ".join(f"{key} {value}" for key, value in machine.items())
        parts.append(f"\n## {title}\n\n`{command}` on {facts}.\n\n{section(report)}\n\n{note}\n")
    (HERE / "BENCHMARKS.md").write_text("".join(parts))


if __name__ == "__main__":
    main()
