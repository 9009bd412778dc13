"""Motion of a known body from markers: key frames in sequence, then all frames together; a low-pass filter."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from model.linear import Subject
from scanprep.judgement import size
from scanprep.threads import one_thread

from ...motion import Motion, Progress
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from .foot_contact import FootContact
from .hinges import Hinges
from .initialise import reinitialise_frames, search_pose
from .marked_body import AnimateConfig, MarkedBody, judge_markers, marker_weights
from .stream import STEPS, MarkerTracker
from .swaps import label_order

__all__ = ["AnimateConfig", "animate"]

# share of the body's size, 5 mm on a man: a frame has converged when the last round moves no marker farther
STILL = 0.0037
SMOOTH_ROUNDS = 2                    # over the whole sequence: the second corrects labels and outliers by the first


@one_thread()
def animate(subject: Subject, markers: MarkerSequence, layout: MarkerLayout, config: AnimateConfig | None = None,
            progress: Progress | None = None, near: Motion | None = None) -> Motion:
    """Compute the motion of a body of known shape from its markers.

    Key frames are solved in sequence, each from a prediction. The frames between them start from interpolated poses and
    are solved together, with a prior on accelerations. Missing markers have no weight, outliers little, and swapped
    labels are corrected.

    Parameters
    ----------
    subject : Subject
        The person, of known shape.
    markers : MarkerSequence
        Positions (T, L, 3) in metres.
    layout : MarkerLayout
        Where on the body the markers sit. Markers that are only in one of the two are left out.
    config : AnimateConfig, optional
        Settings.
    progress : callable, optional
        Called with (done, total) frames.
    near : Motion, optional
        Motion of nearly this body with nearly these markers, as the initialisation in place of key frames.

    Returns
    -------
    Motion
        Poses (T, J, 3) in radians, trans (T, 3) in metres, residuals (T, L) in metres of every marker of the sequence.

    Raises
    ------
    ValueError
        Fewer than 3 markers in common, no frame with 3 of them, a layout of another body.

    Examples
    --------
    >>> from completion import load_layout
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> layout = load_layout("cmu41", model)
    >>> still = MarkerSequence(np.stack([layout.place(model)] * 5), layout.labels, 120.0)
    >>> motion = animate(model.subject(), still, layout)
    >>> motion.poses.shape, bool(motion.residuals.max() < 0.005)
    ((5, 16, 3), True)

    [SCAPE] §8
    """
    config, report_progress = config or AnimateConfig(), progress or (lambda done, total: None)
    # the markers that sequence and layout have in common, on the body
    columns, known_layout = layout.match_columns(markers.labels)
    targets = markers.positions[:, columns]
    body = MarkedBody(subject, known_layout, config.prior_weight, config.prior_shrinkage)
    start = None if near is None else body.body.join(near.poses, near.trans)
    x, order, converged = follow_whole(body, targets, markers.rate, config, report_progress, start)
    pose, trans, _ = body.body.split(x)
    if config.low_pass:
        pose, trans = low_pass(pose, trans, markers.rate, config.low_pass)
    # residuals of the markers of the layout, NaN for the others
    residuals = np.full(markers.positions.shape[:2], np.nan)
    believed = np.zeros(residuals.shape, dtype=bool)
    simulated = body.positions(body.body.join(pose, trans))
    residuals[:, columns], believed[:, columns] = judge_markers(simulated, targets, order, config.outlier)
    return Motion(pose.copy(), trans.copy(), subject.betas, markers.rate, residuals, markers.labels,
                  converged=converged, trusted=believed)


def follow_frames(body: MarkedBody, targets: np.ndarray, frames: np.ndarray, rate: float, config: AnimateConfig,
                  report_progress: Progress, steps: int = STEPS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve some frames in sequence, `rate` of them a second: from the first full frame forwards, then backwards.

    Returned are unknowns (n, P), the columns of targets (T, L, 3) of each marker (n, L), and which frames converged
    (n,).
    """
    first = _first_frame(targets)
    x, converged = np.empty((len(frames), body.n_unknowns)), np.zeros(len(frames), dtype=bool)
    order = np.tile(np.arange(body.count), (len(frames), 1))
    at, start, done = int(np.searchsorted(frames, first)), search_pose(body, targets[first], config), 0
    ways: tuple[Sequence[int], Sequence[int]] = range(at, len(frames)), range(at - 1, -1, -1)
    for way in ways:
        tracker = MarkerTracker(body, config, rate, steps)
        tracker.begin(x[at] if done else start)
        for i in way:
            x[i], converged[i] = tracker.push(targets[frames[i]])
            order[i] = tracker.watch.order
            done += 1
            report_progress(done, len(frames))
    return x, order, converged


def follow_whole(body: MarkedBody, targets: np.ndarray, rate: float, config: AnimateConfig, report_progress: Progress,
                 start: np.ndarray | None = None, mend: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve all frames together; return unknowns (T, P), the order of labels (T, L) and which frames converged (T,).

    The initialisation is `start` (T, P), or poses interpolated between key frames. Limbs that turned over are turned
    back, to `mend` them, unless the whole motion fits the markers better without.
    """
    T, stiffness = len(targets), config.inertia(rate, body.n_unknowns)
    x = between_keys(body, targets, rate, config) if start is None else start.copy()
    moved, feet, inside, hinges = np.zeros(T), None, span_with_markers(targets), Hinges(body)
    rounds = SMOOTH_ROUNDS + 2 * (config.ground and T > 2)              # two more rounds with foot contact
    for i in range(rounds):
        if i == SMOOTH_ROUNDS:
            feet = FootContact(body, x, rate)
        # swapped labels are corrected, lost limbs initialised again, and outliers lose their weight
        order = label_order(body.positions(x), targets, rate, config.outlier)
        taken = np.take_along_axis(targets, order[..., None], axis=1)[inside]
        near = reinitialise_frames(body, x[inside].copy(), taken, config)         # a copy: x changes below
        near = hinges.turn_back(near, taken, config) if mend else near
        weights, _ = marker_weights(body.positions(near), taken, config.marker_sd, config.outlier)

        # one step of all frames together
        x[inside] = body.smooth_step(near, stiffness, body.system, taken, weights) if feet is None else \
            body.smooth_step(near, stiffness, feet.system, taken, weights, feet.target_positions(x)[inside])
        moved[inside] = np.linalg.norm(body.positions(x[inside]) - body.positions(near), axis=2).max(axis=1)
        report_progress(round(T * (i + 1) / rounds), T)
    seen = (~np.isnan(targets[..., 0])).any(axis=1)
    result = x, order, seen & (moved < STILL * size(body.body.template))
    if not hinges.turned:
        return result
    unmended = follow_whole(body, targets, rate, config, report_progress, start, mend=False)
    return min(result, unmended, key=lambda one: float(hinges.misfit(one[0][seen], targets[seen], config).mean()))


def between_keys(body: MarkedBody, targets: np.ndarray, rate: float, config: AnimateConfig) -> np.ndarray:
    """Solve key frames in sequence, and interpolate unknowns (T, P) between them."""
    # 0.1 seconds between key frames; the first and the last frame are key frames too
    T, every = len(targets), max(1, round(0.1 * rate))
    frames = np.unique(np.r_[0, np.arange(_first_frame(targets) % every, T, every), T - 1])
    keys, _, _ = follow_frames(body, targets, frames, rate / every, config, lambda done, total: None, steps=8)
    if len(frames) == 1:
        return keys
    # each frame a share of the step from the key before it to the key after it
    i = np.clip(np.searchsorted(frames, np.arange(T), side="right") - 1, 0, max(0, len(frames) - 2))
    share = (np.arange(T) - frames[i]) / (frames[i + 1] - frames[i])
    return body.retract(keys[i], share[:, None] * body.step_to(keys[i], keys[i + 1]))


def span_with_markers(targets: np.ndarray) -> slice:
    """Return the slice from the first to the last frame in which any of the markers (T, L, 3) was seen."""
    seen = np.flatnonzero(~np.isnan(targets[..., 0]).all(axis=1))
    return slice(int(seen[0]), int(seen[-1]) + 1)


def _first_frame(targets: np.ndarray) -> int:
    """Return the first frame with at least 90% of the markers of the fullest frame; ValueError below 3."""
    seen = (~np.isnan(targets[..., 0])).sum(axis=1)
    if seen.max(initial=0) < 3:
        raise ValueError(f"markers: expected a frame with at least 3 known markers, the best has {seen.max(initial=0)}")
    return int(np.argmax(seen >= max(3, 0.9 * seen.max())))


def low_pass(pose: np.ndarray, trans: np.ndarray, rate: float, cutoff: float) -> tuple[np.ndarray, np.ndarray]:
    """Filter poses (T, J, 3) and trans (T, 3) by a low-pass without lag: Butterworth of order 2, forth and back.

    `cutoff` is in hertz. Rotations are filtered as unit quaternions of continuous sign, without a jump at a half turn.
    """
    from scipy.signal import butter, sosfiltfilt

    if not 0 < cutoff < rate / 2:
        raise ValueError(f"low_pass: expected a frequency between 0 and half the rate, {rate / 2:g}, got {cutoff:g}")
    sections = butter(2, cutoff, fs=rate, output="sos")
    if len(pose) <= 3 * (2 * len(sections) + 1):
        raise ValueError(f"low_pass: expected more than {3 * (2 * len(sections) + 1)} frames, got {len(pose)}")
    # quaternions whose sign changes wherever two successive ones point apart
    q = Rotation.from_rotvec(pose.reshape(-1, 3)).as_quat().reshape(*pose.shape[:2], 4)
    turned = np.einsum("tjc,tjc->tj", q[1:], q[:-1]) < 0
    q[1:] *= np.where(np.cumsum(turned, axis=0) % 2, -1.0, 1.0)[..., None]
    q = sosfiltfilt(sections, q, axis=0)
    return (Rotation.from_quat(q.reshape(-1, 4)).as_rotvec().reshape(pose.shape),
            sosfiltfilt(sections, trans, axis=0))
