"""The folder in which `scape complete` leaves a completion."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from scanprep.geometry import storage
from scanprep.geometry.files import read_mesh, write_mesh

from .completion import Completion

KIND, VERSION = "completion", 2       # 1 had no scale, expected error and confidence
_ARRAYS = ("pose", "betas", "trans", "seen", "expected_error", "confidence")
_FACTS = ("rms", "explained", "landmark_rms", "converged", "iterations")


def save_completion(folder: str | Path, completion: Completion) -> Path:
    """Write `completed.ply`, `predicted.ply` and `completion.npz` (the arrays and figures).

    Returns
    -------
    The folder. `completion.npz` is written last, so where it is, the meshes are too.
    """
    folder = Path(folder)
    write_mesh(folder / "completed.ply", completion.completed)
    write_mesh(folder / "predicted.ply", completion.predicted)
    arrays = {name: getattr(completion, name) for name in _ARRAYS if getattr(completion, name) is not None}
    facts = {name: getattr(completion, name) for name in (*_FACTS, "energies", "scale")}
    storage.save(folder / "completion.npz", KIND, VERSION, arrays, facts)
    return folder


def load_completion(folder: str | Path) -> Completion:
    """Read a folder of `save_completion`.

    Raises
    ------
    StorageError, MeshFileError
        A file that is missing, damaged or of another kind.
    """
    folder = Path(folder)
    header, arrays = storage.load(folder / "completion.npz", KIND, (1, VERSION))
    try:
        return Completion(read_mesh(folder / "completed.ply", unit="m"), read_mesh(folder / "predicted.ply", unit="m"),
                          arrays["pose"], arrays.get("betas"), arrays["trans"], np.asarray(arrays["seen"], dtype=bool),
                          **{name: header[name] for name in (*_FACTS, "energies")},
                          scale=header["scale"] if header["version"] > 1 else 1.0,
                          expected_error=arrays.get("expected_error"), confidence=arrays.get("confidence"))
    except KeyError as error:
        raise storage.StorageError(f"{folder / 'completion.npz'}: it lacks {error}") from None
