"""How long each stage of MoSh takes on real marker files, beside the times of the paper.

    python tests/benchmarks/mosh_speed.py FOLDER -m MODEL.npz -o mosh_speed.json

For each file: seconds of the clock and of the processor for the person (stage 1), the poses (stage 2), the soft tissue
(for all frames, what is prepared once included) and the meshes that change, and the mean distance of seen markers with
fixed shape and with soft tissue. The paper gives 7 minutes, 1 s and 2 s a frame. Run it with nothing else running;
OMP_NUM_THREADS says how many cores a product of matrices may use.
"""
from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from protocols import machine, write_report

from completion.mocap.files.markers import MarkerSequence, read_markers
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import named_layout
from completion.mocap.mosh.mosh import MoshConfig
from completion.mocap.pose.follow import animate
from completion.mocap.soft_tissue.soft_tissue import follow_soft_tissue
from completion.mocap.subject.person import find_person
from model.body import BodyModel
from model.files import load_model

PAPER = {"person": "7 minutes", "poses": "1 s a frame", "soft": "2 s a frame"}
MESHES = 64                          # frames whose meshes are made
Result = TypeVar("Result")


def timed(row: dict[str, float | str], name: str, make: Callable[[], Result]) -> Result:
    """What a stage makes; its seconds go into the row."""
    wall, cpu = time.perf_counter(), time.process_time()
    out = make()
    row[f"{name}_wall_s"], row[f"{name}_cpu_s"] = time.perf_counter() - wall, time.process_time() - cpu
    return out


def measure(model: BodyModel, markers: MarkerSequence, layout: MarkerLayout, config: MoshConfig
            ) -> dict[str, float | str]:
    """The figures of one file."""
    T = len(markers.positions)
    row: dict[str, float | str] = {"frames": T, "markers": len(layout.matched(markers.labels))}
    person = timed(row, "person", lambda: find_person(model, markers, layout, config.person))
    motion = timed(row, "poses", lambda: animate(model.subject(person.betas), markers, person.layout,
                                                      config.poses))
    soft = timed(row, "soft", lambda: follow_soft_tissue(model, motion, markers, person.layout, config.soft))
    some = np.linspace(0, T - 1, min(T, MESHES)).round().astype(int)
    soft.vertices(model, some[:1])                                      # what is factored once
    timed(row, "meshes", lambda: soft.vertices(model, some))
    for name in ("poses", "soft"):
        for clock in ("wall", "cpu"):
            row[f"{name}_frames_per_{clock}_s"] = T / float(row[f"{name}_{clock}_s"])
    row["mesh_cpu_ms"] = 1e3 * float(row["meshes_cpu_s"]) / len(some)
    row["fixed_mm"], row["soft_mm"] = (float(1e3 * np.nanmean(m.residuals)) for m in (motion, soft.motion))
    row["skin_rms_mm"] = float(1e3 * np.sqrt((soft.movement(model)**2).mean()))
    return row


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-m", "--model", required=True)
    parser.add_argument("-o", "--output", default="mosh_speed.json")
    parser.add_argument("--layout", default="cmu41")
    args = parser.parse_args()
    model, config = load_model(args.model), MoshConfig()
    people = model.info.get("people_vertices")
    layout = named_layout(args.layout, model.template, None if people is None else np.array(people))
    rows = []
    for path in sorted(args.folder.glob("*.c3d")):
        rows.append({"file": path.name, **measure(model, read_markers(path), layout, config)})
        print("  ".join(f"{name} {value if isinstance(value, str) else format(value, '.4g')}"
                        for name, value in rows[-1].items()), flush=True)
    write_report(args.output, {"protocol": f"speed of MoSh on real files, {args.layout}", "machine": machine(),
                               "paper": PAPER, "files": rows, "config": dataclasses.asdict(config)})


if __name__ == "__main__":
    main()
