"""Recordings whose points have no names, of worms, and a labeller that knows the truth, for tests of files."""
import numpy as np
from completion_bodies import MEAN, worm_with_prior
from mosh_folders import BETAS, FRAMES, recorded

from completion import MarkerLayout
from completion.mocap.files.markers import MarkerSequence
from completion.mocap.labelling.assignment import take_columns
from completion.mocap.labelling.label import GHOST, LabelledMarkers
from completion.mocap.labelling.tracks import link_points
from completion.motion import Motion

RATE = 60.0


def worm_points(place, people=("ann",), seed=0):
    """Points (T, C, 3) of worms in the layout of a folder and of a ghost, in another order in every frame.

    Returned are the orders (T, C) in which they are shuffled, the points before that, and the markers (T, L, 3) of
    each person; some are out of sight for a while.
    """
    rng, model = np.random.default_rng(seed), worm_with_prior()
    layout = MarkerLayout.load(place / "layout.json")
    markers = []
    for i, person in enumerate(people):
        places = recorded(model, layout, BETAS[person], float(i))[0] + [0, 2.0 * i, 0]
        places[5:9, 3 + i] = np.nan
        markers.append(places)
    ghost = np.full((FRAMES, 1, 3), [0.5, 0.9, 0.1]) + rng.normal(0, 1e-3, (FRAMES, 1, 3))
    ghost[10:14] = np.nan                                           # two tracks one after the other
    points = np.concatenate([*markers, ghost], axis=1)
    return rng.permuted(np.broadcast_to(np.arange(points.shape[1]), points.shape[:2]), axis=1), points, markers


def shuffle(points, order):
    """The points (T, C, 3), those of each frame in an order (T, C)."""
    return np.take_along_axis(points, order[..., None], axis=1)


class KnowsTruth:
    """In place of `label_people`: each marker is the point at its true place, unless another is known for it."""

    def __init__(self, *markers, confidence=1.0):
        self.markers, self.confidence, self.called = markers, confidence, 0

    def __call__(self, people, points, known=None, progress=None):
        self.called += 1
        at, truth = points.positions, np.concatenate(self.markers, axis=1)
        off = np.nan_to_num(np.linalg.norm(at[:, None] - truth[:, :, None], axis=3), nan=np.inf)
        columns = np.where(off.min(axis=2) < 1e-4, off.argmin(axis=2), -1)
        # what is known goes before, and no point is two markers
        for t, column in zip(*np.nonzero(known >= 0), strict=True):
            columns[t, columns[t] == column] = -1
            columns[t, known[t, column]] = column
        for t, column in zip(*np.nonzero(known == GHOST), strict=True):
            columns[t, columns[t] == column] = -1
        unlabelled = points.seen.copy()
        frames, rows = np.nonzero(columns >= 0)
        unlabelled[frames, columns[frames, rows]] = False
        tracks, out, first = link_points(at, points.rate), [], 0
        for k, (_, layout) in enumerate(people):
            own = columns[:, first:first + len(layout.labels)]
            first += len(layout.labels)
            t = np.arange(FRAMES) / RATE
            poses = MEAN + np.sin(3 * t[:, None, None] + np.arange(4)[:, None] + k) * np.array([0.05, 0.3, 0.2])
            motion = Motion(poses, np.stack([t, 0 * t + 2.0 * k, 0 * t], axis=1), BETAS["ann"], points.rate,
                            np.where(own >= 0, 0.002, np.nan), layout.labels)
            markers = MarkerSequence(take_columns(at, own), layout.labels, points.rate)
            subject = worm_with_prior().subject(BETAS["ann"])
            out.append(LabelledMarkers(markers, own, np.where(own >= 0, self.confidence, 0.0), unlabelled, tracks,
                                       motion, subject, layout, None))
        return out
