"""Tables of BENCHMARKS.md on statues."""
from __future__ import annotations

from tables_scans import Rows, table


def statues(report: dict) -> str:
    """A row for every scan, with the paper's below."""
    rows: Rows = []
    for one in report["rows"]:
        rows.append((one["scan"], one["triangles"],
                     *(f"{level['mean_mm']:.2f} / {level['rms_mm']:.2f}" for level in one["levels"]),
                     one["e_mm"], f"{one['folded']:.2%}", f"{one['hole']:.1%}", one["inverted_outside_folds"],
                     round(one["frames_per_s"]), one["cpu_s"]))
    rows.append(("the paper, four people", "", "2.16-2.57 / 3.67-5.02", "0.98-1.27 / 2.27-4.06",
                 "0.62-0.87 / 1.93-3.89", "0.53-0.78 / 1.90-3.91", "0.38-0.48", "", "", "", "", ""))
    return table(("scan", "triangles", "L0 mean / RMS (mm)", "L1", "L2", "L3", "e (mm)", "folded", "holes",
                  "inverted outside folds, L3", "frames/s, L3", "fit and map (s CPU)"), rows)


def surface_fits(report: dict) -> str:
    """Fig. 6: noise on the humanoid; Fig. 7: from a sphere to a head; and real bodies."""
    noise = report["figure_6"]
    left: Rows = [(f"published, {steps} steps", f"{noise[f'published_{steps}']:.0%}") for steps in (10, 100, 1000)]
    left.append(("ours, 10 solves", f"{noise['exact_10']:.0%}"))
    rows: Rows = [(one["way"], one["scan_rms_mm"], one["distortion"], int(one["inverted"]),
                   one["scan_against_percent"]) for one in report["figure_7"]]
    bodies: Rows = [(way, one["vertices_rms_mm"], one["scan_rms_mm"], one["distortion"], one["cpu_s"])
                    for way, one in report["means"].items()]
    return "\n\n".join((
        table(("noise on the control mesh", "left of it"), left),
        table(("from a sphere to a head", "scan to mesh, RMS (mm)", "distortion", "inverted triangles",
               "scan turned against the mesh (%)"), rows),
        table(("real bodies, mean", "mesh to scan, RMS (mm)", "scan to mesh, RMS (mm)", "distortion", "time (s CPU)"),
              bodies)))
