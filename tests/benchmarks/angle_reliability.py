"""Whether the expected errors of joint angles that `scape mosh` writes are as large as the true errors.

    python tests/benchmarks/angle_reliability.py FOLDER [FOLDER ...] [-o FILE]

FOLDER/recordings has marker files NAME.trc, each of another person. FOLDER/truth has for each NAME.npz with the true
flexions between joint centres, degrees, in all frames: `knee l`, `knee r`, `elbow l` and `elbow r`. Each file goes
through `scape mosh` into FOLDER/mosh/NAME, once: remove that folder to compute it anew.

Errors are angles of `anatomical_angles.csv` minus the truth, beside the columns `_sd` as they stand. *Without zero*
takes the mean error of each limb away, and the error of the zero out of `_sd`: at best what a static trial leaves.
The slope is the error for each degree of flexion. Each limb counts the same. Ranges hold 90 per cent of draws of
people, since errors of one person go together. The picture is beside FILE, a PNG.
"""
from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from protocols import machine, write_report
from scipy.special import erf

from completion.__main__ import main as scape
from completion.mocap.angle_errors import OF_THE_ZERO
from completion.motion_pictures import mean_over

COLUMNS = {"knee": "knee_angle", "elbow": "elbow_flex"}
FRAMES = 100                                     # of every limb, evenly spaced: recordings differ in rate
WIDTHS = np.arange(0.25, 3.01, 0.25)             # in expected errors
BINS = 4                                         # of equally many frames, by expected error
BENDS = 20.0                                     # degrees of flexion from which the slope of a limb is determined


def measure(recording: Path) -> dict[str, np.ndarray]:
    """Return error, expected error and truth (3, 2, FRAMES), degrees, of both sides; NaN where no angle is told."""
    folder = recording.parents[1]
    results, written = folder / "mosh" / recording.stem, f"{recording.stem}/*/anatomical_angles.csv"
    if not list(results.glob(written)) and scape(["mosh", str(recording), "-o", str(results)]):
        raise SystemExit(f"no motion was found in {recording}")
    table = np.genfromtxt(next(results.glob(written)), delimiter=",", names=True)
    truth, frames = np.load(folder / "truth" / f"{recording.stem}.npz"), np.linspace(0, len(table) - 1, FRAMES)
    rows = {angle: np.full((3, 2, FRAMES), np.nan) for angle in COLUMNS}
    for angle, row in rows.items():
        for k, side in enumerate("lr"):
            name, true = f"{COLUMNS[angle]}_{side}", truth[f"{angle} {side}"]
            if name in (table.dtype.names or ()):
                row[:, k] = np.stack([table[name] - true, table[f"{name}_sd"], true])[:, frames.round().astype(int)]
    return rows


def summarise(errors: np.ndarray, expected: np.ndarray) -> dict[str, object]:
    """Compare errors with expected errors, both (people, 2, FRAMES), degrees."""
    ratio, known = np.abs(errors) / expected, np.isfinite(errors)
    inside = np.stack([(ratio <= width).sum(axis=(1, 2)) for width in WIDTHS])
    # people are drawn with return, and each draw has a share of every width
    draws = np.random.default_rng(0).integers(len(errors), size=(2000, len(errors)))
    drawn = inside[:, draws].sum(axis=2) / known.sum(axis=(1, 2))[draws].sum(axis=1)
    # root mean squares of frames that expect about the same
    order = np.argsort(expected[known])
    parts = zip(*(np.array_split(values[known][order], BINS) for values in (expected, errors)), strict=True)
    return {"people": len(errors), "told": known.mean(), "bias": np.nanmean(errors),
            "rms": np.sqrt(np.nanmean(errors**2)), "expected": np.nanmedian(expected),
            "shares": (inside.sum(axis=1) / known.sum()).tolist(),
            "ranges": np.percentile(drawn, [5, 95], axis=1).T.tolist(),
            "bins": [[float(np.sqrt((values**2).mean())) for values in part] for part in parts]}


def slope(errors: np.ndarray, truth: np.ndarray) -> float:
    """Compute by how much the error grows with a degree of flexion, the mean of all limbs that bend enough."""
    limbs = zip(errors.reshape(-1, FRAMES), truth.reshape(-1, FRAMES), strict=True)
    return float(np.mean([np.polyfit(true, off, 1)[0] for off, true in limbs if np.ptp(true) > BENDS]))


def draw(path: Path, summary: dict[str, dict]) -> None:
    """Draw observed against normal shares, and true against expected errors."""
    from matplotlib.figure import Figure
    figure = Figure(figsize=(8.4, 3.9), layout="constrained")
    shares, sizes = figure.subplots(1, 2)
    normal, largest = erf(WIDTHS / np.sqrt(2)), 1.1 * max(np.max(of["bins"]) for of in summary.values())
    for name, of in summary.items():
        color, whole = {"knee": "C0", "elbow": "C1"}[name.split()[0]], "zero" not in name
        shares.plot(normal, of["shares"], "o-" if whole else "s:", color=color, ms=3.5, label=name)
        if whole:
            shares.fill_between(normal, *np.transpose(of["ranges"]), color=color, alpha=0.15, linewidth=0)
        sizes.plot(*np.transpose(of["bins"]), "o" if whole else "s", color=color, ms=5, alpha=1 if whole else 0.5)
    for axes, end in ((shares, 1.0), (sizes, largest)):
        axes.plot([0, end], [0, end], color="0.6", zorder=0)
        axes.set(xlim=(0, end), ylim=(0, 1.01 * end))
    shares.set(xlabel="share within k expected errors if normal", ylabel="share observed")
    shares.legend(frameon=False, loc="upper left", fontsize=8)
    sizes.set(xlabel="expected error (°)", ylabel="true error, root mean square (°)")
    figure.savefig(path, dpi=90)


def main() -> None:
    """Run, and print a line an angle."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("-o", "--output", type=Path, default="angle_reliability.json")
    args = parser.parse_args()
    paths = [path for folder in args.folders for path in sorted((folder / "recordings").glob("*.trc"))]
    rows, summary = [measure(path) for path in paths], {}
    for angle in COLUMNS:                                    # a marker set may leave arms out
        if known := [row[angle] for row in rows if np.isfinite(row[angle]).any()]:
            errors, expected, truth = np.stack(known, axis=1)
            moved, zeroless = errors - mean_over(errors, -1)[..., None], np.sqrt(expected**2 - OF_THE_ZERO**2)
            summary[angle] = summarise(errors, expected) | {"slope": slope(errors, truth)}
            summary[f"{angle} without zero"] = summarise(moved, zeroless) | {"slope": slope(moved, truth)}
    for name, of in summary.items():
        one, two = (f"{of['shares'][i]:.2f} ({of['ranges'][i][0]:.2f}-{of['ranges'][i][1]:.2f})" for i in (3, 7))
        print(f"{name:18} {of['people']} people  bias {of['bias']:+.1f}  rms {of['rms']:.1f}  expected "
              f"{of['expected']:.1f}  within one {one}, two {two}  slope {of['slope']:+.2f}")
    limbs = [{"recording": str(path)} | {angle: mean_over(row[angle][0], -1).tolist() for angle in COLUMNS}
             for path, row in zip(paths, rows, strict=True)]
    write_report(args.output, {"machine": machine(), "summary": summary, "bias_of_limbs": limbs})
    draw(args.output.with_suffix(".png"), summary)


if __name__ == "__main__":
    main()
