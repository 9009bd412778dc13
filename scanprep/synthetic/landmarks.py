"""Anatomical landmarks and motion-capture markers as vertices of the shared topology."""
from __future__ import annotations

from functools import lru_cache

import numpy as np

from .topology import load


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

    def limb(part: int, along: float, out: float, front: float) -> np.ndarray:
        frame = {4: fu, 5: ff, 6: ff, 10: fl, 11: fl}[part]
        return j[part] + along * (e[part] - j[part]) + g * (out * frame[0] + front * frame[1])

    def foot(side: float, up: float, ahead: float) -> np.ndarray:
        place = j[12] + a.width["foot"] * (side * ft[0] + ahead * ft[2])
        return np.array([place[0], place[1], up * a.width["foot"]])

    return {
        "{} toe": foot(-0.113, 0.05, 0.79), "{} heel": foot(0, 0.10, -0.22), "{} ankle": limb(11, 0.98, 0.05, 0),
        "{} knee": limb(10, 0.99, 0, 0.075), "{} knee inside": limb(10, 1.0, -0.07, 0),
        "{} waist": body(0.17, 0, 0.38), "crotch": body(0, 0.0, -0.26),
        "{} middle finger": limb(6, 1.0, -0.017, 0.013),
        "{} thumb": limb(6, 0.55, -0.016, 0.068), "{} wrist": limb(5, 1.0, 0.03, 0),
        "{} elbow outside": limb(5, 0.0, 0.03, -0.05), "{} elbow inside": limb(5, 0.0, -0.0, 0.06),
        "{} shoulder": limb(4, -0.05, 0.07, 0.0) + [0, 0, 0.03], "{} armpit": limb(4, 0.22, -0.06, 0.0),
        "{} nipple": body(0.080, 0.16, 0.69), "navel": body(0, 0.14, 0.27), "back": body(0, -0.12, 0.27),
        "neck front": body(0, 0.06, 1.0), "neck back": body(0, -0.12, 1.09), "{} eye": face(0.0315, 0.10, 0.0),
        "nose tip": face(0, 0.13, -0.036), "mouth": face(0, 0.11, -0.063), "chin": face(0, 0.11, -0.097),
        "{} ear": face(0.095, -0.008, -0.010), "top of head": face(0, -0.01, 0.13), "{} hip": body(0.19, 0, 0.0),
        # motion-capture only
        "{} forehead": face(0.055, 0.09, 0.045), "{} back of head": face(0.06, -0.09, 0.030),
        "T10": body(0, -0.13, 0.62), "sternum": body(0, 0.13, 0.70), "{} scapula": body(0.09, -0.15, 0.75),
        "{} front waist": body(0.115, 0.12, 0.16), "{} back waist": body(0.055, -0.13, 0.14),
        "{} thigh": limb(10, 0.60, 0.09, 0.02), "{} outer knee": limb(10, 1.0, 0.07, 0.0),
        "{} shin": limb(11, 0.45, 0.06, 0.02), "{} fifth toe": foot(0.15, 0.09, 0.47),
        "{} first toe": foot(-0.11, 0.13, 0.52), "{} upper arm": limb(4, 0.55, 0.06, 0.0),
        "{} outer elbow": limb(5, 0.0, 0.055, -0.01), "{} forearm": limb(5, 0.5, 0.05, 0.0),
        "{} wrist thumb": limb(5, 1.0, 0.0, 0.045), "{} wrist little": limb(5, 1.0, 0.0, -0.045),
        "{} knuckle": limb(6, 0.48, 0.03, 0.011),
    }


_MARKERS = {
    "FHD": "{} forehead", "BHD": "{} back of head", "SHO": "{} shoulder", "UPA": "{} upper arm",
    "ELB": "{} outer elbow",
    "FRM": "{} forearm", "WRA": "{} wrist thumb", "WRB": "{} wrist little", "FIN": "{} knuckle",
    "FWT": "{} front waist", "BWT": "{} back waist", "THI": "{} thigh", "KNE": "{} outer knee", "SHN": "{} shin",
    "ANK": "{} ankle", "HEE": "{} heel", "MT5": "{} fifth toe", "TOE": "{} first toe",
}
_MIDDLE_MARKERS = {"C7": "neck back", "T10": "T10", "CLAV": "neck front", "STRN": "sternum"}


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
    names = list(_points())
    names = names[:names.index("{} forehead")]
    return {full: _vertices()[full] for name in names
            for full in ([name.format("left"), name.format("right")] if "{}" in name else [name])}


def markers() -> dict[str, int]:
    """Label -> vertex of a set of 41 motion-capture markers, labelled as in the CMU recordings."""
    out = {side[0].upper() + label: _vertices()[name.format(side)]
           for label, name in _MARKERS.items() for side in ("left", "right")}
    out.update({label: _vertices()[name] for label, name in _MIDDLE_MARKERS.items()})
    out["RBAC"] = _vertices()["right scapula"]
    return out
