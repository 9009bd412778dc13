"""Where the time and the memory of the whole command `scape mosh` go: processor and clock for each stage, and its peak.

    python tests/benchmarks/mosh_speed.py -o mosh_speed.json
    python tests/benchmarks/mosh_speed.py FOLDER -m MODEL.npz --files 85_02 -o mosh_speed.json
    python tests/benchmarks/mosh_speed.py --minutes 10 --kinds walk -o mosh_memory.json

A synthetic person walks for `--minutes` at 120 Hz with 41 markers, 1 mm noisy: as they are (`walk`), and with faults
(`faulty`): labels exchanged, markers out of sight, slipped, noisy and astray. With a FOLDER its marker files follow,
which need the model of --model. Every command runs in a process of its own with everything it writes, one core at a
time. `frames_per_s` are frames over the seconds of the processor, without pages and with them (`all`); the peak is the
resident memory of the process. The paper gives 7 minutes for a person, 1 s for the poses and 2 s for the soft tissue
of a frame. A shared machine is noisy: seconds of the processor say most.
"""
from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from marker_motion import dropped
from mosh_artefacts import exchanged, spoilt
from protocols import machine, write_report

from completion.mocap.files.markers import MarkerSequence, read_markers, write_markers
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.pose.marked_body import supports
from model.built_in import load_built_in_model
from model.files import BUILT_IN
from model.fitting import energy
from scanprep.synthetic.people import synthesise_walk

RATE, NOISE = 120.0, 0.001           # frames a second; metres
EXCHANGED, MISSING = 0.05, 0.05      # shares of the markers, at any time
STAGES = ("person", "artefacts", "poses", "soft tissue", "files", "pages", "all")
Row = dict[str, float | str | dict[str, float]]


def walking(frames: int, faulty: bool, rng: np.random.Generator) -> MarkerSequence:
    """Markers of a synthetic person who walks."""
    model = load_built_in_model()
    layout = load_layout("cmu41", model.template, np.array(model.info["people_vertices"]))
    subject, (poses, trans) = model.subject(0.5 * rng.normal(size=model.n_betas)), synthesise_walk(frames, RATE)
    points = subject.points(*supports(model.template, layout))
    places = energy.rise_above_skin(points.evaluate(poses, trans), np.asarray(layout.distances))
    clean = MarkerSequence(places + rng.normal(0, NOISE, places.shape), layout.labels, RATE)
    if not faulty:
        return clean
    part = subject.skeleton.part_of_vertex(model.template)[layout.nearest]
    turns, spoiled = subject.skeleton.part_rotations(poses)[:, part], clean
    for kind in ("slipped", "noisy", "stray"):
        spoiled = spoilt(spoiled, kind, 2, turns, rng).markers
    return dropped(exchanged(spoiled, EXCHANGED, False, rng).markers, MISSING, 0.25, rng)


def measured(file: Path, model: Path, layout: str, tree: Path) -> Row:
    """Seconds, speeds and peak of the command on one file."""
    frames, environment = len(read_markers(file).positions), {**os.environ, "PYTHONPATH": str(tree)}
    with tempfile.TemporaryDirectory(dir=file.parent if os.access(file.parent, os.W_OK) else None) as place:
        out, start = Path(place) / "out", time.perf_counter()
        child = subprocess.Popen([sys.executable, "-m", "completion", "mosh", str(file), "-m", str(model), "--layout",
                                  layout, "-o", str(out)], env=environment, stdout=subprocess.DEVNULL)
        _, status, used = os.wait4(child.pid, 0)
        wall, child.returncode = time.perf_counter() - start, os.waitstatus_to_exitcode(status)
        if child.returncode:
            raise SystemExit(f"scape mosh {file}: failed")
        told = {m["metric"]: m["value"] for m in json.loads((out / "report.json").read_text())["metrics"]}
    stages = {clock: {stage: float(told[key]) for stage in STAGES if (key := f"{stage}, {clock}") in told}
              for clock in ("processor time", "time by the clock")}
    cpu = used.ru_utime + used.ru_stime
    pages = stages["processor time"].get("pages", 0.0)
    return {"file": file.name, "frames": frames, "cpu_s": cpu, "wall_s": wall, "pages_cpu_s": pages,
            "frames_per_s": frames / (cpu - pages), "frames_per_s_all": frames / cpu, "peak_MiB": used.ru_maxrss / 1024,
            "fixed shape": float(told["markers to the body, fixed shape"]),
            "soft tissue": float(told["left over after soft tissue was fitted"]),
            "stages_cpu_s": stages["processor time"], "stages_wall_s": stages["time by the clock"]}


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="real marker files, which need --model")
    parser.add_argument("-m", "--model", type=Path, help="of the real files")
    parser.add_argument("-o", "--output", default="mosh_speed.json")
    parser.add_argument("--layout", default="cmu41")
    parser.add_argument("--files", nargs="*", help="some of the folder, by their names without ending")
    parser.add_argument("--minutes", type=float, default=1.0, help="of the synthetic walks")
    parser.add_argument("--kinds", nargs="*", default=["walk", "faulty"], help="synthetic walks, or none")
    parser.add_argument("--tree", type=Path, default=Path(__file__).resolve().parents[2], help="sources to measure")
    args = parser.parse_args()
    if (args.folder is None) != (args.model is None):
        parser.error("a folder of real files and --model go together")
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as temporary:
        cases = [(Path(temporary) / f"{kind}.c3d", Path(BUILT_IN)) for kind in args.kinds]
        for file, _ in cases:
            write_markers(file, walking(round(60 * RATE * args.minutes), file.stem == "faulty",
                                        np.random.default_rng(0)))
        cases += [(path, args.model) for path in sorted(args.folder.glob("*.c3d") if args.folder else ())
                  if not args.files or path.stem in args.files]
        for file, model in cases:
            model = model if str(model) == BUILT_IN else model.resolve()         # a name, or a file
            rows.append(measured(file.resolve(), model, args.layout, args.tree.resolve()))
            print("  ".join(f"{name} {value if isinstance(value, str | dict) else format(value, '.4g')}"
                            for name, value in rows[-1].items()), flush=True)
    write_report(args.output, {"protocol": f"scape mosh, the whole command, {args.layout}", "machine": machine(),
                               "minutes": args.minutes, "files": rows})


if __name__ == "__main__":
    main()
