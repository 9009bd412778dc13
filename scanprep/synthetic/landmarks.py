"""Anatomical landmarks and motion-capture markers as vertices of the shared topology."""
from __future__ import annotations

import json
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from .topology import load


@lru_cache(maxsize=1)
def _load() -> dict[str, Any]:
    return json.loads(Path(__file__).with_name("landmarks.json").read_text(encoding="utf-8"))


@lru_cache(maxsize=1)
def _points() -> dict[str, np.ndarray]:
    """Places near the skin of the canonical body: middle ones, and left ones (named with {})."""
    a = load().anatomy
    g, h, eye = a.scale, a.head_scale, a.eye
    j, e = a.joints, a.ends
    fu, ff, fl, ft = a.upper_arm_frame, a.forearm_frame, a.leg_frame, a.foot_frame

    def body(side: float, front: float, level: float) -> np.ndarray:
        return np.array([side * g, -front * g, a.at(level)])

    def face(side: float, front: float, up: float) -> np.ndarray:
        return eye + np.array([side, -front, up]) * h

    def limb(part: int, along: float, out: float, front: float, higher: float = 0.0) -> np.ndarray:
        frame = {4: fu, 5: ff, 6: ff, 10: fl, 11: fl}[part]
        return j[part] + along * (e[part] - j[part]) + g * (out * frame[0] + front * frame[1]) + [0, 0, higher]

    def foot(side: float, up: float, ahead: float) -> np.ndarray:
        place = j[12] + a.width["foot"] * (side * ft[0] + ahead * ft[2])
        return np.array([place[0], place[1], up * a.width["foot"]])

    place: dict[str, Callable[..., np.ndarray]] = {"body": body, "face": face, "limb": limb, "foot": foot}
    return {name: place[kind](*numbers)
            for name, (kind, *numbers) in (_load()["landmarks"] | _load()["marker_places"]).items()}


@lru_cache(maxsize=1)
def _vertices() -> dict[str, int]:
    template = load()
    v = template.mesh.vertices
    middle = np.abs(v[:, 0]) < 1e-6
    found: dict[str, int] = {}
    for name, point in _points().items():
        d = np.linalg.norm(v - point, axis=1)
        if "{}" in name:
            left = int(d.argmin())
            found[name.format("left")], found[name.format("right")] = left, int(template.mirror[left])
        else:
            found[name] = int(np.where(middle, d, np.inf).argmin())
    return found


def landmarks() -> dict[str, int]:
    """Name -> vertex of the anatomical landmarks."""
    return {full: _vertices()[full] for name in _load()["landmarks"]
            for full in ([name.format("left"), name.format("right")] if "{}" in name else [name])}


def markers() -> dict[str, int]:
    """Label -> vertex of a set of 41 motion-capture markers, labelled as in the CMU recordings."""
    out = {side[0].upper() + label: _vertices()[name.format(side)]
           for label, name in _load()["markers"].items() for side in ("left", "right")}
    out.update({label: _vertices()[name] for label, name in _load()["middle_markers"].items()})
    out["RBAC"] = _vertices()["right scapula"]
    return out
