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
            except storage.StorageError:
                header, a = {}, {}
            if header.get("key") != self.digest or header.get("first") != len(done):
                path.unlink()
                continue
            self.problems = header["problems"]
            betas = a["betas"] if header["shaped"] else None
            done += [TrackedFrame(len(done) + i, *(_plain(a[name][i]) for name in _ARRAYS))
                     for i in range(len(a["x"]))]
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
