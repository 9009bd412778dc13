"""The motion of a body from a sequence of frames."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Sized
from dataclasses import replace
from typing import Any

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.geometry.mesh import Mesh
from scanprep.threads import one_thread

from ..motion import Motion
from ..smoothing import inertia, smooth
from .frames import Frame
from .settings import TrackConfig
from .tracker import TrackedFrame, Tracker, follow_frames

FOUND = 0.1                          # share of the frames in which the body must be found
Progress = Callable[[int, int], None]
Surfaces = Callable[[int, Mesh], None]


@one_thread()
def track(body: BodyModel | Subject, frames: Iterable[Frame], config: TrackConfig | None = None,
          landmarks: tuple[np.ndarray, np.ndarray] | None = None, progress: Progress | None = None,
          rate: float = 30.0, viewpoints: Any = None, surfaces: Surfaces | None = None) -> Motion:
    """The motion of a person from frames of points, without markers.

    The first frame is completed as a partial scan is; every other one starts where constant velocity takes the body
    and is drawn to the points. A frame that shows nothing, or that the body cannot explain, is lost: the prediction
    is carried on, and the body is looked for again near its last place and then everywhere.

    Parameters
    ----------
    body : BodyModel or Subject
        A model when the person's shape is unknown: it is found from several of the first frames and then held.
        A subject when it is known.
    frames : iterable of Mesh, PointCloud, (n, 3) or (n, 6) arrays in metres, sequences of these, or None
        Taken one by one, so a generator may read them from a camera. A sequence holds the views of several cameras
        in one frame of reference; None or no points is a frame in which nothing was seen.
    config : TrackConfig, optional
    landmarks : ((L,) int, (L, 3) float), optional
        Vertices of the template and where they are in the first frame that shows something.
    progress : callable, optional
        Called with (done, total) frames; without a length of `frames` the total is the number taken so far.
    rate : float, frames per second
    viewpoints : (3,) float, metres, or one for each camera, optional
        Where bare points were seen from; it tells the sides of surfaces.
    surfaces : callable, optional
        Called with (frame, completed mesh) once for every frame; the meshes are not kept.

    Returns
    -------
    Motion
        `residuals` has one column, "surface": the mean distance of a frame's points to the predicted surface.
        `converged` is false for lost frames.

    Raises
    ------
    ValueError
        No frame that shows anything, arrays of another shape, landmarks that cannot be used.

    [SCAPE] Eq. 10
    [SCAPE-patent] claims 11-15
    """
    config = config or TrackConfig()
    if not rate > 0:
        raise ValueError(f"rate: expected frames per second above 0, got {rate}")
    tracker = Tracker(body, config, rate, landmarks, viewpoints)
    total = len(frames) if isinstance(frames, Sized) else 0
    done: list[TrackedFrame] = []
    for frame in follow_frames(tracker, iter(frames)):
        if surfaces is not None:
            surfaces(frame.number, tracker.surface(frame))
        done.append(without_points(frame))
        if progress is not None:
            progress(len(done), max(total, len(done)))
    return as_motion(done, tracker.state.betas, rate, config)


def without_points(frame: TrackedFrame) -> TrackedFrame:
    """The frame without what it was found from, which is large."""
    return replace(frame, cloud=None)


def as_motion(frames: list[TrackedFrame], betas: np.ndarray | None, rate: float, config: TrackConfig) -> Motion:
    """The motion of tracked frames, smoothed as a whole where the settings ask for it."""
    x = np.stack([frame.x for frame in frames])
    if config.smoothing:
        weights = inertia(x.shape[1], rate, config.angle_acceleration, config.place_acceleration)
        x = smooth(x, np.stack([frame.gradient for frame in frames]), np.stack([f.precision for f in frames]),
                   weights, config.smoothing)
    residuals = np.array([[frame.residual] for frame in frames])
    return Motion(x[:, :-3].reshape(len(x), -1, 3), x[:, -3:].copy(), betas, rate, residuals, ("surface",),
                  converged=np.array([frame.found for frame in frames]))


def tracking_problem(motion: Motion) -> str | None:
    """Why the motion of tracked frames means nothing, with the likely cause; None where it means something."""
    found = float(motion.converged.mean())
    if found >= FOUND:
        return None
    seen = motion.residuals[np.isfinite(motion.residuals)]
    off = f"the points are {1000 * float(seen.mean()):.0f} mm from the body" if len(seen) else "no frame shows anything"
    return (f"the body was found in {100 * found:.0f}% of the frames, {off}; the wrong unit (--unit), frames of "
            "something else, or another model?")
