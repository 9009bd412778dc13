"""Joint angles of `mosh` beside those that Plug-in Gait wrote into the same C3D files.

    python tests/benchmarks/plug_in_gait.py FILE.c3d [FILE.c3d ...] [-o FILE]

Needs `ezc3d`. Each file is a walk of another person with markers of Plug-in Gait and its angles, such as LKneeAngles.
Ours are those of the convention `plug-in-gait`. For every angle: the mean difference over all limbs and how it varies
from person to person, the spread (standard deviation of the difference of a limb, the median of all limbs), the root
mean square, the correlation, our range of motion as a share of theirs, and how often an expected error is larger than
the difference. The picture beside FILE has the angles of some limbs of every file.

What we lose at: hip rotation and knee adduction, whose axes Plug-in Gait takes from markers on thigh and shank.
"""
from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import ezc3d
import numpy as np
from protocols import machine, write_report

from completion import AngleConfig, MoshConfig, mosh

THEIRS = {"pelvis_tilt": ("Pelvis", 0), "pelvis_list": ("Pelvis", 1), "pelvis_rotation": ("Pelvis", 2),
          "hip_flexion": ("Hip", 0), "hip_adduction": ("Hip", 1), "hip_rotation": ("Hip", 2), "knee_angle": ("Knee", 0),
          "knee_adduction": ("Knee", 1), "ankle_angle": ("Ankle", 0)}
CONFIG = MoshConfig(soft_tissue=False, angles=AngleConfig("plug-in-gait"))
DRAWN = "pelvis_list", "hip_flexion", "hip_adduction", "knee_angle", "ankle_angle"


def compare(path: Path) -> dict[str, np.ndarray]:
    """Return theirs, ours and the expected error (3, T), degrees, of every angle of a file by its name."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ours, file = mosh(path, config=CONFIG).joint_angles(), ezc3d.c3d(str(path))
    labels = [label.rpartition(":")[2].removesuffix("_M") for label in file["parameters"]["POINT"]["LABELS"]["value"]]
    found = {}
    for name, (joint, row) in THEIRS.items():
        for side in "r" if joint == "Pelvis" else "rl":
            column, label = name if joint == "Pelvis" else f"{name}_{side}", f"{side.upper()}{joint}Angles"
            if column in ours and label in labels:
                theirs = file["data"]["points"][row, labels.index(label)]
                both = np.stack([theirs, ours[column], ours[f"{column}_sd"]])
                both = both[:, np.isfinite(both).all(axis=0) & (theirs != 0)]        # zeros: nothing was computed
                if both.shape[1] > 20:
                    found[column] = both
    return found


def summarise(limbs: list[np.ndarray]) -> dict[str, float]:
    """Compare ours with theirs over the limbs of all files, each (3, T)."""
    off = [ours - theirs for theirs, ours, _ in limbs]
    mean, spread = (np.array([measure(one) for one in off]) for measure in (np.mean, np.std))
    expected = np.array([np.median(sd) for _, _, sd in limbs])
    return {"limbs": len(limbs), "mean": mean.mean(), "mean_sd": mean.std(), "spread": np.median(spread),
            "rms": np.sqrt(np.mean([np.mean(one**2) for one in off])),
            "correlation": np.median([np.corrcoef(theirs, ours)[0, 1] for theirs, ours, _ in limbs]),
            "range": np.median([np.ptp(ours) / np.ptp(theirs) for theirs, ours, _ in limbs]),
            "within_one": np.mean(np.abs(mean) < expected), "within_two": np.mean(np.abs(mean) < 2 * expected)}


def draw(path: Path, files: dict[str, dict[str, np.ndarray]]) -> None:
    """Draw right-hand angles of every file, theirs dashed."""
    from matplotlib.figure import Figure
    figure = Figure(figsize=(2.6 * len(DRAWN), 1.3 * len(files)), layout="constrained")
    grid = figure.subplots(len(files), len(DRAWN), squeeze=False)
    for axes, (file, found) in zip(grid, files.items(), strict=True):
        for ax, name in zip(axes, DRAWN, strict=True):
            theirs, ours, _ = found.get(name, found.get(f"{name}_r", np.full((3, 1), np.nan)))
            ax.plot(theirs, "k--", lw=0.8)
            ax.plot(ours, "C0", lw=0.9)
            ax.tick_params(labelsize=5)
            ax.set_title(f"{file[:16]} {name}", fontsize=5)
    figure.savefig(path, dpi=80)


def main() -> None:
    """Run, and print a line an angle."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("-o", "--output", type=Path, default="plug_in_gait.json")
    args = parser.parse_args()
    files = {path.stem: compare(path) for path in args.files}
    limbs = {name: [found[column] for found in files.values() for column in (name, f"{name}_r", f"{name}_l")
                    if column in found] for name in THEIRS}
    summary = {name: summarise(own) for name, own in limbs.items() if own}
    for name, of in summary.items():
        print(f"{name:16} {of['limbs']} limbs  mean {of['mean']:+.1f} ({of['mean_sd']:.1f})  "
              f"spread {of['spread']:.1f}  rms {of['rms']:.1f}  correlation {of['correlation']:.3f}  "
              f"range {100 * of['range']:.0f}%  within one {of['within_one']:.2f}, two {of['within_two']:.2f}")
    write_report(args.output, {"machine": machine(), "files": len(files), "summary": summary})
    draw(args.output.with_suffix(".png"), files)


if __name__ == "__main__":
    main()
