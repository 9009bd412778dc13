"""A folder of scans completed one after the other; what is finished is skipped when it is called again."""
from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from scanprep.pipeline.scans import find_scans
from scanprep.console import Metric, Outcome, Progress, plain, write_report
from scanprep.geometry import storage
from scanprep.geometry.files import MeshFileError
from scanprep.pictures.page import Page

from .work import Inputs, Work, complete_files

KEY = "inputs.json"
_STYLE = """.scan { display: grid; grid-template-columns: minmax(9rem, 1fr) 3fr; gap: 1rem; margin: 1.4rem 0; }
.scan img { width: 100%; } .scan p { margin: .2rem 0; }"""


@dataclass(frozen=True)
class Finished:
    """How the scans of a folder fared.

    Attributes
    ----------
    metrics : name of the scan -> its figures
    fresh : scans completed now
    failures : one line a scan that could not be completed
    """

    metrics: dict[str, dict[str, Any]]
    fresh: int
    failures: list[str]


def folder_inputs(folder: Path, landmarks: Path | None, masks: Path | None) -> dict[str, Inputs]:
    """The scans of a folder by name, with their landmarks and masks.

    Parameters
    ----------
    landmarks : Path, optional
        Folder of the landmark files; else `landmarks` in the folder, or the folder itself.
    masks : Path, optional
        Folder of the masks: a file belongs to the scan of its name.

    Raises
    ------
    ValueError
        No scans, no such folder of landmarks or masks.
    """
    if masks is not None and not masks.is_dir():
        raise ValueError(f"--mask: expected a folder of masks for a folder of scans, there is none at {masks}")
    found = {}
    for task in find_scans(folder, landmarks):
        mine = sorted(p for p in masks.iterdir() if p.name.split(".")[0] == task.name) if masks else []
        found[task.name] = Inputs((task.scan,), task.landmarks, tuple(mine[:1]))
    return found


def complete_folder(work: Work, scans: dict[str, Inputs], output: Path, key: Any, command: str,
                    progress: Progress | None = None) -> Finished:
    """Complete every scan into a folder of its name; one that fails stops no other.

    A scan is done again when its files, the model or the settings have changed. What is written takes its place when
    it is whole.

    Parameters
    ----------
    key : what JSON can hold
        The model and the settings.
    command : str
        For report.json.
    progress : callable, optional
        Called with (done, total).
    """
    output.mkdir(parents=True, exist_ok=True)
    tell = progress or (lambda done, total: None)
    fresh, failures, metrics = 0, [], {}
    tell(0, len(scans))
    for number, (name, inputs) in enumerate(scans.items(), 1):
        place, mark = output / name, fingerprint(inputs, key)
        if _known(place) != mark:
            try:
                _replace(work, inputs, place, mark, command)
                fresh += 1
            except (ValueError, OSError) as error:
                failures.append(" ".join(str(error).split()))
                tell(number, len(scans))
                continue
        metrics[name] = _figures(place)
        tell(number, len(scans))
    _index(output, metrics, failures)
    return Finished(metrics, fresh, failures)


def fingerprint(inputs: Inputs, key: Any) -> str:
    """Short text that changes with the files and the settings."""
    digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode())
    for path in (*inputs.scans, inputs.landmarks, *inputs.masks):
        digest.update(b"|" if path is None else file_digest(path).encode())
    return digest.hexdigest()[:24]


def file_digest(path: Path) -> str:
    """Of what a file holds; empty where it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


def summary(done: Finished, count: int) -> list[Metric]:
    """The rows of the closing table."""
    names = ("distance of the scan to the completed mesh, RMS", "scan points explained", "vertices with data")
    rows = [Metric("scans completed", f"{len(done.metrics)} of {count}"), Metric("of them in this run", done.fresh)]
    for name in names:
        found = [m[name] for m in done.metrics.values() if name in m]
        if found:
            rows.append(Metric(f"{name}, mean", float(np.mean([row["value"] for row in found])), found[0]["unit"]))
    return rows


def _known(place: Path) -> str | None:
    try:
        return json.loads((place / KEY).read_text(encoding="utf-8"))["inputs"]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _replace(work: Work, inputs: Inputs, place: Path, mark: str, command: str) -> None:
    """A scan completed beside its folder, which then takes its place."""
    start = time.perf_counter()
    with storage.writing_folder(place) as beside:
        metrics = complete_files(work, inputs, beside)
        write_report(Outcome(beside, metrics, {"complete": work.config}), command, time.perf_counter() - start)
        storage.write_json(beside / KEY, {"inputs": mark})


def _figures(place: Path) -> dict[str, Any]:
    try:
        rows = json.loads((place / "report.json").read_text(encoding="utf-8"))["metrics"]
        return {row["metric"]: row for row in rows}
    except (OSError, ValueError, KeyError, TypeError):
        raise MeshFileError(f"{place / 'report.json'}: cannot be read; remove the folder to have it made "
                            "anew") from None


def _index(output: Path, metrics: dict[str, dict[str, Any]], failures: Sequence[str]) -> None:
    """The page of all scans."""
    page = Page(f"{len(metrics)} scans completed", "Each picture leads to the page of its scan.")
    if failures:
        page.section("Failed").table([(line,) for line in failures])
    for name, rows in metrics.items():
        told = "".join(f"<p>{escape(row['metric'])}: {_shown(row)}</p>" for row in list(rows.values())[:3])
        page.markup(f'<div class="scan"><div><a href="{escape(name)}/report.html"><b>{escape(name)}</b></a>{told}</div>'
                    f'<a href="{escape(name)}/report.html"><img src="{escape(name)}/picture.png" '
                    f'alt="{escape(name)}, completed"></a></div>', _STYLE)
    page.write(output / "report.html")


def _shown(row: dict[str, Any]) -> str:
    value = row["value"]
    return escape(f"{value:.3g} {row['unit']}" if isinstance(value, float) else f"{value} {row['unit']}")


def settings_key(*parts: Any) -> Any:
    """Settings as JSON holds them."""
    return plain(list(parts))


def stale(output: Path) -> Iterator[Path]:
    """What a run that was killed left half made."""
    return output.glob(".*.part")
