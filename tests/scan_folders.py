"""Folders of tiny scans; started as a program it registers one: SCANS SET WORKERS."""
import signal
import sys
from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
from trees import tree

from scanprep import Mesh, write_landmarks, write_mesh
from scanprep.batch.pool import Workers
from scanprep.pipeline.prepare import PrepareConfig, prepare
from scanprep.pipeline.scan import ScanSettings
from scanprep.pipeline.scans import find_scans
from scanprep.registration.schedule import RegistrationConfig

MARKS = {"top": 0, "left": 1, "right": 2, "front": 3, "back": 4}
STAGES = tuple(replace(stage, nodes=40) for stage in RegistrationConfig().graph[4:6])        # the scans lie near
QUICK = PrepareConfig(ScanSettings(RegistrationConfig(STAGES)), min_poses=99, workers=Workers(1))


def ball(level=3, radii=(0.3, 0.2, 0.9)):
    vertices, faces = igl.icosahedron()
    vertices, faces = igl.upsample(vertices, faces.astype(np.int64), level)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return Mesh(vertices * radii, faces)


def write_scans(folder, template, count=3):
    rng = np.random.default_rng(1)
    for k in range(count):
        body = template.with_vertices(template.vertices * (1 + 0.1 * rng.normal(size=3)) + rng.normal(size=3))
        write_mesh(folder / f"body{k}.ply", body)
        write_landmarks(folder / f"body{k}.landmarks.json", {name: body.vertices[v] for name, v in MARKS.items()})
    rows = [f"body{k},{('anna', 'anna', 'ben')[k % 3]},{('female', 'female', 'male')[k % 3]}" for k in range(count)]
    (folder / "scans.csv").write_text("\n".join(["name,subject,sex", *rows]) + "\n")
    return folder


def contents(folder):
    """Path -> bytes of all files that must not depend on how a run went."""
    return tree(folder, "times.csv")


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)        # a shell ignores it for what it starts behind
    try:
        prepare(find_scans(sys.argv[1]), ball(), MARKS, Path(sys.argv[2]),
                replace(QUICK, workers=Workers(int(sys.argv[3]))))
    except KeyboardInterrupt:
        sys.exit(130)
