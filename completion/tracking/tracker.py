"""Frame after frame: the first is completed, the others follow, the lost ones are found again."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.geometry.mesh import Mesh

from ..bodies import FixedBody, ShapedBody, as_body
from ..partial.completion import complete
from ..partial.free_surface import free_surface
from ..partial.scan import ScanPoints
from .dynamics import predicted
from .frame_fit import FrameFit, Settled
from .frames import Frame, as_views, prepare_frame
from .person import shared_shape, spread_poses
from .settings import TrackConfig


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """One frame of a motion."""

    number: int             # from 0
    x: np.ndarray           # (P,), pose (3J) and trans (3)
    found: bool             # not lost
    residual: float         # metres, mean distance of the points to the surface; NaN for a frame without points
    explained: float        # share of the points that have the surface near
    gradient: np.ndarray
    precision: np.ndarray
    cloud: ScanPoints | None = None  # its points


@dataclass(frozen=True, eq=False)
class TrackerState:
    """All that a tracker knows after some frames: another one goes on from there to the very same end."""

    number: int             # frames taken
    lost: int               # how many of the last ones were lost, one after the other
    betas: np.ndarray | None  # (K,), or None, those found so far
    shape_known: bool       # whether they stay
    past: tuple[np.ndarray, ...]  # up to two (P,), where the body was, the last frame first
    kept: tuple[TrackedFrame, ...]  # tuple of TrackedFrame, frames that may still change, with their points
    draws: dict[str, Any] | None  # state of the random numbers that a search from scratch draws


class Tracker:
    """Follows one body through frames that are handed over one by one.

    `landmarks` ((L,) int, (L, 3)), of the first frame, as for `complete`; `viewpoints` (3,), metres, or one for
    each camera, where bare points were seen from; `betas` (K,), or None for the template's own body, those found so
    far.
    """

    def __init__(self, body: BodyModel | Subject, config: TrackConfig, rate: float,
                 landmarks: tuple[np.ndarray, np.ndarray] | None = None, viewpoints: np.ndarray | None = None) -> None:
        self.config, self.rate, self.landmarks, self.viewpoints = config, rate, landmarks, viewpoints
        self.whole = as_body(body)
        self.betas = body.betas if isinstance(body, Subject) else None
        self.body: FixedBody | None = None if isinstance(self.whole, ShapedBody) else self.whole
        self._fit: FrameFit | None = None
        self._draws: dict[str, Any] | None = None           # those that the next fit begins with
        self._past: list[np.ndarray] = []
        self._number, self._lost = 0, 0
        self._kept: list[TrackedFrame] = []
        self._shape_known = not isinstance(self.whole, ShapedBody)

    @property
    def state(self) -> TrackerState:
        """What is known after the frames taken so far."""
        draws = self._draws if self._fit is None else self._fit.draws
        return TrackerState(self._number, self._lost, self.betas, self._shape_known, tuple(self._past),
                            tuple(self._kept), draws)

    def resume(self, state: TrackerState) -> None:
        """Go on where a tracker of the same body and settings was."""
        if isinstance(self.whole, ShapedBody):
            self.betas = state.betas
            self.body = None if state.betas is None else FixedBody(self.whole.model.subject(state.betas))
        self._number, self._lost, self._shape_known = state.number, state.lost, state.shape_known
        self._past, self._kept = list(state.past), list(state.kept)
        self._fit, self._draws = None, state.draws

    def push(self, frame: Frame) -> list[TrackedFrame]:
        """Take the next frame; returns those that are done, which may be none or several."""
        number, self._number = self._number, self._number + 1
        expected = self._expected()
        shown = None if expected is None or self.body is None else self._mesh(expected)
        cloud = prepare_frame(frame, self.config.frame_points, self.config.normal_points, self.viewpoints, shown)
        if expected is None and cloud is None:
            self._kept.append(self._nothing(number))
            return []
        x, found = self._begin(cloud) if expected is None else self._follow(cloud, expected)
        self._past = [x, *self._past][:2]
        self._lost = 0 if found is not None and self._good(found) else self._lost + 1
        self._kept.append(self._tracked(number, x, found, cloud))
        return self._done()

    def finish(self) -> list[TrackedFrame]:
        """The frames that were still kept."""
        if not self._past:
            raise ValueError("frames: expected at least one that shows something")
        return self._done(last=True)

    def surface(self, frame: TrackedFrame) -> Mesh:
        """The completed surface of a frame: it follows the points where there are any, the model elsewhere.

        [SCAPE] Eq. 10
        """
        predicted_mesh = self._mesh(frame.x)
        if frame.cloud is None or not frame.found:
            return predicted_mesh
        return free_surface(predicted_mesh, frame.cloud, self.config.start)[0]

    def _expected(self) -> np.ndarray | None:
        return predicted(self._past, self.config.momentum if not self._lost else 0.5) if self._past else None

    def _begin(self, cloud: ScanPoints | None) -> tuple[np.ndarray, Settled]:
        """The first frame that shows something."""
        assert cloud is not None, "it shows something"
        start = complete(self.whole_body, as_views(cloud), self.landmarks, self.config.start)
        if isinstance(self.whole, ShapedBody):
            self.betas = start.betas
            self.body = FixedBody(self.whole.model.subject(start.betas))
        assert self.body is not None, "it is known now"
        found = self._fitter(cloud).settle(self._fitter(cloud).on(cloud), self.body.join(start.pose, start.trans))
        return found.x, found

    @property
    def whole_body(self) -> BodyModel | Subject:
        """What `complete` takes."""
        return self.whole.model if isinstance(self.whole, ShapedBody) else self.whole.subject

    def _follow(self, cloud: ScanPoints | None, expected: np.ndarray) -> tuple[np.ndarray, Settled | None]:
        """A frame after others; without points it is where it was expected."""
        if cloud is None:
            return expected, None
        fitter = self._fitter(cloud)
        fit = fitter.on(cloud)
        found = fitter.settle(fit, expected, None if self._lost else expected)
        if not fitter.good(found):
            scratch = (self._lost - 1) % self.config.search_every == 0
            anew = fitter.again(fit, [expected, self._past[0]], scratch)
            found = anew if fit.misfit(anew.x) < fit.misfit(found.x) else found
        return (found.x if fitter.good(found) else expected), found

    def _good(self, found: Settled) -> bool:
        assert self._fit is not None
        return self._fit.good(found)

    def _fitter(self, cloud: ScanPoints) -> FrameFit:
        if self._fit is None:
            assert self.body is not None
            self._fit = FrameFit(self.body, cloud, self.config, self.rate)
            if self._draws is not None:
                self._fit.draws = self._draws
        return self._fit

    def _mesh(self, x: np.ndarray) -> Mesh:
        assert self.body is not None
        return self.body.template.with_vertices(self.body.vertices(x))

    def _nothing(self, number: int) -> TrackedFrame:
        size = self.whole.n_angles + 3
        return TrackedFrame(number, np.zeros(size), False, np.nan, 0.0, np.zeros(size), np.zeros((size, size)))

    def _tracked(self, number: int, x: np.ndarray, found: Settled | None, cloud: ScanPoints | None) -> TrackedFrame:
        empty = self._nothing(number)
        if found is None:
            return TrackedFrame(number, x, False, np.nan, 0.0, empty.gradient, empty.precision, cloud)
        if not self._good(found):
            return TrackedFrame(number, x, False, found.residual, found.explained, empty.gradient, empty.precision,
                                cloud)
        return TrackedFrame(number, x, True, found.residual, found.explained, found.gradient, found.precision, cloud)

    def _done(self, last: bool = False) -> list[TrackedFrame]:
        """Frames that will not change any more; those before the first that showed something stand where it does."""
        if not self._shape_known and not last and len(self._kept) < self.config.shape_frames:
            return []
        if not self._shape_known:
            self._find_shape()
        ready, self._kept = self._kept, []
        first = next((f.x for f in ready if f.cloud is not None), None)
        return [f if f.x.any() or first is None else TrackedFrame(
            f.number, first, False, f.residual, f.explained, f.gradient, f.precision) for f in ready]

    def _find_shape(self) -> None:
        """The betas from some of the frames kept, and these once more with the person as it is."""
        assert isinstance(self.whole, ShapedBody) and self.body is not None and self.betas is not None
        good = [f for f in self._kept if f.found and f.cloud is not None]
        self._shape_known = True
        if not good:
            return
        chosen = [good[i] for i in spread_poses(np.stack([self.body.vertices(f.x) for f in good]),
                                                self.config.shape_views)]
        clouds = [f.cloud for f in chosen if f.cloud is not None]
        person = shared_shape(self.whole, clouds, np.stack([f.x for f in chosen]), self.betas, self.config)
        self.betas, self.body = person.betas, FixedBody(self.whole.model.subject(person.betas))
        self._fit, self._draws = None, None
        self._kept = [self._refined(f) for f in self._kept]
        self._past = [f.x for f in self._kept[:-3:-1]]

    def _refined(self, frame: TrackedFrame) -> TrackedFrame:
        if frame.cloud is None or not frame.found:
            return frame
        fitter = self._fitter(frame.cloud)
        found = fitter.settle(fitter.on(frame.cloud), frame.x, frame.x)
        return self._tracked(frame.number, found.x, found, frame.cloud)


def follow_frames(tracker: Tracker, frames: Iterator[Frame]) -> Iterator[TrackedFrame]:
    """The frames of a stream, each as soon as it is done."""
    for frame in frames:
        yield from tracker.push(frame)
    yield from tracker.finish()
