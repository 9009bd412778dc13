"""Muscles and folds: where the surface rises or sinks, and which angle of which joint makes it do so."""
from __future__ import annotations

import json
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ..geometry import rotations
from .anatomy import RestFrames
from .topology import blending, load_topology

Put = Callable[[str, str, float], None]
_TABLES = json.loads(Path(__file__).with_name("muscles.json").read_text(encoding="utf-8"))
LIMB, TRUNK = _TABLES["limb"]["rows"], _TABLES["trunk"]["rows"]          # what the columns are stands in the file

def _columns() -> list[tuple[str, str]]:
    limbs = [(name, side) for name, *_ in LIMB for side in "lr"]
    trunk = [(name, side) for name, paired, *_ in TRUNK for side in ("lr" if paired else "m")]
    return limbs + trunk


COLUMNS = {key: i for i, key in enumerate(_columns())}


@lru_cache(maxsize=1)
def masks() -> np.ndarray:
    """(N, muscles) rise in metres of every vertex at full action of every muscle."""
    template = load_topology()
    v, a = template.mesh.vertices, template.anatomy
    weights = blending()[0]
    columns = []
    for _, part, along, direction, wide, spread, height in LIMB:
        left = _limb_mask(v, a, weights, part, along, direction, wide, spread) * height
        columns += [left, left[template.mirror]]
    normals = template.mesh.vertex_normals
    for _, paired, facing, sideways, level, wx, wz, height in TRUNK:
        d = (v[:, 0] - sideways) / wx, (v[:, 2] - a.at(level)) / wz
        mask = np.exp(-0.5 * (d[0]**2 + d[1]**2)) * (1 - weights[:, [5, 6, 8, 9, 11, 14]].sum(axis=1))
        mask *= np.clip(0.5 - 0.9 * facing * normals[:, 1], 0, 1) if facing else 1
        columns += [mask * height] + ([mask[template.mirror] * height] if paired else [])
    return np.stack(columns, axis=1)


def _limb_mask(v: np.ndarray, a: RestFrames, weights: np.ndarray, part: int, along: float, direction: float,
               wide: float, spread: float) -> np.ndarray:
    axis = a.ends[part] - a.joints[part]
    length = np.linalg.norm(axis)
    axis = axis / length
    frame = {4: a.upper_arm_frame, 5: a.forearm_frame, 10: a.leg_frame, 11: a.leg_frame, 12: a.foot_frame}[part]
    local = v - a.joints[part]
    t = local @ axis
    angle = np.degrees(np.arctan2(local @ frame[0], local @ frame[1]))
    off = (angle - direction + 180) % 360 - 180
    near = weights[:, part] + weights[:, part - 1] * (part not in (4, 10))
    if part in (4, 10):
        near = near + weights[:, [0, 1, 2]].sum(axis=1) * (v[:, 0] > 0.05)
    if part in (4, 5, 10, 11):
        near = near + weights[:, part + 1]
    return np.exp(-0.5 * (((t - along * length) / wide)**2 + (off / spread)**2)) * np.clip(near, 0, 1)


def drivers(anatomy: RestFrames, axes: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """How far every muscle acts (muscles,) in a pose given by relative rotations (16, 3, 3); zero at rest."""
    s = anatomy.shape
    # muscles of men swell more, and so does the flesh of who is heavy
    strong = 1.15 if s.sex == "male" else 0.85
    soft = float(np.clip(1 + 0.35 * (s.betas[1] if len(s.betas) > 1 else 0.0), 0.45, 2.2))
    out = np.zeros(len(COLUMNS))

    def put(name: str, side: str, value: float) -> None:
        out[COLUMNS[name, side]] += anatomy.scale * value

    for side, sign, arm, leg in (("l", 1, 4, 10), ("r", -1, 7, 13)):
        flexion = _bend(axes, relative, arm, arm + 1)
        f = np.sin(np.clip(flexion, -0.5, 2.6) / 2) * 1.15
        put("biceps", side, strong * f)
        put("triceps", side, -0.5 * strong * f)
        put("elbow_fold", side, max(f, 0))
        put("olecranon", side, f)
        put("flexors", side, 0.8 * (0.5 * strong + 0.5 * soft) * f)
        change = relative[arm] @ axes[arm] - axes[arm]
        up, fore, across = change[2], -change[1], -sign * change[0]
        rotvec = rotations.log(relative[arm + 2])
        put("brachioradialis", side, -0.7 * sign * twist_about(rotvec, axes[arm + 1]) * strong)
        put("deltoid", side, strong * up / 1.3)
        put("shoulder_cap", side, up / 1.5)
        put("pectoral", side, strong * (0.8 * fore + 0.3 * across - 0.45 * up))
        put("scapula_in", side, -0.8 * up - 0.4 * fore)
        put("scapula_out", side, 0.8 * up + 0.3 * fore)
        put("lat", side, strong * 0.7 * up)
        put("trapezius", side, strong * 0.7 * up)
        _leg_drivers(put, side, sign, axes, relative, leg, strong, soft)
    spine = relative[1] @ relative[2] @ np.array([0, 0, 1.0])
    bend, lean = -spine[1], spine[0]
    put("belly", "m", soft * (0.8 * max(bend, 0) + 0.6 * min(bend, 0)))
    put("belly_fold", "m", soft * max(bend, 0))
    put("loin", "m", 0.8 * strong * max(-bend, 0) - 0.3 * max(bend, 0))
    put("upper_back", "m", 0.6 * max(bend, 0))
    put("flank", "l", soft * lean)
    put("flank", "r", -soft * lean)
    look = relative[3] @ np.array([0, -1.0, 0])
    put("sternomastoid", "l", -1.2 * look[0])
    put("sternomastoid", "r", 1.2 * look[0])
    put("throat", "m", -1.2 * soft * look[2])
    return out


def _bend(axes: np.ndarray, relative: np.ndarray, parent: int, part: int) -> float:
    """Change of the angle between two bones against rest, radians."""
    rest = np.arccos(np.clip(axes[parent] @ axes[part], -1, 1))
    return float(np.arccos(np.clip(axes[parent] @ relative[part] @ axes[part], -1, 1)) - rest)


def _leg_drivers(put: Put, side: str, sign: int, axes: np.ndarray, relative: np.ndarray, leg: int, strong: float,
                 soft: float) -> None:
    knee = _bend(axes, relative, leg, leg + 1)
    k = np.sin(np.clip(knee, 0, 2.6) / 2) * 1.15
    firm = 0.5 * strong + 0.5 * soft
    put("quadriceps", side, -0.6 * strong * k)
    put("hamstrings", side, firm * k)
    put("knee_cap", side, k)
    put("calf", side, firm * k)
    put("knee_hollow", side, 0.8 * soft * k)
    change = relative[leg] @ axes[leg] - axes[leg]
    fore, out = -change[1], sign * change[0]
    put("groin", side, soft * max(fore, 0))
    put("gluteus", side, -1.0 * max(fore, 0) * soft + 0.9 * strong * max(-fore, 0))
    put("buttock_fold", side, -0.6 * fore)
    put("gluteus_medius", side, strong * max(out, 0) + 0.6 * max(-out, 0))
    put("adductors", side, 0.7 * strong * out)
    point = _bend(axes, relative, leg + 1, leg + 2)
    put("calf", side, -0.7 * strong * point)
    put("soleus", side, -strong * point)
    put("shin", side, strong * max(point, 0))
    put("instep", side, max(point, 0))


def twist_about(rotvec: np.ndarray, axis: np.ndarray) -> float:
    """The angle of the part of a rotation that turns about an axis (swing-twist)."""
    q = Rotation.from_rotvec(rotvec).as_quat()
    return float(2 * np.arctan2(q[:3] @ axis, q[3])) if q[3] >= 0 else float(2 * np.arctan2(-q[:3] @ axis, -q[3]))
