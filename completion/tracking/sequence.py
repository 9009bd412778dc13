"""Track the motion of a body through a sequence of frames of points."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sized
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from model.body import BodyModel
from model.fitting.bodies import FixedBody, ShapedBody, as_body
from model.fitting.free_surface import free_surface
from model.fitting.scan import ScanPoints
from model.linear import Subject
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import size
from scanprep.threads import one_thread

from ..motion import Motion, Progress
from ..partial.completion import complete
from ..smoothing import predict, smooth_frames
from .frame_fit import FrameFit, Refined, fit_shared_shape, frame_inertia, spread_poses
from .frames import Frame, frame_views, prepare_frame
from .settings import TrackConfig

Surfaces = Callable[[int, Mesh], None]


@one_thread()
def track(body: BodyModel | Subject, frames: Iterable[Frame], config: TrackConfig | None = None,
          landmarks: tuple[np.ndarray, np.ndarray] | None = None, progress: Progress | None = None,
          rate: float = 30.0, viewpoints: Any = None, surfaces: Surfaces | None = None) -> Motion:
    """Track the motion of a person through frames of points, without markers.

    The first frame is completed like a partial scan. Every other frame starts at the pose that constant velocity
    predicts and is fitted to the points. A frame is lost when it shows nothing, or when the body cannot explain it:
    then the prediction goes on, and the body is searched near its last place and then everywhere.

    Parameters
    ----------
    body : BodyModel or Subject
        A model when the person's shape is unknown: it is found from several of the first frames and then fixed.
        A subject when it is known.
    frames : iterable of Mesh, PointCloud, (n, 3) or (n, 6) arrays in metres, sequences of these, or None
        Read one by one, so a generator may read them from a camera. A sequence holds the views of several cameras
        in one frame of reference; None or no points is a frame in which nothing was seen.
    config : TrackConfig, optional
        Settings.
    landmarks : ((L,) int, (L, 3) float, metres), optional
        Vertices of the template and their places in the first frame that shows something.
    progress : callable, optional
        Called with (done, total) frames; the total is the number read so far where `frames` has no length.
    rate : float, frames per second
        Of the frames.
    viewpoints : (3,) float, metres, or one for each camera, optional
        Positions of the cameras; needed for the sign of normals of bare points.
    surfaces : callable, optional
        Called with (frame, completed mesh) once for every frame; the meshes are not kept.

    Returns
    -------
    Motion
        Poses (T, J, 3) in radians and trans (T, 3) in metres. `residuals` (T, 1), metres, has the column "surface":
        the mean distance of a frame's points to the predicted surface. `converged` (T,) is false for lost frames.

    Raises
    ------
    ValueError
        No frame that shows anything, arrays of another shape, landmarks that cannot be used.

    Examples
    --------
    >>> from completion import CompletionConfig
    >>> from model import load_built_in_model
    >>> person = load_built_in_model().subject()
    >>> marks = np.arange(0, 5000, 400)
    >>> quick = TrackConfig(start=CompletionConfig(rounds=2, scan_points=500, model_points=500))
    >>> track(person, [person.template] * 2, quick, (marks, person.template.vertices[marks])).poses.shape
    (2, 16, 3)

    [SCAPE] Eq. 10
    [SCAPE-patent] claims 11-15
    """
    config = config or TrackConfig()
    if not rate > 0:
        raise ValueError(f"rate: expected frames per second above 0, got {rate}")
    tracker = BodyTracker(body, config, rate, landmarks, viewpoints)
    total = len(frames) if isinstance(frames, Sized) else 0
    done: list[TrackedFrame] = []
    for frame in tracker.follow(frames):
        if surfaces is not None:
            surfaces(frame.number, tracker.surface(frame))
        done.append(without_points(frame))
        if progress is not None:
            progress(len(done), max(total, len(done)))
    return as_motion(done, tracker.state.betas, rate, config)


def without_points(frame: TrackedFrame) -> TrackedFrame:
    """Return the frame without its points, which are large."""
    return replace(frame, cloud=None)


def as_motion(frames: list[TrackedFrame], betas: np.ndarray | None, rate: float, config: TrackConfig) -> Motion:
    """Return the motion of tracked frames, smoothed over time where the settings ask for it."""
    x = np.stack([frame.x for frame in frames])
    if config.smoothing:
        # every frame counts as a quadratic about its own optimum, coupled by the accelerations
        weights = frame_inertia(x.shape[1], rate)
        x = smooth_frames(x, np.stack([frame.gradient for frame in frames]), np.stack([f.precision for f in frames]),
                          weights, config.smoothing)
    residuals = np.array([[frame.residual] for frame in frames])
    return Motion(x[:, :-3].reshape(len(x), -1, 3), x[:, -3:].copy(), betas, rate, residuals, ("surface",),
                  converged=np.array([frame.found for frame in frames]))


def tracking_doubts(motion: Motion, body: Mesh) -> list[str]:
    """Return reasons to look at a tracked motion: lost frames, or a body far from the points.

    `body` is the model's template.
    """
    seen = np.isfinite(motion.residuals[:, 0])
    lost, off = seen & ~motion.converged, float(motion.residuals[seen].mean()) if seen.any() else 0.0
    doubts = [f"the body was lost in {lost.sum()} of {seen.sum()} frames that show something: frames in another order, "
              "or too far apart?"] if lost.sum() > LOST_FRAMES * seen.sum() else []
    # 0.01 of the size: people have 1 to 2 mm, 3 with noise; half the size 21 mm, shuffled frames 19 mm
    return doubts + ([f"the points are {1000 * off:.0f} mm from the body: the wrong scale, frames in another order, or "
                      "clothes?"] if off > 0.01 * size(body) else [])


def tracking_problem(motion: Motion) -> str | None:
    """Return why a tracked motion means nothing, with the likely cause, or None where it is meaningful."""
    tracked = float(motion.converged.mean())
    if tracked >= FOUND:
        return None
    seen = motion.residuals[np.isfinite(motion.residuals)]
    off = f"the points are {1000 * float(seen.mean()):.0f} mm from the body" if len(seen) else "no frame shows anything"
    return (f"the body was found in {100 * tracked:.0f}% of the frames, {off}; the wrong unit (--unit), frames of "
            "something else, or another model?")


# Shares of the frames: fewer tracked than FOUND mean nothing, more lost than LOST_FRAMES are a doubt. Six runs of the
# benchmark and a synthetic person are tracked in all frames, a person enlarged by 1.6 in none, shuffled frames in 0.8.
FOUND, LOST_FRAMES = 0.1, 0.05
SEARCH_EVERY = 10                    # one of so many lost frames is searched from scratch: that takes long
SHAPE_VIEWS = 8                      # frames, those that differ most, from which a shape is found together
MOMENTUM, LOST = 0.9, 0.5            # share of the velocity that a prediction keeps; the same after a lost frame


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """The result for one frame."""

    number: int                      # from 0
    x: np.ndarray                    # (P,), pose (3J) and trans (3)
    found: bool                      # not lost
    residual: float                  # metres, mean distance of the points to the surface; NaN without points
    explained: float                 # share of the points near the surface
    gradient: np.ndarray             # (P,) of the data's energy near x, for smoothing; zero when it is lost
    precision: np.ndarray            # (P, P) Gauss-Newton matrix of the same
    cloud: ScanPoints | None = None  # its points


@dataclass(frozen=True, eq=False)
class TrackerState:
    """The complete state of a tracker after some frames: another tracker continues from it with the same result."""

    number: int                      # frames read
    lost: int                        # number of successive lost frames up to now
    betas: np.ndarray | None         # (K,) as found so far, None for the template's own body
    shape_known: bool                # the betas are final
    past: tuple[np.ndarray, ...] = ()        # unknowns (P,) of up to two frames, the last first
    kept: tuple[TrackedFrame, ...] = ()      # frames that may still change, with their points
    random_state: dict[str, Any] | None = None       # of the generator for a search from scratch


class BodyTracker:
    """Tracks one body through frames that are pushed one by one.

    For a model the first frames are kept until the shape is found. `landmarks` are of the first frame, as for
    `complete`; `viewpoints` (3,), metres, or one for each camera, are the positions of the cameras.
    """

    def __init__(self, body: BodyModel | Subject, config: TrackConfig, rate: float,
                 landmarks: tuple[np.ndarray, np.ndarray] | None = None, viewpoints: np.ndarray | None = None) -> None:
        self.given, self.config, self.rate = body, config, rate
        self.landmarks, self.viewpoints = landmarks, viewpoints
        self.person = as_body(body)
        self.resume(TrackerState(0, 0, body.betas if isinstance(body, Subject) else None,
                                 not isinstance(self.person, ShapedBody)))

    def resume(self, state: TrackerState) -> None:
        """Continue from the state of a tracker with the same body and settings."""
        self.state = state
        self._body: FixedBody | None = None          # with the betas of the state
        self._fit: FrameFit | None = None

    def push(self, frame: Frame) -> list[TrackedFrame]:
        """Process the next frame and return the frames that are final, which may be none or several."""
        config, state = self.config, self.state
        expected = predict(state.past[0], state.past[-1], LOST if state.lost else MOMENTUM) if state.past else None
        # the expected body also tells the sign of normals
        cloud = prepare_frame(frame, config.frame_points, self.viewpoints,
                              None if expected is None else self._mesh(expected))
        # nothing seen so far
        if expected is None and cloud is None:
            self.state = replace(state, number=state.number + 1, kept=(*state.kept, self._track_frame(state.number)))
            return []
        # fit the frame: the first one by completion, others from the prediction
        found = None if cloud is None else self._begin(cloud) if expected is None else self._follow(cloud, expected)
        good = found is not None and (expected is None or self._fitter(cloud).good(found))
        tracked = self._track_frame(state.number, found.x if found is not None and good else expected, found, cloud)
        # a lost frame keeps the prediction as its pose
        self.state = replace(self.state, number=state.number + 1, lost=0 if tracked.found else state.lost + 1,
                             past=(tracked.x, *state.past)[:2], kept=(*state.kept, tracked),
                             random_state=self._random_state())
        return self._done()

    def follow(self, frames: Iterable[Frame]) -> Iterator[TrackedFrame]:
        """Yield the tracked frames of a stream, each as soon as it is final."""
        for frame in frames:
            yield from self.push(frame)
        yield from self.finish()

    def finish(self) -> list[TrackedFrame]:
        """Return the frames that were still kept; ValueError where no frame showed anything."""
        if not self.state.past:
            raise ValueError("frames: expected at least one that shows something")
        return self._done(last=True)

    def surface(self, frame: TrackedFrame) -> Mesh:
        """Return the completed surface of a frame: it follows the points where there are any, the model elsewhere.

        [SCAPE] Eq. 10
        """
        mesh = self._mesh(frame.x)
        return mesh if frame.cloud is None or not frame.found else free_surface(
            mesh, frame.cloud, self.config.start.surface_weight)[0]

    def _begin(self, cloud: ScanPoints) -> Refined:
        """Fit the first frame that shows something: complete it, then refine."""
        start = complete(self.given, frame_views(cloud), self.landmarks, self.config.start)
        self._has_shape(start.betas)
        fitter = self._fitter(cloud)
        return fitter.refine(fitter.scan.on(cloud), fitter.body.join(start.pose, start.trans))

    def _follow(self, cloud: ScanPoints, expected: np.ndarray) -> Refined:
        """Fit a later frame: near the prediction, or by a new search where that explains it better."""
        fitter, lost = self._fitter(cloud), self.state.lost
        fit = fitter.scan.on(cloud)
        found = fitter.refine(fit, expected, None if lost else expected)
        if fitter.good(found):
            return found
        anew = fitter.again(fit, [expected, self.state.past[0]], (lost - 1) % SEARCH_EVERY == 0)
        return anew if fit.misfit(anew.x) < fit.misfit(found.x) else found

    def _done(self, last: bool = False) -> list[TrackedFrame]:
        """Return frames that are final; frames before the first with points get the pose of that one."""
        if not self.state.shape_known:
            if not last and len(self.state.kept) < self.config.shape_frames:
                return []
            self._find_shape()
        ready = self.state.kept
        self.state = replace(self.state, kept=())
        first = next((f.x for f in ready if f.cloud is not None), None)
        return [f if f.x.any() or first is None else replace(f, x=first) for f in ready]

    def _find_shape(self) -> None:
        """Find the betas from some of the kept frames, then refine these frames with the person of that shape."""
        before = self.state.betas
        assert isinstance(self.person, ShapedBody) and before is not None, "a model, completed once"
        seen = [(f.x, f.cloud) for f in self.state.kept if f.found and f.cloud is not None]
        self.state = replace(self.state, shape_known=True)
        if not seen:
            return
        chosen = spread_poses(np.stack([self._subject_so_far().vertices(x) for x, _ in seen]), SHAPE_VIEWS)
        betas, _ = fit_shared_shape(self.person, [seen[i][1] for i in chosen], np.stack([seen[i][0] for i in chosen]),
                                    before, self.config)
        self._has_shape(betas)
        kept = tuple(self._refine(f) for f in self.state.kept)
        self.state = replace(self.state, kept=kept, past=tuple(f.x for f in kept[:-3:-1]),
                             random_state=self._random_state())

    def _refine(self, frame: TrackedFrame) -> TrackedFrame:
        """Fit a kept frame again with the present body."""
        if frame.cloud is None or not frame.found:
            return frame
        fitter = self._fitter(frame.cloud)
        found = fitter.refine(fitter.scan.on(frame.cloud), frame.x, frame.x)
        return self._track_frame(frame.number, found.x, found, frame.cloud)

    def _track_frame(self, number: int, x: np.ndarray | None = None, found: Refined | None = None,
                     cloud: ScanPoints | None = None) -> TrackedFrame:
        """Make a frame from its fit: without data terms where it is lost, with x = 0 before the body was seen."""
        size = self.person.n_angles + 3
        out = TrackedFrame(number, np.zeros(size) if x is None else x, False, np.nan, 0.0, np.zeros(size),
                           np.zeros((size, size)), cloud)
        if found is None:
            return out
        out = replace(out, residual=found.residual, explained=found.explained)
        good = self._fitter(cloud).good(found)
        return replace(out, found=True, gradient=found.gradient, precision=found.precision) if good else out

    def _has_shape(self, betas: np.ndarray | None) -> None:
        """Use these betas (K,) for a person of unknown shape from now on, with a new random generator."""
        if isinstance(self.person, ShapedBody):
            self.resume(replace(self.state, betas=betas, random_state=None))

    def _subject_so_far(self) -> FixedBody:
        """Return the body with the present betas, made when it is first needed."""
        if self._body is None:
            self._body = FixedBody(self.person.model.subject(self.state.betas)) \
                if isinstance(self.person, ShapedBody) else self.person
        return self._body

    def _fitter(self, cloud: ScanPoints | None) -> FrameFit:
        """Return the fit of the present body, made from the first frame, with the random state of the tracker."""
        if self._fit is None:
            assert cloud is not None, "the first fit is of a frame that shows something"
            self._fit = FrameFit(self._subject_so_far(), cloud, self.config, self.rate)
            if self.state.random_state is not None:
                self._fit.scan.rng.bit_generator.state = self.state.random_state
        return self._fit

    def _random_state(self) -> dict[str, Any] | None:
        return self.state.random_state if self._fit is None else dict(self._fit.scan.rng.bit_generator.state)

    def _mesh(self, x: np.ndarray) -> Mesh:
        return self.person.template.with_vertices(self._subject_so_far().vertices(x))
