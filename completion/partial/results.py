"""The folder in which `scape complete` leaves a completion."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from scanprep.geometry import storage
from scanprep.geometry.files import read_mesh, write_mesh

from .completion import Completion

KIND, VERSION = "completion", 1
_ARRAYS, _FACTS = ("pose", "betas", "trans", "seen"), ("rms", "explained", "landmark_rms", "converged", "iterations")


def save_completion(folder: str | Path, completion: Completion) -> Path:
    """Write `completed.ply`, `predicted.ply` and `completion.npz` (pose, betas, trans, seen, figures).

    Returns
    -------
    The folder. `completion.npz` is written last, so where it is, the meshes are too.
    """
    folder = Path(folder)
    write_mesh(folder / "completed.ply", completion.completed)
    write_mesh(folder / "predicted.ply", completion.predicted)
    arrays = {name: getattr(completion, name) for name in _ARRAYS if getattr(completion, name) is not None}
    facts = {name: getattr(completion, name) for name in _FACTS}
    storage.save(folder / "completion.npz", KIND, VERSION, arrays, {**facts, "energies": completion.energies})
    return folder


def load_completion(folder: str | Path) -> Completion:
    """Read a folder of `save_completion`.

    Raises
    ------
    StorageError, MeshFileError
        A file that is missing, damaged or of another kind.
    """
    folder = Path(folder)
    header, arrays = storage.load(folder / "completion.npz", KIND, (VERSION,))
    try:
        return Completion(read_mesh(folder / "completed.ply", unit="m"), read_mesh(folder / "predicted.ply", unit="m"),
                          arrays["pose"], arrays.get("betas"), arrays["trans"], np.asarray(arrays["seen"], dtype=bool),
                          **{name: header[name] for name in (*_FACTS, "energies")})
    except KeyError as error:
        raise storage.StorageError(f"{folder / 'completion.npz'}: it lacks {error}") from None
