"""Expected errors of joint angles: what the markers leave open in the fit, carried to the angles."""
from __future__ import annotations

import numpy as np

from model.linear import Subject
from scanprep.geometry.rotations import wrap_angle
from scanprep.threads import one_thread

from ..motion import Motion
from .joint_angles import SegmentAxes, angles_of, ground_axes, person_segments
from .marker_sets.layout import MarkerLayout
from .pose.marked_body import MarkedBody

EVERY, AROUND = 0.05, 2              # seconds between computed frames, and how many of these tell of each other
WEAK = 0.003                         # weight of the pose prior: so weak that only markers determine an angle
LEAST = 0.004                        # metres: markers are no more exact than soft tissue
# Errors of markers on one segment go together, so a segment has fewer than it has markers. Degrees by which angles of a
# new person change otherwise than bones do, and by which their zero is off, which static trials tell.
TOGETHER, OF_THE_BODY, OF_THE_ZERO = 1.0, 1.2, 5.0


@one_thread()
def expect_angle_errors(motion: Motion, subject: Subject, layout: MarkerLayout, static: bool = False,
                        segments: SegmentAxes | None = None) -> np.ndarray | None:
    """Compute the expected error (T, K) of every joint angle of a person, degrees, root mean square; None of others.

    Parameters
    ----------
    motion : Motion
        Of T frames, found from the markers.
    subject : Subject
        The person.
    layout : MarkerLayout
        Where the markers sit on this person.
    static : bool
        The angles of joints are zero in a static trial, so the zero of the body does not count.
    segments : SegmentAxes, optional
        By the convention of an `AngleConfig`; without it ISB.

    Returns
    -------
    (T, K) float, degrees
        Three for each of `SegmentAxes.joints`, large where markers determine nothing.

    Examples
    --------
    >>> from completion import load_layout
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> layout = load_layout("cmu41", model)
    >>> motion = Motion(np.zeros((4, 16, 3)), np.zeros((4, 3)), None, 120.0, np.zeros((4, 41)), layout.labels)
    >>> expect_angle_errors(motion, model.subject(), layout).shape
    (4, 48)
    """
    try:
        segments = segments or person_segments(subject)
    except ValueError:
        return None
    columns, known = layout.match_columns(motion.labels)
    body = MarkedBody(subject, known, WEAK, 0.0)
    # some frames, and the information of their trusted markers
    frames = np.unique(np.r_[0:len(motion.poses):max(1, round(EVERY * motion.rate)), len(motion.poses) - 1])
    x = body.body.join(motion.poses[frames], motion.trans[frames])
    trusted = motion.trusted[np.ix_(frames, columns)]
    off = motion.residuals[motion.trusted]
    sd = max(LEAST, float(np.sqrt((off**2).mean() / 3)) if len(off) else LEAST)
    information = body.system(x, body.positions(x), trusted / sd**2).hessian
    # neighbours tell of a frame too, so gaps of a moment are bridged
    total = np.concatenate([np.zeros_like(information[:1]), np.cumsum(information, axis=0)])
    low, high = (np.clip(np.arange(len(x)) + step, 0, len(x)) for step in (-AROUND, AROUND + 1))
    information = (total[high] - total[low]) / (high - low)[:, None, None]
    rates = turn_angles(segments, subject, body, x)
    covariance = np.linalg.inv(information + 1e-6 * np.eye(x.shape[1]))
    error = TOGETHER * np.sqrt(np.einsum("tpk,tpq,tqk->tk", rates, covariance, rates, optimize=True))
    zero = [0.0 if static and joint.proximal != "ground" else OF_THE_ZERO for joint in segments.joints()]
    error = np.hypot(np.degrees(error), np.hypot(OF_THE_BODY, np.repeat(zero, 3)))
    every = np.arange(len(motion.poses))
    return np.stack([np.interp(every, frames, column) for column in error.T], axis=1)


def turn_angles(segments: SegmentAxes, subject: Subject, body: MarkedBody, x: np.ndarray) -> np.ndarray:
    """Compute the derivatives (S, P, K) of joint angles, radians, by small steps of the unknowns x (S, P)."""
    step = 1e-4
    ground = ground_axes(segments.axes, subject.skeleton.part_rotations(body.body.split(x)[0])[:, 0])

    def angles(moved: np.ndarray) -> np.ndarray:
        poses, trans, _ = body.body.split(moved)
        axes = segments.move(subject.skeleton.part_rotations(poses), subject.joints(poses, trans))
        return np.radians(angles_of(segments, ground, axes))

    here = angles(x)
    steps = step * np.eye(x.shape[1])[:, None].repeat(len(x), axis=1)
    apart = np.stack([angles(body.retract(x, one)) - here for one in steps], axis=1)
    return wrap_angle(apart) / step
