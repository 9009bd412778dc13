"""Formats that MeshLab reads for us, in a process of its own, and formats that nobody reads."""
from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np

from . import storage
from .format_common import Contents, MeshFileError, polygons

MESHES = (".3ds", ".x3d", ".x3dv", ".wrl", ".ctm", ".qobj")
POINTS = (".e57", ".ptx")

# formats that are not read, with a program that converts them
_EXPORTS = {**dict.fromkeys((".las", ".laz"), "CloudCompare (File > Save as) makes PLY of it"),
            **dict.fromkeys((".fbx", ".blend", ".usd", ".usda", ".usdc", ".usdz"),
                            "Blender (File > Open or Import, then Export) makes GLB of it")}


def advice(ending: str) -> str:
    """Return advice for a file of an unsupported format; empty if there is none."""
    return f"; {_EXPORTS[ending]}" if ending in _EXPORTS else ""


def read(path: Path, data: bytes) -> Contents:
    """Read vertices, triangles and colours of a file with MeshLab.

    Some damaged files make its readers end the whole process, so they run in a separate one.
    """
    if path.suffix.lower() == ".gz":
        raise MeshFileError(f"{path}: a packed file of this format is not read here: unpack it first")
    seconds = 600  # timeout; a cloud of 2 GB takes 90 s
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "read.npz"
        command = [sys.executable, "-m", "scanprep.adapters.pymeshlab_filters", str(path.absolute()), str(made)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [*sys.path]))}
        try:
            done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True,
                                  timeout=seconds, stdin=subprocess.DEVNULL, check=False)
        except subprocess.TimeoutExpired:
            raise MeshFileError(f"{path}: MeshLab did not read it within {seconds} s") from None
        if done.returncode or not made.exists():
            reason = (done.stderr.strip().splitlines() or [f"it ended with code {done.returncode}"])[-1]
            raise MeshFileError(f"{path}: MeshLab cannot read it ({reason[:300]})")
        arrays = storage.load_arrays(made)
    vertices, corners = arrays["vertices"].astype(np.float64), arrays["faces"].astype(np.int64)
    names = tuple(zip(arrays["names"].tolist(), arrays["triangles"].tolist(), strict=True))
    if len(corners):
        warnings.warn(f"{path}: read through MeshLab; the order of its vertices may be another than in the file",
                      stacklevel=2)
    faces = polygons(path, np.full(len(corners), 3), corners.ravel(), len(vertices)) if len(corners) else None
    return Contents(vertices, faces, None, arrays.get("colors"), tuple((str(n), int(k)) for n, k in names if k))
