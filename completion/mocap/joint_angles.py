"""Joint angles of a moving body as defined by the International Society of Biomechanics (ISB).

Wu et al. 2002 (hip, ankle, spine), Wu et al. 2005 (shoulder, elbow, wrist), Grood and Suntay 1983 (knee). Axes of a
segment point forward (x), up or towards the trunk (y) and to the right (z). The table in the README has every joint
with its zero, its signs and substitutes for landmarks that a skeleton does not have.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from model.linear import Subject, check_subject
from scanprep.geometry import rotations
from scanprep.skeleton.roles import above, find_numbered_roles

from ..motion import Motion

# names of the three angles, without the side: (proximal segment, distal segment, sequence of axes, signs)
Definitions = Mapping[tuple[str, str, str], tuple[str, str, str, tuple[int, int, int]]]
_SIDED: Definitions = {
    ("hip_flexion", "hip_adduction", "hip_rotation"): ("pelvis", "thigh", "zxy", (1, 1, 1)),
    ("knee_angle", "knee_adduction", "knee_rotation"): ("thigh", "shank", "zxy", (-1, 1, 1)),
    ("ankle_angle", "ankle_inversion", "ankle_rotation"): ("shank", "foot", "zxy", (1, 1, 1)),
    ("arm_flex", "arm_add", "arm_rot"): ("trunk", "humerus", "zxy", (1, 1, 1)),
    ("shoulder_plane", "shoulder_elevation", "shoulder_rotation"): ("trunk", "humerus", "yxy", (1, -1, 1)),
    ("elbow_flex", "elbow_adduction", "forearm_pronation"): ("humerus", "forearm", "zxy", (1, 1, 1)),
    ("wrist_flex", "wrist_dev", "wrist_rotation"): ("forearm", "hand", "zxy", (1, 1, 1))}
_MIDDLE: Definitions = {
    ("pelvis_tilt", "pelvis_list", "pelvis_rotation"): ("ground", "pelvis", "zxy", (1, 1, 1)),
    ("lumbar_extension", "lumbar_bending", "lumbar_rotation"): ("pelvis", "trunk", "zxy", (1, 1, 1)),
    ("neck_extension", "neck_bending", "neck_rotation"): ("trunk", "head", "zxy", (1, 1, 1))}
ISB: Definitions = {**_MIDDLE, **_SIDED}
# segment: its proximal and distal joint
_LIMBS = {"thigh": ("hip", "knee"), "shank": ("knee", "ankle"), "foot": ("ankle", None),
          "humerus": ("shoulder", "elbow"), "forearm": ("elbow", "wrist"), "hand": ("wrist", None)}
_MIRROR = np.diag([1.0, 1.0, -1.0])  # turns a left joint into the right one that it mirrors
# Degrees that people reach, with the soft tissue between marker and bone; more is no human pose. Normal ranges of the
# American Academy of Orthopaedic Surgeons (1965), and 20 to 40 degrees more, as dancers and gymnasts have.
HUMAN = {"hip_flexion": (-50, 150), "hip_adduction": (-90, 60), "knee_angle": (-20, 170), "ankle_angle": (-80, 60),
         "elbow_flex": (-20, 170), "wrist_flex": (-110, 110), "lumbar_extension": (-120, 60),
         "lumbar_bending": (-60, 60), "neck_extension": (-90, 90)}
# degrees in the middle of what an angle can be, where that is far from 0: arms go forward up and on behind the head
_CENTRE = {"arm_flex": 60, "arm_add": -60, "forearm_pronation": 90}


@dataclass(frozen=True)
class Joint:
    """Three angles of one segment relative to another.

    `sequence` has the axes of intrinsic rotations, `signs` turn these into the ISB angles. A mirrored joint is first
    reflected to the other side of the body.
    """

    angles: tuple[str, str, str]
    proximal: str
    distal: str
    sequence: str
    signs: tuple[int, int, int]
    mirrored: bool


@dataclass(frozen=True, eq=False)
class SegmentAxes:
    """The segments of a person at rest: the part of each, and its axes (3, 3), columns forward, up, right."""

    axes: np.ndarray                 # of the whole body
    parts: dict[str, int]
    frames: dict[str, np.ndarray]
    hips: tuple[int, ...]            # joints whose middle is the position of the pelvis
    lines: dict[str, tuple[int, int, int]]       # segments along two joints, towards the first, by axis 1 or 2
    definitions: Definitions = field(default_factory=lambda: ISB)
    turns: Mapping[str, np.ndarray] = field(default_factory=dict)        # axes (3, 3) of another convention in these

    def move(self, R: np.ndarray, centres: np.ndarray, pelvis: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Compute the axes (T, 3, 3) of every segment from part rotations (T, J, 3, 3) and joint centres (T, J, 3).

        The pelvis lies along the line of the hip centres and a limb's segment along that of its two joints, as the
        rotations of parts answer to the skin around them; the turn about these lines is that of the part. A hand, which
        ends in no joint, goes with its forearm: its angles are those between the two parts. `pelvis` (T, 3, 3) are the
        turns of a pelvis whose landmarks were measured, of `follow_pelvis`.
        """
        axes = {name: R[:, part] @ self.frames[name] for name, part in self.parts.items()}
        for name, (near, far, column) in self.lines.items():
            line = centres[:, near] - centres[:, far]
            turn = _swing(axes[name][:, :, column], line / np.linalg.norm(line, axis=1, keepdims=True))
            for moved in {name, name.replace("forearm", "hand")} & axes.keys():
                axes[moved] = turn @ axes[moved]
        if pelvis is not None:
            axes["pelvis"] = pelvis @ self.frames["pelvis"]
        return axes | {name: axes[name] @ turn for name, turn in self.turns.items()}

    def joints(self) -> list[Joint]:
        """Return the joints whose two segments exist."""
        known = {"ground", *self.parts}
        whole = {distal for _, distal, *_ in _MIDDLE.values()}
        possible = [Joint(names, *rest, False) for names, rest in self.definitions.items() if rest[1] in whole]
        possible += [Joint((f"{a}_{side}", f"{b}_{side}", f"{c}_{side}"),
                           proximal if proximal in ("pelvis", "trunk") else f"{proximal}_{side}", f"{distal}_{side}",
                           sequence, signs, side == "l")
                     for side in "rl" for (a, b, c), (proximal, distal, sequence, signs) in self.definitions.items()
                     if distal not in whole]
        return [joint for joint in possible if {joint.proximal, joint.distal} <= known]

    def missing(self) -> tuple[str, ...]:
        """Return joints of people that this body does not have, such as "knee_r"."""
        known = {joint.distal for joint in self.joints()}
        wanted = ["trunk", "head", *(f"{name}_{side}" for side in "rl" for name in _LIMBS)]
        joint = {"trunk": "lumbar", "head": "neck"}
        joint |= {f"{name}_{side}": f"{ends[0]}_{side}" for side in "rl" for name, ends in _LIMBS.items()}
        return tuple(joint[name] for name in wanted if name not in known)


@dataclass(frozen=True, eq=False)
class JointAngles:
    """The joint angles of a motion, and the position of the pelvis, in the axes of the ground."""

    names: tuple[str, ...]
    degrees: np.ndarray              # (T, K), NaN where the markers do not determine an angle
    pelvis: np.ndarray               # (T, 3) metres, the middle of the hips
    ground: np.ndarray               # (3, 3) columns: its x, y (up) and z in the axes of the motion
    missing: tuple[str, ...]         # joints of people that this body does not have
    guessed: tuple[str, ...] = ()    # angles that the markers never determine, which are left out
    errors: np.ndarray | None = None         # (T, K) degrees, expected, root mean square, NaN as the angles
    signs: tuple[int, int, int] = (1, 1, 1)  # of the three angles of the pelvis against those of OpenSim

    @property
    def turns(self) -> Rotation:
        """Orientation (T) of the pelvis in the ground; where no marker tells, that of the nearest frame."""
        k = self.names.index("pelvis_tilt")
        known = np.flatnonzero(np.isfinite(self.degrees[:, k]))
        nearest = known[np.abs(np.arange(len(self.degrees))[:, None] - known).argmin(axis=1)]
        return Rotation.from_euler("ZXY", self.degrees[nearest, k:k + 3] * self.signs, degrees=True)

    def columns(self, rate: float) -> dict[str, np.ndarray]:
        """Return the columns (T,) of a table by name: time in seconds, angles in degrees, and their errors, if any."""
        out = {"time": np.arange(len(self.degrees)) / rate}
        for k, name in enumerate(self.names):
            out[name] = self.degrees[:, k]
            if self.errors is not None:
                out[f"{name}_sd"] = self.errors[:, k]
        return out

    def doubts(self) -> tuple[str, ...]:
        """Return reasons to look: angles that people do not have, with their frames, the longest first."""
        found = []
        for name, degrees in zip(self.names, self.degrees.T, strict=True):
            low, high = HUMAN.get(name.removesuffix("_l").removesuffix("_r"), (-np.inf, np.inf))
            # degrees of rounding and noise beyond are no news
            frames = np.flatnonzero((degrees < low - 1) | (degrees > high + 1))
            if len(frames):
                worst = degrees[frames[np.abs(degrees[frames] - 0.5 * (low + high)).argmax()]]
                found.append((len(frames), f"{name} of {worst:.0f} degrees in {len(frames)} frames from {frames[0]} to "
                              f"{frames[-1]}: people have {low} to {high}, so look at the limb there"))
        return tuple(reason for _, reason in sorted(found, reverse=True)[:3])


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of the angles of a motion of T frames besides the motion itself."""

    told: np.ndarray | None = None           # (T, J) bool: parts that the markers determine
    errors: np.ndarray | None = None         # (T, K) degrees, of `expect_angle_errors`
    zero: Mapping[str, np.ndarray] | None = None         # of `find_static_zero`
    segments: SegmentAxes | None = None      # by the convention of an `AngleConfig`, without it ISB
    pelvis: np.ndarray | None = None         # (T, 3, 3), of `follow_pelvis`


NOTHING_KNOWN = Known()


def anatomy(names: tuple[str, ...], parents: np.ndarray, joints: np.ndarray) -> SegmentAxes:
    """Find the segments of a person with joints (J, 3), metres, at rest.

    Raises
    ------
    ValueError
        Parts without the names of a person's.
    """
    roles = find_numbered_roles(names, joints)
    pair = next((p for p in (("l_hip", "r_hip"), ("l_shoulder", "r_shoulder")) if {*p} <= roles.keys()), None)
    low = [roles[r] for r in ("l_ankle", "r_ankle", "l_hip", "r_hip") if r in roles]
    high = [roles[r] for r in ("l_shoulder", "r_shoulder", "skullbase") if r in roles]
    if "humanoid_root" not in roles or pair is None or not low or not high:
        raise ValueError(f"joint angles are of people: expected parts named pelvis, thigh_left, ..., head, found "
                         f"{', '.join(names)}"[:300])
    # forward, up and right: up is the axis of the model nearest to the head, right is horizontal
    up = _nearest_axis(joints[high].mean(0) - joints[low].mean(0))
    right = joints[roles[pair[1]]] - joints[roles[pair[0]]]
    right = right - (right @ up) * up
    if not np.linalg.norm(right) > 1e-6:
        raise ValueError("joint angles: expected hips or shoulders beside each other at rest")
    right = right / np.linalg.norm(right)
    body, parts = np.stack([np.cross(up, right), up, right], axis=1), {"pelvis": roles["humanoid_root"]}

    # the trunk is the part that carries the arms, unless that is the pelvis
    chains = [above(parents, roles.get(f"{side}_sternoclavicular", roles[f"{side}_shoulder"]))[1:]
              for side in "lr" if f"{side}_shoulder" in roles]
    both = [j for j in chains[0] if all(j in chain for chain in chains)] if chains else []
    if both and both[0] != roles["humanoid_root"]:
        parts["trunk"] = both[0]
    if "skullbase" in roles:
        parts["head"] = roles["skullbase"]
    frames, lines = dict.fromkeys(parts, body), dict[str, tuple[int, int, int]]()
    if pair[0] == "l_hip":
        lines["pelvis"] = roles["r_hip"], roles["l_hip"], 2

    # limb segments with both joints; the last ones, without a distal joint, have the axes of the rest pose
    for side, (name, (start, end)) in product("rl", _LIMBS.items()):
        begin, stop = roles.get(f"{side}_{start}"), roles.get(f"{side}_{end}")
        if begin is None or (end is not None and stop is None):
            continue
        frame = body if name == "foot" else frames.get(f"forearm_{side}")
        if stop is not None:
            lines[f"{name}_{side}"] = begin, stop, 1
            frame = _long_axes(joints[begin] - joints[stop], body, by_front=start in ("shoulder", "elbow"))
            if name == "forearm":                            # thumbs point forward at rest: midway to pronation
                frame = frame @ _turn(1, np.pi / 2 if side == "r" else -np.pi / 2)
        if frame is not None:
            parts[f"{name}_{side}"], frames[f"{name}_{side}"] = begin, frame
    return SegmentAxes(body, parts, frames, tuple(roles[r] for r in ("l_hip", "r_hip") if r in roles), lines)


def _long_axes(long: np.ndarray, body: np.ndarray, by_front: bool) -> np.ndarray:
    """Build axes (3, 3), columns: y along a bone, towards the trunk; x forward, or z right, as far as y allows."""
    y = long / np.linalg.norm(long)
    kept = body[:, 0 if by_front else 2]
    kept = kept - (kept @ y) * y
    kept = kept / np.linalg.norm(kept)
    return np.stack([kept, y, np.cross(kept, y)] if by_front else [np.cross(y, kept), y, kept], axis=1)


def anatomical_angles(motion: Motion, subject: Subject, centres: np.ndarray, known: Known = NOTHING_KNOWN
                      ) -> JointAngles:
    """Compute the joint angles of a person in motion, whose joints are at `centres` (T, J, 3), metres.

    Angles between parts that the markers do not determine are NaN.

    Raises
    ------
    ValueError
        A body whose parts lack the names of a person's.
    """
    skeleton, segments = subject.skeleton, known.segments or person_segments(subject)
    R = skeleton.part_rotations(motion.poses)
    ground = ground_axes(segments.axes, R[:, segments.parts["pelvis"]])
    degrees = angles_of(segments, ground, segments.move(R, centres, known.pelvis), known.zero)
    pelvis = centres[:, list(segments.hips or (segments.parts["pelvis"],))].mean(axis=1) @ ground
    # an angle is determined in the frames that tell of both its segments
    joints = segments.joints()
    names = [name for joint in joints for name in joint.angles]
    for k, joint in enumerate(joints):
        ends = [segments.parts[one] for one in (joint.proximal, joint.distal) if one != "ground"]
        if known.told is not None:
            degrees[~known.told[:, ends].all(axis=1), 3 * k:3 * k + 3] = np.nan
    some = np.isfinite(degrees).any(axis=0)
    determined, guessed = (tuple(np.array(names)[which].tolist()) for which in (some, ~some))
    errors = None if known.errors is None else np.where(np.isfinite(degrees), known.errors, np.nan)[:, some]
    signs = next(joint.signs for joint in joints if joint.distal == "pelvis")
    return JointAngles(determined, degrees[:, some], pelvis, ground, segments.missing(), guessed, errors, signs)


def find_static_zero(motion: Motion, subject: Subject, known: Known = NOTHING_KNOWN) -> dict[str, np.ndarray]:
    """Find the zero of joint angles from a static trial: somebody who stands upright and still.

    Segments and pelvis are those of `known`.

    Returns
    -------
    {str: (3, 3) float}
        By the first angle of each joint, how its segments are turned against each other on average.
    """
    segments = known.segments or person_segments(subject)
    axes = segments.move(subject.skeleton.part_rotations(motion.poses), subject.joints(motion.poses, motion.trans),
                         known.pelvis)
    zero = {}
    for joint in segments.joints():
        if joint.proximal != "ground":
            zero[joint.angles[0]] = rotations.mean(axes[joint.proximal].swapaxes(1, 2) @ axes[joint.distal])
    return zero


def angle_doubts(motion: Motion, subject: Subject, told: np.ndarray) -> tuple[str, ...]:
    """Return the doubts of the joint angles that `told` (T, J) bool determines; none of a body that is no person's."""
    try:
        return anatomical_angles(motion, subject, subject.joints(motion.poses, motion.trans), Known(told)).doubts()
    except ValueError:
        return ()


def angle_table(motion: Motion, subject: Subject, known: Known = NOTHING_KNOWN) -> Any:
    """Compute the anatomical joint angles of a person in motion, by ISB, as a table of named columns.

    Parameters
    ----------
    motion : Motion
        Poses (T, J, 3) in radians.
    subject : Subject
        The body that moves, with the parts of a person.
    known : Known, optional
        Parts that the markers determine, errors, and segments of another convention than ISB. Other angles are NaN, or
        left out where they always are.

    Returns
    -------
    pandas.DataFrame, or {str: (T,) float} where pandas is not installed
        The columns of `anatomical_angles.csv`: "time" in seconds, and angles in degrees, such as "knee_angle_r", each
        with its expected error, "knee_angle_r_sd", if known.

    Raises
    ------
    ValueError
        A body whose parts lack the names of a person's.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> still = Motion(np.zeros((2, 16, 3)), np.zeros((2, 3)), None, 100.0, np.zeros((2, 0)))
    >>> table = angle_table(still, load_built_in_model().subject())
    >>> float(table["time"][1]), abs(float(table["lumbar_extension"][0])) < 1e-9
    (0.01, True)
    """
    centres = check_subject(subject).joints(motion.poses, motion.trans)
    return as_table(anatomical_angles(motion, subject, centres, known).columns(motion.rate))


def as_table(columns: dict[str, np.ndarray]) -> Any:
    """Return columns of equal length as a table of pandas, or as they are where it is not installed."""
    try:
        import pandas  # optional: nothing else here needs it
    except ImportError:
        return columns
    return pandas.DataFrame(columns)


def person_segments(subject: Subject) -> SegmentAxes:
    """Find the segments of a person at rest, by ISB; ValueError for parts without the names of a person's."""
    return anatomy(subject.skeleton.names, subject.skeleton.parents, rest_joints(subject))


def rest_joints(subject: Subject) -> np.ndarray:
    """Compute the joints (J, 3) of a person at rest, metres."""
    return subject.rest_skeleton.joints


def angles_of(found: SegmentAxes, ground: np.ndarray, axes: Mapping[str, np.ndarray],
              zero: Mapping[str, np.ndarray] | None = None) -> np.ndarray:
    """Compute joint angles (T, K), degrees, from the axes (T, 3, 3) of each segment, three for each joint in order.

    They are 0 where the joints are as in `zero`, of `find_static_zero`; without it where the axes agree.
    """
    columns = []
    for joint in found.joints():
        proximal = ground[None] if joint.proximal == "ground" else axes[joint.proximal]
        relative = proximal.swapaxes(1, 2) @ axes[joint.distal]
        if zero is not None and joint.angles[0] in zero:
            relative = relative @ zero[joint.angles[0]].T
        if joint.mirrored:
            relative = _MIRROR @ relative @ _MIRROR
        turns = np.array(joint.signs) * decompose(relative, joint.sequence, joint.distal.startswith("humerus"))
        centre = np.radians([_CENTRE.get(name[:-2], 0) for name in joint.angles])
        whole = joint.proximal == "ground"
        columns.append(unwrap_whole(turns, relative) if whole else rotations.wrap_angle(turns, centre))
    return np.degrees(np.concatenate(columns, axis=1))


def ground_axes(axes: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Find the axes (3, 3) of OpenSim's ground, columns x, y, z: y is up, x is where the person faces.

    Each is an axis of the motion. The body has `axes` (3, 3) at rest, its root the rotations R (T, 3, 3). The mean
    orientation counts, and for somebody who turns round the first frame.
    """
    mean = R.mean(axis=0)
    # 0.6: a person who leans less than 53 degrees on average stands along the model's own up axis
    up = axes[:, 1] if (mean @ axes[:, 1]) @ axes[:, 1] > 0.6 else _nearest_axis(mean @ axes[:, 1])
    ways = [way - (way @ up) * up for way in (mean @ axes[:, 0], R[0] @ axes[:, 0], R[0] @ axes[:, 1])]
    x = _nearest_axis(next((way for way in ways if np.linalg.norm(way) > 0.1), ways[-1]))
    return np.stack([x, up, np.cross(x, up)], axis=1)


def _nearest_axis(direction: np.ndarray) -> np.ndarray:
    """Return the signed coordinate axis nearest to a direction (3,)."""
    main = int(np.abs(direction).argmax())
    return np.eye(3)[main] * np.sign(direction[main])


def decompose(R: np.ndarray, sequence: str, beyond: bool = False) -> np.ndarray:
    """Decompose rotations R (T, 3, 3) into angles (T, 3), radians, about the axes of "zxy", "zyx" or "yxy".

    R = R_1(a) R_2(b) R_3(c). For "yxy", -b is between 0 and half a turn, as in ISB. For "zxy", b is within a quarter of
    a turn; `beyond` that, as an arm that is raised sideways goes, it continues without a jump where that is the smaller
    change. In gimbal lock, a stays as it was.
    """
    if sequence == "zyx":                # with x and y exchanged and z reversed that is "zxy"
        return decompose(R[:, [1, 0, 2]][:, :, [1, 0, 2]] * np.outer([1, 1, -1], [1, 1, -1]), "zxy") * [-1, 1, 1]
    if sequence == "zxy":
        lost = np.hypot(R[:, 0, 1], R[:, 1, 1])
        a, b = np.arctan2(-R[:, 0, 1], R[:, 1, 1]), np.arctan2(R[:, 2, 1], lost)
    else:
        lost = np.hypot(R[:, 0, 1], R[:, 2, 1])
        a, b = np.arctan2(-R[:, 0, 1], -R[:, 2, 1]), -np.arctan2(lost, R[:, 1, 1])
    # in gimbal lock take a from the last frame in which it is defined
    known = np.maximum.accumulate(np.where(lost > 1e-9, np.arange(len(R)), -1))
    a = np.where(known < 0, 0.0, a[known])
    left = _turn(0, -b) @ _turn(2 if sequence == "zxy" else 1, -a) @ R
    angles = np.stack([a, b, np.arctan2(left[:, 0, 2], left[:, 0, 0])], axis=1)
    return _smaller(angles) if beyond and sequence == "zxy" else angles


def unwrap_whole(angles: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Let angles (T, 3), radians, of a body that turns round go on beyond half a turn, while R (T, 3, 3) is continuous.

    Where it turns by more than a third of a turn from frame to frame they begin anew, within half a turn.
    """
    turned = rotations.log(R[1:] @ R[:-1].swapaxes(1, 2))
    breaks = np.flatnonzero(np.linalg.norm(turned, axis=1) > 2 * np.pi / 3) + 1
    return np.concatenate([np.unwrap(some, axis=0) for some in np.split(rotations.wrap_angle(angles), breaks)])


def _smaller(angles: np.ndarray) -> np.ndarray:
    """Choose between the two solutions of each frame: small angles (T, 3), radians, and small jumps (Viterbi)."""
    both = rotations.wrap_angle(np.stack([angles, angles * [1, -1, 1] + np.pi]))             # (2, T, 3)
    # 0.05: cost of large angles, small against that of a jump
    size = 0.05 * np.abs(both).sum(axis=2)
    jump = np.abs(np.exp(1j * both[:, None, 1:]) - np.exp(1j * both[None, :, :-1])).sum(axis=3)      # (2, 2, T - 1)
    cost, came = size[:, 0].tolist(), np.zeros((len(angles), 2), dtype=int)
    for t, (((a, b), (c, d)), (first, second)) in enumerate(zip(jump.transpose(2, 0, 1).tolist(), size.T[1:].tolist(),
                                                                strict=True), start=1):
        stay, back, onward, remain = cost[0] + a, cost[1] + c, cost[0] + b, cost[1] + d
        came[t] = back < stay, remain < onward
        cost = [min(stay, back) + first, min(onward, remain) + second]
    # trace the choices back from the last frame
    state, out = int(cost[1] < cost[0]), np.empty_like(angles)
    for t in range(len(angles) - 1, -1, -1):
        out[t], state = both[state, t], came[t, state]
    return out


def _swing(column: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Compute the smallest rotations (T, 3, 3) that turn unit vectors (T, 3) to others (T, 3)."""
    across = np.cross(column, line)
    sine, cosine = np.linalg.norm(across, axis=1), np.einsum("td,td->t", column, line)
    angle = np.arctan2(sine, cosine) / np.maximum(sine, 1e-12)
    return np.asarray(rotations.exp(angle[:, None] * across))


def _turn(axis: int, angle: np.ndarray | float) -> np.ndarray:
    """Compute rotations (..., 3, 3) by angles (...), radians, about a coordinate axis."""
    return rotations.exp(np.asarray(angle)[..., None] * np.eye(3)[axis])
