"""Muscles and skin folds: where the surface rises or sinks, and which joint angle drives it."""
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
# tables of muscles: place, extent and height of the rise; the file explains its columns
_TABLES = json.loads(Path(__file__).with_name("muscles.json").read_text(encoding="utf-8"))
LIMB, TRUNK = _TABLES["limb"]["rows"], _TABLES["trunk"]["rows"]


def _columns() -> list[tuple[str, str]]:
    """List all muscles as name and side: l, r, or m in the middle."""
    limbs = [(name, side) for name, *_ in LIMB for side in "lr"]
    trunk = [(name, side) for name, paired, *_ in TRUNK for side in ("lr" if paired else "m")]
    return limbs + trunk


# muscle and side -> column of `masks`
COLUMNS = {key: i for i, key in enumerate(_columns())}


@lru_cache(maxsize=1)
def masks() -> np.ndarray:
    """Compute the rise (N, muscles) in metres of every vertex at full action of every muscle."""
    template = load_topology()
    vertices, anatomy = template.mesh.vertices, template.anatomy
    weights = blending()[0]
    columns = []
    # muscles of limbs; the right side mirrors the left
    for _, part, along, direction, wide, spread, height in LIMB:
        left = _limb_mask(vertices, anatomy, weights, part, along, direction, wide, spread) * height
        columns += [left, left[template.mirror]]
    normals = template.mesh.vertex_normals
    # muscles of the trunk: Gaussian spots, without arms and legs, on the front or back only
    for _, paired, facing, sideways, level, wx, wz, height in TRUNK:
        d = (vertices[:, 0] - sideways) / wx, (vertices[:, 2] - anatomy.at(level)) / wz
        mask = np.exp(-0.5 * (d[0]**2 + d[1]**2)) * (1 - weights[:, [5, 6, 8, 9, 11, 14]].sum(axis=1))
        mask *= np.clip(0.5 - 0.9 * facing * normals[:, 1], 0, 1) if facing else 1
        columns += [mask * height] + ([mask[template.mirror] * height] if paired else [])
    return np.stack(columns, axis=1)


def _limb_mask(vertices: np.ndarray, rest: RestFrames, weights: np.ndarray, part: int, along: float, direction: float,
               wide: float, spread: float) -> np.ndarray:
    """Compute the Gaussian weight (N,) of a muscle along a limb and around it."""
    axis = rest.ends[part] - rest.joints[part]
    length = np.linalg.norm(axis)
    axis = axis / length
    frame = {4: rest.upper_arm_frame, 5: rest.forearm_frame, 10: rest.leg_frame, 11: rest.leg_frame,
             12: rest.foot_frame}[part]
    local = vertices - rest.joints[part]
    position = local @ axis
    angle = np.degrees(np.arctan2(local @ frame[0], local @ frame[1]))
    off = (angle - direction + 180) % 360 - 180
    # vertices that the part carries, and those that it shares with its neighbours
    near = weights[:, part] + weights[:, part - 1] * (part not in (4, 10))
    if part in (4, 10):
        near = near + weights[:, [0, 1, 2]].sum(axis=1) * (vertices[:, 0] > 0.05)
    if part in (4, 5, 10, 11):
        near = near + weights[:, part + 1]
    return np.exp(-0.5 * (((position - along * length) / wide)**2 + (off / spread)**2)) * np.clip(near, 0, 1)


def drivers(anatomy: RestFrames, axes: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """Compute how far every muscle acts, (muscles,), for relative rotations (16, 3, 3); zero at rest."""
    shape = anatomy.shape
    # muscles of men swell more; soft tissue of heavy people does
    strong = 1.15 if shape.sex == "male" else 0.85
    soft = float(np.clip(1 + 0.35 * (shape.betas[1] if len(shape.betas) > 1 else 0.0), 0.45, 2.2))
    out = np.zeros(len(COLUMNS))

    def act(name: str, side: str, value: float) -> None:
        """Add to the action of a muscle."""
        out[COLUMNS[name, side]] += anatomy.scale * value

    # arms: the elbow angle drives the upper arm, the raised arm the shoulder, the turned hand the forearm
    for side, sign, arm, leg in (("l", 1, 4, 10), ("r", -1, 7, 13)):
        flexion = _bend(axes, relative, arm, arm + 1)
        f = np.sin(np.clip(flexion, -0.5, 2.6) / 2) * 1.15
        act("biceps", side, strong * f)
        act("triceps", side, -0.5 * strong * f)
        act("elbow_fold", side, max(f, 0))
        act("olecranon", side, f)
        act("flexors", side, 0.8 * (0.5 * strong + 0.5 * soft) * f)
        # how far the upper arm has moved: up, forwards and across the chest
        change = relative[arm] @ axes[arm] - axes[arm]
        up, fore, across = change[2], -change[1], -sign * change[0]
        rotvec = rotations.log(relative[arm + 2])
        act("brachioradialis", side, -0.7 * sign * twist_about(rotvec, axes[arm + 1]) * strong)
        act("deltoid", side, strong * up / 1.3)
        act("shoulder_cap", side, up / 1.5)
        act("pectoral", side, strong * (0.8 * fore + 0.3 * across - 0.45 * up))
        act("scapula_in", side, -0.8 * up - 0.4 * fore)
        act("scapula_out", side, 0.8 * up + 0.3 * fore)
        act("lat", side, strong * 0.7 * up)
        act("trapezius", side, strong * 0.7 * up)
        _leg_drivers(act, side, sign, axes, relative, leg, strong, soft)
    # trunk: bending forwards folds the belly, leaning folds a flank
    spine = relative[1] @ relative[2] @ np.array([0, 0, 1.0])
    bend, lean = -spine[1], spine[0]
    act("belly", "m", soft * (0.8 * max(bend, 0) + 0.6 * min(bend, 0)))
    act("belly_fold", "m", soft * max(bend, 0))
    act("loin", "m", 0.8 * strong * max(-bend, 0) - 0.3 * max(bend, 0))
    act("upper_back", "m", 0.6 * max(bend, 0))
    act("flank", "l", soft * lean)
    act("flank", "r", -soft * lean)
    # neck: turning the head tightens a muscle on the other side
    look = relative[3] @ np.array([0, -1.0, 0])
    act("sternomastoid", "l", -1.2 * look[0])
    act("sternomastoid", "r", 1.2 * look[0])
    act("throat", "m", -1.2 * soft * look[2])
    return out


def _bend(axes: np.ndarray, relative: np.ndarray, parent: int, part: int) -> float:
    """Compute the change of the angle between two bones against rest, radians."""
    rest = np.arccos(np.clip(axes[parent] @ axes[part], -1, 1))
    return float(np.arccos(np.clip(axes[parent] @ relative[part] @ axes[part], -1, 1)) - rest)


def _leg_drivers(act: Put, side: str, sign: int, axes: np.ndarray, relative: np.ndarray, leg: int, strong: float,
                 soft: float) -> None:
    """Set the muscles of one leg: knee angle, hip movement and pointed foot."""
    knee = _bend(axes, relative, leg, leg + 1)
    bend = np.sin(np.clip(knee, 0, 2.6) / 2) * 1.15
    firm = 0.5 * strong + 0.5 * soft
    act("quadriceps", side, -0.6 * strong * bend)
    act("hamstrings", side, firm * bend)
    act("knee_cap", side, bend)
    act("calf", side, firm * bend)
    act("knee_hollow", side, 0.8 * soft * bend)
    # how far the thigh has moved forwards and outwards
    change = relative[leg] @ axes[leg] - axes[leg]
    fore, out = -change[1], sign * change[0]
    act("groin", side, soft * max(fore, 0))
    act("gluteus", side, -1.0 * max(fore, 0) * soft + 0.9 * strong * max(-fore, 0))
    act("buttock_fold", side, -0.6 * fore)
    act("gluteus_medius", side, strong * max(out, 0) + 0.6 * max(-out, 0))
    act("adductors", side, 0.7 * strong * out)
    point = _bend(axes, relative, leg + 1, leg + 2)
    act("calf", side, -0.7 * strong * point)
    act("soleus", side, -strong * point)
    act("shin", side, strong * max(point, 0))
    act("instep", side, max(point, 0))


def twist_about(rotvec: np.ndarray, axis: np.ndarray) -> float:
    """Compute the angle by which a rotation turns about an axis (swing-twist decomposition)."""
    q = Rotation.from_rotvec(rotvec).as_quat()
    return float(2 * np.arctan2(q[:3] @ axis, q[3])) if q[3] >= 0 else float(2 * np.arctan2(-q[:3] @ axis, -q[3]))
