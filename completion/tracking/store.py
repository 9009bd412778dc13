"""Tracked frames on the disk, so that an interrupted run goes on where it stopped."""
from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from scanprep.geometry import storage

from .tracker import TrackedFrame

KIND, VERSION = "tracked frames", 1
AT_ONCE = 25                         # frames in one file
_ARRAYS = ("x", "found", "residual", "explained", "gradient", "precision")


class FrameStore:
    """Finished frames in files of a few, in order.

    Parameters
    ----------
    folder : Path
    key : dict
        What the frames depend on; frames that were found with another key are removed.

    Attributes
    ----------
    problems : str, what was wrong with files of the frames loaded
    """

    def __init__(self, folder: Path, key: dict[str, Any]) -> None:
        self.folder = folder
        self.digest = hashlib.sha256(json.dumps(key, sort_keys=True, default=str).encode()).hexdigest()[:16]
        self.problems: list[str] = []
        self._waiting: list[TrackedFrame] = []

    def load(self) -> tuple[list[TrackedFrame], np.ndarray | None]:
        """The finished frames from the first on, and the betas they were found with."""
        done: list[TrackedFrame] = []
        betas = None
        for path in sorted(self.folder.glob("*.npz")):
            try:
                header, a = storage.load(path, KIND, (VERSION,))
                with storage.taking_apart(path, "frames that go on where the last file ended"):
                    if header["key"] != self.digest or header["first"] != len(done):
                        raise ValueError("of another run")
                    self.problems, P = list(header["problems"]), a["x"].shape[1]
                    fresh = [storage.numbers(a, name, len(a["x"]), *shape, finite=name not in ("residual", "explained"),
                                             kinds="b" if name == "found" else "f")
                             for name, shape in zip(_ARRAYS, ((P,), (), (), (), (P,), (P, P)), strict=True)]
                    betas = storage.numbers(a, "betas", None) if header["shaped"] else None
            except storage.StorageError:
                path.unlink()                    # found anew
                continue
            done += [TrackedFrame(len(done) + i, *map(_plain, values))
                     for i, values in enumerate(zip(*fresh, strict=True))]
        return done, betas

    def add(self, frame: TrackedFrame, betas: np.ndarray | None, problems: list[str]) -> None:
        """Keep a frame; it is written with others, and with all problems so far."""
        self._waiting.append(frame)
        if len(self._waiting) >= AT_ONCE:
            self.write(betas, problems)

    def write(self, betas: np.ndarray | None, problems: list[str]) -> None:
        """Write what waits."""
        if not self._waiting:
            return
        first, frames = self._waiting[0].number, self._waiting
        arrays = {name: np.stack([np.asarray(getattr(f, name)) for f in frames]) for name in _ARRAYS}
        storage.save(self.folder / f"{first:08d}.npz", KIND, VERSION,
                     {**arrays, "betas": np.zeros(0) if betas is None else betas},
                     {"key": self.digest, "first": first, "shaped": betas is not None, "problems": problems})
        self._waiting = []


def _plain(value: np.ndarray) -> Any:
    return value if np.ndim(value) else value.item()
