"""The rounds of a co-registration on disk, so that they go on where they were interrupted."""
from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scanprep.geometry import storage
from scanprep.geometry.mesh import Mesh

from ..body import BodyModel
from ..digests import digest
from ..files import load_model
from .config import CoregistrationConfig
from .single import ModelRegistration

KIND, VERSION = "model registration", 1
TABLE = "coregistration.csv"
_FIGURES = ("rms", "explained", "apart", "landmark_rms", "flipped", "score", "starts")


class RoundsFolder:
    """A `Store` in a folder: `ROUND/scans/NAME.npz`, `ROUND/model.npz`, and what it was begun with.

    Parameters
    ----------
    folder : path
    model : BodyModel
        The first model.
    names : names of the scans
    fingerprints : texts that change with the scans
        Work on a scan that has changed since is not found again, nor is what came of the model learned from it.
    config : CoregistrationConfig

    Raises
    ------
    ValueError
        The folder was begun with another model or other settings.
    """

    def __init__(self, folder: str | Path, model: BodyModel, names: Sequence[str], fingerprints: Sequence[str],
                 config: CoregistrationConfig) -> None:
        self.folder, self.faces = Path(folder), model.template.faces
        self.names, self.fingerprints = tuple(names), tuple(fingerprints)
        self._all = hashlib.sha256("\n".join(f"{n} {f}" for n, f in zip(names, fingerprints, strict=True)).encode()
                                   ).hexdigest()
        settings = dataclasses.asdict(dataclasses.replace(config, workers=0, rounds=0))
        begun = {"model": digest(model.template, model.vertices(model.pose_mean)[None], None), "settings": settings}
        path = self.folder / "begun.json"
        if path.exists():
            if storage.as_json(begun) != _read(path):
                raise ValueError(f"{self.folder}: the rounds were begun with another model or other settings; "
                                 "name another folder, or remove it")
        else:
            storage.write_json(path, begun)

    def _place(self, turn: int, name: str) -> Path:
        return self.folder / f"{turn + 1}" / "scans" / f"{name}.npz"

    def _rests_on(self, turn: int, scan: int) -> str:
        """What must not have changed: the scan, and from the second round on all that taught the model."""
        return self.fingerprints[scan] if turn == 0 else self._all

    def found(self, turn: int, scan: int) -> ModelRegistration | None:
        """What is kept of a scan in a round, unless the scan has changed since."""
        path = self._place(turn, self.names[scan])
        if not path.exists():
            return None
        header, a = storage.load(path, KIND, (VERSION,))
        if header["rests_on"] != self._rests_on(turn, scan):
            return None
        figures: dict[str, Any] = {name: np.nan if header[name] is None else header[name] for name in _FIGURES}
        return ModelRegistration(Mesh(a["mesh"], self.faces), Mesh(a["predicted"], self.faces), a["pose"], a["trans"],
                                 a.get("betas"), a["seen"], a["distances"], confidence=a["confidence"], **figures)

    def keep(self, turn: int, scan: int, registration: ModelRegistration) -> None:
        """Write what came of a scan in a round."""
        r = registration
        arrays = {"mesh": r.mesh.vertices, "predicted": r.predicted.vertices, "pose": r.pose, "trans": r.trans,
                  "seen": r.seen, "distances": r.distances, "confidence": r.confidence}
        if r.betas is not None:
            arrays["betas"] = r.betas
        header = {name: None if np.isnan(getattr(r, name)) else getattr(r, name) for name in _FIGURES}
        storage.save(self._place(turn, self.names[scan]), KIND, VERSION, arrays,
                     {**header, "rests_on": self._rests_on(turn, scan)})

    def model(self, turn: int) -> BodyModel | None:
        """What was learned in a round, unless scans have changed or come since."""
        mark, path = self.folder / f"{turn + 1}" / "scans.json", self.folder / f"{turn + 1}" / "model.npz"
        if not mark.exists() or _read(mark) != self._all:
            return None
        return load_model(path)

    def keep_model(self, turn: int, model: BodyModel) -> None:
        """Write what was learned in a round."""
        model.save(self.folder / f"{turn + 1}" / "model.npz")
        storage.write_json(self.folder / f"{turn + 1}" / "scans.json", self._all)


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise storage.StorageError(f"{path}: expected JSON, cannot read it ({error})") from None


def write_table(path: Path, names: Sequence[str], registrations: Sequence[ModelRegistration], good: np.ndarray
                ) -> None:
    """A row of figures for every scan, in metres."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["name", "good", *_FIGURES])
    for name, fine, r in zip(names, good, registrations, strict=True):
        table.writerow([name, bool(fine), *(getattr(r, figure) for figure in _FIGURES)])
    with storage.writing(path) as beside:
        beside.write_text(text.getvalue(), encoding="utf-8")
