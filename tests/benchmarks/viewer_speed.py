"""How many times a second a slider of `scape view` gets its body back, in a browser on this machine.

    python tests/benchmarks/viewer_speed.py -m MODEL.npz -o viewer_speed.json

A round trip begins in the page, which sends where a slider is, and ends there, when the new places of all vertices
have become those of the surface, with its normals. Drawing is not counted: without a graphics card it is slow. Shape:
one slider to and fro; pose: one joint; both: in turns, so that the basis has to follow. The model is the one named or,
without a name, the worm of the tests with as many vertices as wanted. `--load N` keeps N processes busy meanwhile.
"""
from __future__ import annotations

import argparse
import multiprocessing
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from protocols import machine, write_report

sys.path.insert(0, str(Path(__file__).parents[1]))
from browser import FLAGS, NAMES

from completion.viewing.app import ViewApp
from completion.viewing.contents import of_model
from completion.viewing.files import Entry
from model.body import BodyModel
from scanprep.viewer.server import Server

KINDS, TURNS = ("shape", "pose", "both"), 5
ROUNDS = """async ({kind, seconds}) => {
  program.figure.panes.forEach((pane) => { pane.redraw = () => {}; });
  const times = [], start = performance.now();
  const shape = (i) => program.send("beta", {index: 0, value: Math.sin(i / 7)});
  const pose = (i) => program.send("turn", {part: program.parts[1], turn: [0.5 * Math.sin(i / 9), 0.2, 0]});
  for (let i = 0; performance.now() - start < 1000 * seconds; i++) {
    const before = performance.now();
    await new Promise((done) => {
      program.on("positions", done);
      ({shape, pose, both: i % 2 ? shape : pose})[kind](i);
    });
    times.push(performance.now() - before);
  }
  return times;
}"""


def busy() -> None:
    """A process that takes a core."""
    while True:
        np.linalg.svd(np.random.default_rng(0).normal(size=(200, 200)))


def measure(model: BodyModel, seconds: float) -> dict[str, Any]:
    """Round trips of each kind."""
    from playwright.sync_api import sync_playwright

    app = ViewApp([Entry("model", lambda: of_model("model", model))])
    path = next(filter(None, map(shutil.which, NAMES)))
    out: dict[str, Any] = {"vertices": len(model.template.vertices), "features": model.features.count}
    with Server(app) as server, sync_playwright() as started:
        browser = started.chromium.launch(executable_path=path, args=list(FLAGS))
        page = browser.new_context(bypass_csp=True).new_page()
        page.goto(server.opening())
        page.wait_for_function("window.program?.figure && window.program.parts?.length")
        found: dict[str, list[float]] = {kind: [] for kind in KINDS}
        for turn in range(1 + TURNS):                     # the first for what is made once; in turns: loads change
            for kind in KINDS:
                times = page.evaluate(ROUNDS, {"kind": kind, "seconds": seconds / TURNS})
                found[kind] += times if turn else []
        for kind, times in found.items():
            out[kind] = {"a_second": 1e3 * len(times) / sum(times), "median_ms": float(np.median(times)),
                         "p95_ms": float(np.percentile(times, 95))}
        browser.close()
    return out


def main() -> None:
    """Run and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-m", "--model")
    parser.add_argument("-o", "--output", default="viewer_speed.json")
    parser.add_argument("--vertices", type=int, default=12500)
    parser.add_argument("--load", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=5.0)
    args = parser.parse_args()
    if args.model:
        from model.files import load_model

        model = load_model(args.model)
    else:
        from model_bodies import worm_model

        model = worm_model(rings=args.vertices // 12)
    others = [multiprocessing.Process(target=busy, daemon=True) for _ in range(args.load)]
    for one in others:
        one.start()
    time.sleep(0.5)
    found = measure(model, args.seconds)
    for one in others:
        one.terminate()
    for kind in KINDS:
        print(f"{kind:<6}" + "  ".join(f"{name} {value:.4g}" for name, value in found[kind].items()))
    write_report(args.output, {"machine": machine(), "busy_processes": args.load, **found})


if __name__ == "__main__":
    main()
