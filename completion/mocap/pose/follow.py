"""Motion of a known body from markers: a few frames one after the other, then all as a whole; a low-pass filter."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from model.linear import Subject
from scanprep.threads import one_thread

from ...motion import Motion, Progress
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from .foot_contact import FootContact
from .initialise import reinitialise_frames, search_pose
from .marked_body import AnimateConfig, MarkedBody, judge_markers, marker_weights
from .stream import STEPS, MarkerTracker
from .swaps import label_order

__all__ = ["AnimateConfig", "animate"]

STILL = 0.005                        # metres that the last round moves any marker of a frame that has converged


@one_thread()
def animate(subject: Subject, markers: MarkerSequence, layout: MarkerLayout, config: AnimateConfig | None = None,
            progress: Progress | None = None, near: Motion | None = None) -> Motion:
    """The motion of a body that carries markers.

    Key frames are followed one after the other, each from a prediction. All frames between them begin on the
    way from key to key and are solved together, coupled by how strongly a body accelerates. Markers that are
    missing count nothing, those far off count little, and labels that two have swapped are put right.

    Parameters
    ----------
    subject : Subject
        The person, of known shape.
    markers : MarkerSequence
    layout : MarkerLayout
        Where on the body the markers sit. Markers that only one of the two knows are left out.
    config : AnimateConfig, optional
    progress : callable, optional
        Called with (done, total) frames.
    near : Motion, optional
        Of nearly this body with nearly these markers, to begin with instead of key frames.

    Raises
    ------
    ValueError
        Fewer than 3 markers in common, no frame with 3 of them, a layout of another body.

    [SCAPE] §8
    """
    config, tell = config or AnimateConfig(), progress or (lambda done, total: None)
    columns, worn = layout.match_columns(markers.labels)
    targets = markers.positions[:, columns]
    body = MarkedBody(subject, worn, config.prior_weight, config.prior_shrinkage)
    if config.smoothing or config.ground:
        start = None if near is None else body.body.join(near.poses, near.trans)
        x, order, converged = follow_whole(body, targets, markers.rate, config, tell, start)
    else:
        x, order, converged = follow_frames(body, targets, np.arange(len(targets)), markers.rate, config, tell)
    pose, trans, _ = body.body.split(x)
    if config.low_pass:
        pose, trans = low_pass(pose, trans, markers.rate, config.low_pass)
    residuals = np.full(markers.positions.shape[:2], np.nan)
    believed = np.zeros(residuals.shape, dtype=bool)
    residuals[:, columns], believed[:, columns] = judge_markers(body.positions(body.body.join(pose, trans)), targets,
                                                                order,
                                                                config.outlier)
    return Motion(pose.copy(), trans.copy(), subject.betas, markers.rate, residuals, markers.labels,
                  converged=converged, trusted=believed)


def follow_frames(body: MarkedBody, targets: np.ndarray, frames: np.ndarray, rate: float, config: AnimateConfig,
                  tell: Progress, steps: int = STEPS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Some frames, `rate` of them a second, each from those before: begins at a whole one and goes both ways.

    Found are unknowns (n, P), the columns of targets (T, L, 3) of each marker (n, L), and which frames converged (n,).
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
            tell(done, len(frames))
    return x, order, converged


def follow_whole(body: MarkedBody, targets: np.ndarray, rate: float, config: AnimateConfig, tell: Progress,
                 start: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All frames together: unknowns (T, P), the order of the labels (T, L), and which frames converged (T,).

    They begin at unknowns `start` (T, P), or on the way from key to key.
    """
    T, stiffness = len(targets), config.inertia(rate, body.n_unknowns)
    x = between_keys(body, targets, rate, config) if start is None else start.copy()
    moved, feet, inside = np.zeros(T), None, span_with_markers(targets)
    free = max(config.smoothing, 1)
    rounds = free + 2 * (config.ground and T > 2)                       # the last ones with the feet held
    for i in range(rounds):
        if i == free:
            feet = FootContact(body, x, rate, config.floor)
        # swapped labels are put right, lost limbs found again, and outliers lose their weight
        order = label_order(body.positions(x), targets, rate, config.outlier)
        taken = np.take_along_axis(targets, order[..., None], axis=1)[inside]
        near = reinitialise_frames(body, x[inside].copy(), taken, config)         # x changes below, and is compared
        weights, _ = marker_weights(body.positions(near), taken, config.marker_sd, config.outlier)

        # one step of all frames together
        x[inside] = body.smooth_step(near, stiffness, body.system, taken, weights) if feet is None else \
            body.smooth_step(near, stiffness, feet.system, taken, weights, feet.target_positions(x)[inside])
        moved[inside] = np.linalg.norm(body.positions(x[inside]) - body.positions(near), axis=2).max(axis=1)
        tell(round(T * (i + 1) / rounds), T)
    return x, order, (~np.isnan(targets[..., 0])).any(axis=1) & (moved < STILL)


def between_keys(body: MarkedBody, targets: np.ndarray, rate: float, config: AnimateConfig) -> np.ndarray:
    """Unknowns (T, P) on the way from one key frame to the next, which are followed one after the other."""
    T, every = len(targets), max(1, round(0.1 * rate))  # seconds between the frames that are solved one after the other
    frames = np.unique(np.r_[0, np.arange(_first_frame(targets) % every, T, every), T - 1])
    keys, _, _ = follow_frames(body, targets, frames, rate / every, config, lambda done, total: None, steps=8)
    if len(frames) == 1:
        return keys
    i = np.clip(np.searchsorted(frames, np.arange(T), side="right") - 1, 0, max(0, len(frames) - 2))
    share = (np.arange(T) - frames[i]) / (frames[i + 1] - frames[i])
    return body.retract(keys[i], share[:, None] * body.step_to(keys[i], keys[i + 1]))


def span_with_markers(targets: np.ndarray) -> slice:
    """From the first to the last frame in which any of the markers (T, L, 3) was seen."""
    some = np.flatnonzero(~np.isnan(targets[..., 0]).all(axis=1))
    return slice(int(some[0]), int(some[-1]) + 1)


def _first_frame(targets: np.ndarray) -> int:
    """The first frame with nearly as many markers as ever."""
    seen = (~np.isnan(targets[..., 0])).sum(axis=1)
    if seen.max(initial=0) < 3:
        raise ValueError(f"markers: expected a frame with at least 3 known markers, the best has {seen.max(initial=0)}")
    return int(np.argmax(seen >= max(3, 0.9 * seen.max())))


def low_pass(pose: np.ndarray, trans: np.ndarray, rate: float, cutoff: float) -> tuple[np.ndarray, np.ndarray]:
    """Poses (T, J, 3) and trans (T, 3) without what is faster than a frequency, hertz: Butterworth, there and back.

    Rotations are filtered as unit quaternions of continuous sign, which have no jump at a half turn.
    """
    from scipy.signal import butter, sosfiltfilt

    if not 0 < cutoff < rate / 2:
        raise ValueError(f"low_pass: expected a frequency between 0 and half the rate, {rate / 2:g}, got {cutoff:g}")
    sections = butter(2, cutoff, fs=rate, output="sos")
    if len(pose) <= 3 * (2 * len(sections) + 1):
        raise ValueError(f"low_pass: expected more than {3 * (2 * len(sections) + 1)} frames, got {len(pose)}")
    q = Rotation.from_rotvec(pose.reshape(-1, 3)).as_quat().reshape(*pose.shape[:2], 4)
    turned = np.einsum("tjc,tjc->tj", q[1:], q[:-1]) < 0
    q[1:] *= np.where(np.cumsum(turned, axis=0) % 2, -1.0, 1.0)[..., None]
    q = sosfiltfilt(sections, q, axis=0)
    return (Rotation.from_quat(q.reshape(-1, 4)).as_rotvec().reshape(pose.shape),
            sosfiltfilt(sections, trans, axis=0))
