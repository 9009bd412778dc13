"""Movement that no person has: falls without gravity, walks out of balance, a head below the feet."""
from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from model.linear import Subject
from scanprep.plausible import falls_otherwise, impossible_walk, upside_down
from scanprep.skeleton.roles import find_roles

from ..motion import Motion
from .gait.events import find_walk, locate_feet
from .joint_angles import anatomical_angles

FEET = ("l_ankle", "r_ankle")


def pace_doubts(motion: Motion, subject: Subject, told: np.ndarray | None = None) -> tuple[str, ...]:
    """Return the doubts of the time in a motion: gravity in jumps, and balance in a walk.

    Parameters
    ----------
    motion, subject
        The body that moves.
    told : (T, J) bool, optional
        Parts that the markers determine, as of `find_told_parts`; a motion without feet tells nothing.

    Returns
    -------
    tuple of str
        None of a body that is no person's.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> still = Motion(np.zeros((60, 16, 3)), np.zeros((60, 3)), None, 30.0, np.zeros((60, 0)))
    >>> pace_doubts(still, load_built_in_model().subject())
    ()
    """
    roles = find_roles(subject.skeleton.names)
    if not _tells(roles, told) or len(motion.poses) < 2:
        return ()
    centres = subject.joints(motion.poses, motion.trans)
    try:
        angles = anatomical_angles(motion, subject, centres)
    except ValueError:
        return ()
    up = angles.ground[:, 1]
    falls = measure_falls(centres.mean(axis=1) @ up, (centres[:, [roles[foot] for foot in FEET]] @ up).min(axis=1),
                          motion.rate)
    doubts = [falls_otherwise(falls)]
    # a walk at the rate of the file, or at a rate three, nine or 27 times as high
    heels, toes, leg = locate_feet(motion, subject, centres, angles)
    for times in (1, 3, 9, 27):
        walk = find_walk(heels, toes, leg, times * motion.rate)
        if walk:
            strikes = [times * time for time, _, kind in walk if kind == "strike"]
            offs = [(times * time, side) for time, side, kind in walk if kind == "off"]
            doubts.append(impossible_walk(2 * float(np.median(np.diff(strikes))),
                                            measure_balance(heels, leg, offs, motion.rate, times)))
            break
    return tuple(filter(None, doubts))


def posture_doubts(motion: Motion, subject: Subject, told: np.ndarray | None = None) -> tuple[str, ...]:
    """Return the doubt that a person stands upside down along an axis of the file; arguments as of `pace_doubts`.

    Files name no axis up, but their heights grow upwards. Somebody who lies along an axis does not stand on the soles.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> body = load_built_in_model().subject()
    >>> turned = np.zeros((9, 16, 3))
    >>> turned[:, 0, 0] = np.pi
    >>> posture_doubts(Motion(turned, np.zeros((9, 3)), None, 30.0, np.zeros((9, 0))), body)[0][:27]
    'the head is below the feet '
    """
    roles = find_roles(subject.skeleton.names)
    if not _tells(roles, told):
        return ()
    feet = [roles[foot] for foot in FEET]
    still = subject.joints(np.zeros((1, len(subject.skeleton.parents), 3)))[0]
    upright = still[roles["skullbase"]] - still[feet].mean(axis=0)
    centres = subject.joints(motion.poses, motion.trans)
    heights = centres[:, roles["skullbase"]] - centres[:, feet].mean(axis=1)
    ways = heights / np.linalg.norm(heights, axis=1, keepdims=True)
    mean = ways.mean(axis=0)
    axis = int(np.abs(mean).argmax())
    # within 25 degrees of the axis in the mean, and soles across the body: 0.97 to 1.0 of people who stand or walk
    soles = subject.skeleton.part_rotations(motion.poses)[:, feet] @ (upright / np.linalg.norm(upright))
    stands = float(np.median(np.einsum("tfd,td->tf", soles, ways).max(axis=1))) > 0.9
    if abs(mean[axis]) < 0.9 or not stands:
        return ()
    return tuple(filter(None, [upside_down(heights[:, axis], "xyz"[axis])]))


def _tells(roles: dict[str, int], told: np.ndarray | None) -> bool:
    """Tell whether a skeleton has a head and feet, and most frames determine them."""
    needed = [roles.get(name, -1) for name in (*FEET, "skullbase")]
    return min(needed) >= 0 and (told is None or bool((told[:, needed].mean(axis=0) > 0.5).all()))


def measure_falls(centre: np.ndarray, lowest: np.ndarray, rate: float) -> list[float]:
    """Measure the acceleration of falling in every jump, m/s².

    Parameters
    ----------
    centre, lowest : (T,) float, metres
        Heights of the middle of the body and of the lower ankle.
    rate : float, frames per second
        Of the heights.

    Examples
    --------
    >>> arc = np.maximum(0, 3.0 * np.arange(90) / 100 - 9.81 / 2 * (np.arange(90) / 100)**2)
    >>> np.round(measure_falls(1 + arc, 0.1 + arc, 100.0), 2)
    array([9.81])
    """
    # off the floor: the lower ankle 8 cm higher than while standing
    flies = np.concatenate([[False], lowest > np.percentile(lowest, 10) + 0.08, [False]])
    falls = list[float]()
    for begin, end in np.flatnonzero(np.diff(flies.astype(int))).reshape(-1, 2).tolist():
        path, times = centre[begin:end], np.arange(end - begin) / rate
        # a parabola of at least 4 cm on both sides of its top; on a step or a chair the feet rest, and it is none
        if end - begin < 6 or path.max() - max(path[0], path[-1]) < 0.04:
            continue
        shares, curves = [], []
        for heights in (path, lowest[begin:end]):
            curve = np.polyfit(times, heights, 2)
            shares.append(float(np.var(heights - np.polyval(curve, times)) / np.var(heights)))
            curves.append(float(-2 * curve[0]))
        if shares[0] < 0.01 and shares[1] < 0.1:
            falls.append(curves[0])
    return falls


def measure_balance(heels: np.ndarray, leg: float, offs: list[tuple[float, str]], rate: float, times: float) -> float:
    """Measure how far the extrapolated centre of mass is behind the standing heel, metres, in the median step.

    Parameters
    ----------
    heels : (T, 2) float, metres
        How far the left and the right heel are ahead of the pelvis.
    leg : float, metres
        Length of a leg.
    offs : list of (seconds, side)
        When feet leave the floor.
    rate : float, frames per second
        Of the heels.
    times : float
        How many times slower than a walk the motion is, for the smoothing.

    Notes
    -----
    The centre of mass is a pendulum over the standing foot: at speed v it gets v sqrt(l / g) farther (Hof et al. 2005).
    """
    smooth = gaussian_filter1d(heels, 0.05 * times * rate, axis=0, mode="nearest")
    speed, margins = -np.gradient(smooth, axis=0) * rate, list[float]()
    for time, side in offs:
        frame, standing = min(round(time * rate), len(heels) - 1), "lr".index(side) - 1
        # 1.2 legs: the height of the centre of mass
        margins.append(float(heels[frame, standing] - speed[frame, standing] * np.sqrt(1.2 * leg / 9.81)))
    return float(np.median(margins)) if margins else -np.inf
