"""Motion of a known body from markers: a few frames one after the other, then all of them as a whole."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from model.linear import Subject
from scanprep.threads import one_thread

from ...energy import MovingPoints
from ...motion import Motion
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from .first_frame import search
from .foot_contact import Floor, Standing
from .lowpass import low_pass
from .marked_body import MarkedBody
from .prediction import inertia
from .reinitialise import rescue_limbs
from .robust import LabelWatch, exchangeable, marker_weights
from .settings import AnimateConfig
from .smooth import smooth_sequence
from .stream import Tracker, judge

__all__ = ["AnimateConfig", "MarkerFollower", "animate"]

Progress = Callable[[int, int], None]
GROUND_ROUNDS = 2                    # over the whole sequence, the feet held
KEY_STEPS = 8                        # most steps for a key frame
STILL = 0.005                        # metres that the last round moves any marker of a frame that has settled


@one_thread()
def animate(subject: Subject, markers: MarkerSequence, layout: MarkerLayout, config: AnimateConfig | None = None,
            progress: Progress | None = None) -> Motion:
    """The motion of a body that carries markers.

    Key frames are followed one after the other, each from a prediction. All frames between them begin on the
    way from key to key and are solved together, coupled by how strongly a body accelerates. Markers that are
    missing count nothing, those far off count little, and labels that two have exchanged are put right.

    Parameters
    ----------
    subject : Subject
        The person, of known shape.
    markers : MarkerSequence
    layout : MarkerLayout
        Where on the body the markers sit. Markers that only one of the two knows are left out.
    progress : callable, optional
        Called with (done, total) frames.

    Raises
    ------
    ValueError
        Fewer than 3 markers in common, no frame with 3 of them, a layout of another body.

    [SCAPE] §8
    """
    follower = MarkerFollower(subject, markers, layout, config or AnimateConfig())
    first, T = follower.first_frame(), len(markers.positions)
    if follower.config.smoothing or follower.config.ground:
        x, settled = follower.whole(first, progress)
    else:
        x, settled = follower.one_by_one(np.arange(T), first, progress)
    pose, trans, _ = follower.body.body.split(x)
    if follower.config.low_pass:
        pose, trans = low_pass(pose, trans, markers.rate, follower.config.low_pass)
        x = follower.body.body.join(pose, trans)
    residuals = np.full(markers.positions.shape[:2], np.nan)
    trusted = np.zeros(residuals.shape, dtype=bool)
    residuals[:, follower.rows], trusted[:, follower.rows] = judge(
        follower.positions(x), follower.targets, follower.order, follower.config)
    return Motion(pose.copy(), trans.copy(), subject.betas, markers.rate, residuals, markers.labels,
                  converged=settled, trusted=trusted)


class MarkerFollower:
    """The markers of a sequence, and the body that is to carry them.

    Parameters
    ----------
    subject : Subject
    markers : MarkerSequence
    layout : MarkerLayout
    config : AnimateConfig
    """

    def __init__(self, subject: Subject, markers: MarkerSequence, layout: MarkerLayout, config: AnimateConfig
                 ) -> None:
        labels = layout.matched(markers.labels)
        self.config, self.rate = config, markers.rate
        self.standing: Standing | None = None
        self.rows = np.array([markers.labels.index(label) for label in labels])
        self.targets = markers.positions[:, self.rows]
        self.order = np.tile(np.arange(len(labels)), (len(self.targets), 1))
        self.body = MarkedBody(subject, layout.select(labels), config.prior_weight, config.prior_shrinkage)
        self.prior = self.body.prior
        self.inertia = inertia(config, self.rate, self.body.n_unknowns)

    def follow(self, x: np.ndarray) -> MovingPoints:
        """The markers for unknowns (B, P)."""
        return self.body.follow(x)

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Where the body puts the markers (..., L, 3), metres, for unknowns (..., P)."""
        return self.body.positions(x)

    def taken(self, frames: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Targets (n, L, 3) of some frames, metres, exchanged labels put right."""
        return np.take_along_axis(self.targets[frames], self.order[frames][..., None], axis=1)

    def weights(self, frames: np.ndarray | slice | int, positions: np.ndarray) -> np.ndarray:
        """Weights (..., L) of the markers of some frames, low for outliers."""
        targets = np.take_along_axis(self.targets[frames], self.order[frames][..., None], axis=-2)
        return marker_weights(positions, targets, self.config.marker_sd, self.config.outlier)[0]

    def first_frame(self) -> int:
        """The first frame with nearly as many markers as ever."""
        seen = (~np.isnan(self.targets[..., 0])).sum(axis=1)
        if seen.max(initial=0) < 3:
            raise ValueError(f"markers: expected a frame with at least 3 known markers, the best has "
                             f"{seen.max(initial=0)}")
        return int(np.argmax(seen >= max(3, 0.9 * seen.max())))

    def one_by_one(self, frames: np.ndarray, first: int, progress: Progress | None = None
                   ) -> tuple[np.ndarray, np.ndarray]:
        """Unknowns (n, P) of some frames, each from those before; begins at one of them and goes both ways."""
        x, settled = np.empty((len(frames), self.body.n_unknowns)), np.zeros(len(frames), dtype=bool)
        at = int(np.searchsorted(frames, first))
        start = search(self.body, self.targets[first], self.config)
        ways: tuple[Sequence[int], Sequence[int]] = range(at, len(frames)), range(at - 1, -1, -1)
        done = 0
        for way in ways:
            tracker = Tracker(self.body, self.config, self.rate)
            tracker.begin(x[at] if done else start)
            for i in way:
                x[i], settled[i] = tracker.push(self.targets[frames[i]])
                self.order[frames[i]] = tracker.watch.order
                done += 1
                if progress:
                    progress(done, len(frames))
        return x, settled

    def whole(self, first: int, progress: Progress | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Unknowns (T, P) of all frames together, and which of them settled (T,)."""
        T = len(self.targets)
        x = self.between_keys(first)
        seen = ~np.isnan(self.targets[..., 0])
        some = np.flatnonzero(seen.any(axis=1))
        inside = np.arange(some[0], some[-1] + 1)
        moved = np.zeros(T)
        free = max(self.config.smoothing, 1)
        rounds = free + GROUND_ROUNDS * (self.config.ground and T > 2)
        for i in range(rounds):
            if self.standing:
                self.standing.refresh(self.standing.points(x))
            elif i == free:
                floor = None if self.config.floor is None else Floor.given(self.config.floor)
                self.standing = Standing(self.body, x, self.rate, floor)
            self.find_exchanges(x)
            x[inside] = rescue_limbs(self.body, x[inside], self.taken(inside), self.config)
            better = smooth_sequence(self, x[inside], inside)
            apart = np.linalg.norm(self.positions(better) - self.positions(x[inside]), axis=2)
            moved[inside], x[inside] = apart.max(axis=1), better
            if progress:
                progress(round(T * (i + 1) / rounds), T)
        return x, seen.any(axis=1) & (moved < STILL)

    def between_keys(self, first: int) -> np.ndarray:
        """Unknowns (T, P) on the way from one key frame to the next."""
        T, every = len(self.targets), max(1, round(self.config.key_interval * self.rate))
        frames = np.unique(np.r_[0, np.arange(first % every, T, every), T - 1])
        slow = replace_rate(self, every)
        keys, _ = slow.one_by_one(frames, first)
        i = np.clip(np.searchsorted(frames, np.arange(T), side="right") - 1, 0, max(0, len(frames) - 2))
        if len(frames) == 1:
            return keys
        share = (np.arange(T) - frames[i]) / (frames[i + 1] - frames[i])
        return self.body.retract(keys[i], share[:, None] * self.body.step_to(keys[i], keys[i + 1]))

    def find_exchanges(self, x: np.ndarray) -> None:
        """See in every frame whether labels have been exchanged, the body being at x (T, P)."""
        watch = LabelWatch(self.body.count, self.config.outlier)
        positions = self.positions(x)
        for t, doubtful in enumerate(exchangeable(positions, self.targets, self.config.outlier)):
            if doubtful or not watch.idle:
                watch.update(positions[t], self.targets[t])
            self.order[t] = watch.order


def replace_rate(follower: MarkerFollower, every: int) -> MarkerFollower:
    """The same sequence for frames that lie further apart, with more steps for each."""
    from copy import copy

    slow = copy(follower)
    slow.rate = follower.rate / every
    slow.config = replace(follower.config, iterations=max(KEY_STEPS, follower.config.iterations))
    return slow
