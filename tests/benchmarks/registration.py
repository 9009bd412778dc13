"""Registration of mesh000 to virtual four-view scans of real bodies: accuracy beside time.

    SCAPEKIT_DATA=... python tests/benchmarks/registration.py [--landmarks 10|21|36] [--poses 5,16] [--shapes 40]

Writes registration.json beside the call. What we lose at: with few landmarks, vertices slide along the limbs
and around the trunk of a person of other girth; the surface is right long before the correspondence is.
"""
from __future__ import annotations

import argparse
import json
import platform
import time
from pathlib import Path

import numpy as np
import scipy
from protocols import RealData, load_real
from scipy.spatial import cKDTree

from scanprep.geometry.surface import Surface
from scanprep.matching.nonrigid import register
from scanprep.scanning.scanner import ScannerConfig, scan

TEN = ("toe in right leg", "toe in left leg", "knee in right leg", "knee in left leg", "middle finger right hand",
       "middle finger left hand", "elbow (outside) right arm", "elbow (outside) left arm", "top of head", "cornea")
FINE = ("mouse", "eye", "ear", "between", "waist", "tit", "hip", "neck (f", "bottom")
SETS = {"10": lambda name: name in TEN, "21": lambda name: not any(word in name for word in FINE),
        "36": lambda name: True}


def measure(data: RealData, body: np.ndarray, marks: np.ndarray, seed: int) -> dict[str, float]:
    """Register one virtual scan and compare with the truth; distances in millimetres."""
    truth = data.template.with_vertices(body)
    scanned = scan(truth, ScannerConfig(), np.random.default_rng(seed)).merged
    start = time.perf_counter(), time.process_time()
    found = register(data.template, scanned, (marks, body[marks]))
    wall, cpu = time.perf_counter() - start[0], time.process_time() - start[1]
    apart = 1e3 * np.linalg.norm(found.mesh.vertices - body, axis=1)
    surface = 1e3 * Surface(truth).closest(found.mesh.vertices).distances
    back = 1e3 * Surface(found.mesh).closest(body).distances
    data_here = cKDTree(scanned.vertices).query(body)[0] < 0.012
    return {"points": len(scanned.vertices), "correspondence_mm": apart.mean(),
            "correspondence_seen_mm": apart[data_here].mean(), "beyond_50mm": (apart > 50).mean(),
            "surface_mm": surface.mean(), "surface_seen_mm": surface[found.seen].mean(), "back_mm": back.mean(),
            "landmark_rms_mm": 1e3 * found.landmark_rms, "flipped": found.flipped,
            "converged": found.converged, "wall_s": wall, "cpu_s": cpu}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--landmarks", choices=SETS, default="10")
    parser.add_argument("--poses", default="1,5,16,20,36,45,60,70")
    parser.add_argument("--shapes", default="40,120")
    parser.add_argument("--out", default="registration.json")
    args = parser.parse_args()
    data = load_real()
    marks = np.array([vertex for name, vertex in data.landmarks.items() if SETS[args.landmarks](name)])
    rows = []
    for kind, bodies, chosen in (("pose", data.poses, args.poses), ("shape", data.shapes, args.shapes)):
        for i in (int(k) for k in chosen.split(",") if k):
            rows.append({"body": f"{kind}{i}", **{k: float(v) for k, v in measure(data, bodies[i], marks, i).items()}})
            print(" ".join(f"{k}={v:.2f}" if isinstance(v, float) else str(v) for k, v in rows[-1].items()), flush=True)
    versions = {"python": platform.python_version(), "numpy": np.__version__, "scipy": scipy.__version__,
                "machine": platform.machine()}
    Path(args.out).write_text(json.dumps({"landmarks": len(marks), "versions": versions, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
