"""The scans of a folder, and the page of their completions."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

import numpy as np

from scanprep.console import Metric
from scanprep.pictures.page import Page
from scanprep.pipeline.scans import find_scans

from .work import Inputs

_STYLE = """.scan { display: grid; grid-template-columns: minmax(9rem, 1fr) 3fr; gap: 1rem; margin: 1.4rem 0; }
.scan img { width: 100%; } .scan p { margin: .2rem 0; }"""
MEANS = ("distance of the scan to the completed mesh, RMS", "scan points explained", "vertices with data")


def folder_inputs(folder: Path, landmarks: Path | None, masks: Path | None) -> dict[str, Inputs]:
    """The scans of a folder by name, with their landmarks and masks."""
    if masks is not None and not masks.is_dir():
        raise ValueError(f"--mask: expected a folder of masks for a folder of scans, there is none at {masks}")
    found = {}
    for task in find_scans(folder, landmarks):
        mine = sorted(p for p in masks.iterdir() if p.name.split(".")[0] == task.name) if masks else []
        found[task.name] = Inputs((task.scan,), task.landmarks, tuple(mine[:1]))
    return found


def summary(metrics: Mapping[str, Sequence[Metric]], fresh: int, count: int) -> list[Metric]:
    """The rows of the closing table."""
    rows = [Metric("scans completed", f"{len(metrics)} of {count}"), Metric("of them in this run", fresh)]
    for name in MEANS:
        found = [m for of_one in metrics.values() for m in of_one if m.name == name]
        if found:
            rows.append(Metric(f"{name}, mean", float(np.mean([float(m.value) for m in found])), found[0].unit))
    return rows


def folder_page(metrics: Mapping[str, Sequence[Metric]], failures: Sequence[str]) -> Page:
    """The page of all scans, those worst explained first."""
    page = Page(f"{len(metrics)} scans completed", "Worst first; each picture leads to the page of its scan.")
    if failures:
        page.section("Failed").table([(line,) for line in failures])

    def explained(name: str) -> float:
        return next((float(m.value) for m in metrics[name] if m.name == MEANS[1]), 0.0)

    for name in sorted(metrics, key=explained):
        told = "".join(f"<p>{escape(f'{m.name}: {m.text()} {m.unit}')}</p>" for m in metrics[name][:3])
        page.markup(f'<div class="scan"><div><a href="{escape(name)}/report.html"><b>{escape(name)}</b></a>{told}</div>'
                    f'<a href="{escape(name)}/report.html"><img src="{escape(name)}/picture.png" '
                    f'alt="{escape(name)}, completed"></a></div>', _STYLE)
    return page
