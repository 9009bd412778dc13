"""Landmarks at wrong places, as in `scape complete --interactive`: does the completion say so, and which ones are told.

    SCAPEKIT_DATA=... python tests/benchmarks/wrong_landmarks.py -m FOLD_0 [--only 0 1 2] [-o FILE]

Half views of held-out poses, seven landmarks: as they are, with left and right exchanged, and one of them (drawn at
random) at the place of another. `doubts` compares them with the body that is found without any.
"""
from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from half_views import learned
from protocols import half_view, load_real, machine, scape_fold, write_report

from completion.partial.clicked_landmarks import EXCHANGED, landmark_doubts, wrong_ones
from completion.partial.completion import complete
from completion.partial.settings import CompletionConfig
from model.files import load_model
from scanprep.geometry.sides import other_side


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-m", "--model", type=Path)
    parser.add_argument("--only", type=int, nargs="*")
    parser.add_argument("-o", "--output")
    args = parser.parse_args()
    data = load_real()
    subject = (load_model(args.model) if args.model else learned(data, False, 0)).subject(None)
    bodies, config = data.poses[scape_fold(0)[1]], CompletionConfig()
    name_of, rows = {vertex: name for name, vertex in data.landmarks.items()}, []
    for k in args.only if args.only is not None else range(len(bodies)):
        rng = np.random.default_rng(k)
        view = half_view(data.template.with_vertices(bodies[k]), k, data.landmarks, rng)
        places = {name_of[vertex]: place for vertex, place in zip(*view.landmarks, strict=True)}
        first, second = rng.choice(list(places), 2, replace=False)
        cases = {"as they are": (places, set()),
                 "left and right exchanged": ({other_side(n) or n: place for n, place in places.items()}, {EXCHANGED}),
                 "one elsewhere": ({**places, first: places[second]}, {str(first)})}
        cpu = time.process_time()
        found = complete(subject, view.points, None, config)
        cpu = time.process_time() - cpu
        at = {name: found.completed.vertices[vertex] for name, vertex in data.landmarks.items()}
        for case, (clicked, wrong) in cases.items():
            pairs = np.array([data.landmarks[name] for name in clicked]), np.array(list(clicked.values()))
            done = complete(subject, view.points, pairs, config)
            told = {EXCHANGED} if landmark_doubts(clicked, at).startswith(EXCHANGED) else set(wrong_ones(clicked, at))
            rows.append({"k": k, "case": case, "verdict": done.judgement.verdict, "without": found.judgement.verdict,
                         "told": sorted(told), "right": told == wrong, "cpu_s": cpu})
            print(rows[-1], flush=True)
    if args.output:
        write_report(args.output, {"machine": machine(), "rows": rows})


if __name__ == "__main__":
    main()
