"""The folder in which `scape complete` leaves a completion."""
from __future__ import annotations

from pathlib import Path
from typing import Any

from scanprep.geometry import storage
from scanprep.geometry.files import check_same_topology, read_mesh, write_mesh

from .completion import Completion

KIND, VERSION = "completion", 2       # 1 had no scale, expected error and confidence
_ARRAYS = ("pose", "betas", "trans", "seen", "expected_error", "confidence")
_FACTS = ("rms", "explained", "landmark_rms", "converged", "iterations")


def save_completion(folder: str | Path, completion: Completion) -> Path:
    """Write `completed.ply`, `predicted.ply` and `completion.npz` (the arrays and figures).

    Returns The folder. `completion.npz` is written last, so where it is, the meshes are too.
    """
    folder = Path(folder)
    write_mesh(folder / "completed.ply", completion.completed)
    write_mesh(folder / "predicted.ply", completion.predicted)
    arrays = {name: getattr(completion, name) for name in _ARRAYS if getattr(completion, name) is not None}
    facts = {name: getattr(completion, name) for name in (*_FACTS, "energies", "scale")}
    storage.save(folder / "completion.npz", KIND, VERSION, arrays, facts)
    return folder


def load_completion(folder: str | Path) -> Completion:
    """Read a folder of `save_completion`."""
    folder = Path(folder)
    path = folder / "completion.npz"
    header, arrays = storage.load(path, KIND, (1, VERSION))
    with storage.taking_apart(path, "a whole completion"):
        completed, predicted = (read_mesh(folder / f"{name}.ply", unit="m") for name in ("completed", "predicted"))
        check_same_topology(folder / "predicted.ply", predicted, folder / "completed.ply", completed)
        N = len(completed.vertices)
        shapes: dict[str, tuple[int | None, ...]] = {"pose": (None, 3), "betas": (None,), "trans": (3,), "seen": (N,),
                                                     "expected_error": (N,), "confidence": (N,)}
        found: dict[str, Any] = {name: storage.numbers(arrays, name, *shape, kinds="b" if name == "seen" else "f")
                                 for name, shape in shapes.items()
                                 if name in arrays or name in ("pose", "trans", "seen")}
        facts: dict[str, Any] = {name: float(header[name]) for name in ("rms", "explained", "landmark_rms")}
        return Completion(completed, predicted, **{"betas": None, **found}, **facts,
                          converged=bool(header["converged"]), iterations=int(header["iterations"]),
                          energies={name: float(value) for name, value in header["energies"].items()},
                          scale=float(header["scale"]) if header["version"] > 1 else 1.0)
