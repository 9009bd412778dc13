"""Gait events: when feet strike the floor and leave it, from the events of a C3D file or from the moving body."""
from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from model.linear import Subject
from scanprep.geometry import storage

from ...motion import Motion
from ..files.c3d import file_parameters, first_frame, point_table
from ..joint_angles import JointAngles, anatomy, rest_joints

Event = tuple[float, str, str]       # seconds from the first frame, "l" or "r", "strike" or "off"
FROM_FILE, FROM_FEET = "events of the recording", "feet of the body, ahead of and behind the pelvis"
# a walk, whoever walks: each foot leaves the floor after the other one has struck it
_WALK = (("l", "strike"), ("r", "off"), ("r", "strike"), ("l", "off"))
STRIDE = (0.5, 3.0)                  # seconds of a gait cycle: a hurried child, a patient with a walking frame
TURN = 30.0                          # degrees from the mean of a cycle: walkers turn the pelvis by 5 to 15
REACH = 0.25                         # of the leg: least way of a foot past the pelvis; 0.7 in a walk, less on the spot


@dataclass(frozen=True, eq=False)
class GaitEvents:
    """Events of a walk in order of time, gait cycles by side (n, 2), seconds from strike to strike, and the source."""

    events: tuple[Event, ...]
    cycles: dict[str, np.ndarray]
    source: str

    @property
    def cadence(self) -> float:
        """Steps per minute, from the median gait cycle."""
        return 120 / float(np.median(np.diff(np.concatenate(list(self.cycles.values())), axis=1)))


def find_gait_events(motion: Motion, subject: Subject, centres: np.ndarray, angles: JointAngles,
                     path: Path | None = None, who: str | None = None) -> GaitEvents | None:
    """Find the gait events of a motion; None for somebody who does not walk.

    Parameters
    ----------
    motion, subject
        The body that moves.
    centres : (T, J, 3) float, metres
        Its joint centres.
    angles : JointAngles
        Its joint angles.
    path : Path, optional
        The C3D file, whose own events are taken where they make a gait cycle.
    who : str, optional
        Prefix of the person's labels in the file.

    Notes
    -----
    Without events in the file, a foot strikes when its heel is farthest ahead of the pelvis, and leaves the floor when
    its toes are farthest behind (Zeni et al. 2008). Only events that follow each other as in a walk are kept.
    """
    if path is not None and path.suffix.lower() == ".c3d":
        try:
            events = [event for event in read_file_events(path, motion.rate, who) if 0 <= event[0] <= motion.times[-1]]
        except (ValueError, OverflowError) as problem:
            warnings.warn(f"{path.name}: its events cannot be read: {problem}", stacklevel=2)
            events = []
        strikes = [(time, side) for time, side, kind in events if kind == "strike"]
        cycles = _find_cycles(strikes)
        if any(map(len, cycles.values())):
            return GaitEvents(tuple(events), cycles, FROM_FILE)
    if not {"pelvis_tilt", "ankle_angle_l", "ankle_angle_r"} <= set(angles.names):
        return None
    heels, toes, leg = locate_feet(motion, subject, centres, angles)
    walk = find_walk(heels, toes, leg, motion.rate)
    cycles = {side: np.array([cycle for cycle in own if _goes_straight(angles, *(motion.rate * cycle))]).reshape(-1, 2)
              for side, own in _find_cycles([(time, side) for time, side, kind in walk if kind == "strike"]).items()}
    return GaitEvents(tuple(walk), cycles, FROM_FEET) if any(map(len, cycles.values())) else None


def read_file_events(path: Path, rate: float, who: str | None = None) -> list[Event]:
    """Read the foot strikes and foot offs in the EVENT group of a C3D file, in order of time.

    Times there count from the first frame of the recording, also in a file that was cut. `rate` is that of the motion.
    """
    data = storage.read_bytes(path, "a C3D file")
    table = point_table(path, data)
    parameters = file_parameters(data, table.numbers)
    labels, contexts, subjects = (list(map(str, parameters.get(("EVENT", name), ())))
                                  for name in ("LABELS", "CONTEXTS", "SUBJECTS"))
    times = [value for value in parameters.get(("EVENT", "TIMES"), ()) if isinstance(value, float)]
    start, out = first_frame(data, parameters) - 1, list[Event]()
    for i, label in enumerate(labels[:len(times) // 2]):
        # "Foot Strike" of the context "Left", "Left Heel Strike", or LHS
        context, subject = (words[i].lower() if i < len(words) else "" for words in (contexts, subjects))
        short = re.fullmatch(r"([lr])(?:([hf][sc]|ic)|[tf]o)", label.lower())
        side = re.search(r"\b(l|r)(?:eft|ight)\b", f"{context} {label.lower()}")
        strike = re.search(r"(foot|heel|initial)[ _-]?(strike|contact|on)", label.lower())
        away = re.search(r"(foot|toe)[ _-]?off", label.lower())
        of_other = bool(who and subject and any(map(str.strip, subjects)) and subject != who.lower().rstrip(":"))
        seconds = (60 * times[2 * i] + times[2 * i + 1]) * (table.rate or rate) - start
        if not of_other and np.isfinite(seconds) and (short or (side and (strike or away))):
            kind = "strike" if (short[2] if short else strike) else "off"
            out.append((seconds / rate, (short or side)[1], kind))  # type: ignore[index]
    return sorted(out)


def locate_feet(motion: Motion, subject: Subject, centres: np.ndarray, angles: JointAngles
                ) -> tuple[np.ndarray, np.ndarray, float]:
    """Compute how far heels and toes (T, 2), left and right, are ahead of the pelvis, and the length of a leg, metres.

    Ahead is where the pelvis faces, averaged over a step.
    """
    skeleton, rest = subject.skeleton, rest_joints(subject)
    segments, R = anatomy(skeleton.names, skeleton.parents, rest), skeleton.part_rotations(motion.poses)
    ahead = face_ahead(angles)
    ahead = gaussian_filter1d(ahead, 0.25 * motion.rate, axis=0, mode="nearest")
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    body, owner = subject.vertices(np.zeros((len(rest), 3))), skeleton.part_of_vertex(subject.template)
    ends = np.empty((2, len(R), 2))
    for i, side in enumerate("lr"):
        # the hindmost and the foremost vertex of a foot move with it
        part = segments.parts[f"foot_{side}"]
        foot = body[owner == part] - rest[part]
        along = foot @ segments.axes[:, 0]
        for k, vertex in enumerate((foot[along.argmin()], foot[along.argmax()])):
            place = (centres[:, part] + R[:, part] @ vertex) @ angles.ground - angles.pelvis
            ends[k, :, i] = (place * ahead).sum(axis=1)
    hip, ankle = (rest[segments.parts[f"{name}_l"]] for name in ("thigh", "foot"))
    return ends[0], ends[1], float(np.linalg.norm(hip - ankle))


def face_ahead(angles: JointAngles) -> np.ndarray:
    """Return the horizontal direction (T, 3) in which the pelvis faces, in the axes of the ground."""
    facing = angles.turns.as_matrix()[:, :, 0] * [1, 0, 1]
    return facing / np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-9)


def _goes_straight(angles: JointAngles, begin: float, end: float) -> bool:
    """Tell whether the pelvis turns less than `TURN` between two frames: no bend in the way, no jump, no dance."""
    pelvis = angles.turns[int(begin):int(np.ceil(end)) + 1]
    return bool((pelvis * pelvis.mean().inv()).magnitude().max() < np.radians(TURN))


def detect_events(heels: np.ndarray, toes: np.ndarray, leg: float, rate: float) -> list[Event]:
    """Return the extremes of heels and toes (T, 2) ahead of the pelvis, metres, as strikes and offs.

    Examples
    --------
    >>> swing = 0.35 * np.sin(2 * np.pi * (np.arange(300)[:, None] / 110 + [0, 0.5]))
    >>> [round(time, 2) for time, side, kind in detect_events(swing, swing, 0.9, 100.0) if side + kind == "lstrike"]
    [0.28, 1.38, 2.48]
    """
    out = list[Event]()
    for i, side in enumerate("lr"):
        for kind, places in (("strike", heels[:, i]), ("off", -toes[:, i])):
            # 0.02 s: below the 6 Hz at which gait is usually filtered
            smooth = gaussian_filter1d(places, 0.02 * rate, mode="nearest")
            # a heel strikes ahead of the pelvis; toes leave the floor behind it, or below it in a short step
            at, _ = find_peaks(smooth, prominence=REACH * leg, height=0.0 if kind == "strike" else None)
            out += [(float(t) / rate, side, kind) for t in at]
    return sorted(out)


def find_walk(heels: np.ndarray, toes: np.ndarray, leg: float, rate: float) -> list[Event]:
    """Return the events of heels and toes that follow each other as in a walk; arguments as of `detect_events`."""
    return _keep_walk(detect_events(heels, toes, leg, rate))


def _keep_walk(events: Iterable[Event]) -> list[Event]:
    """Return the events that follow each other as in a walk, over a gait cycle at least."""
    kept, bout = list[Event](), list[Event]()
    for event in [*events, (np.inf, "", "")]:
        place = _WALK.index(event[1:]) if event[1:] in _WALK else -1
        if bout and (_WALK.index(bout[-1][1:]) != (place - 1) % 4 or event[0] - bout[-1][0] > STRIDE[1] / 2):
            kept += bout if len(bout) > 4 else []
            bout = []
        bout.append(event)
    return kept


def _find_cycles(strikes: list[tuple[float, str]]) -> dict[str, np.ndarray]:
    """Return the gait cycles (n, 2) of each side: from a strike to the next, with the other side's between if any."""
    out = {}
    for side in "lr":
        own, other = (np.array([time for time, which in strikes if (which == side) is same]) for same in (True, False))
        pairs = [(a, b) for a, b in pairwise(own) if STRIDE[0] <= b - a <= STRIDE[1]
                 and (not len(other) or ((a < other) & (other < b)).sum() == 1)]
        out[side] = np.array(pairs).reshape(-1, 2)
    return out
