"""People in motion with markers whose names are taken away, for the tests of labelling."""
import numpy as np

from completion.mocap.files.markers import MarkerSequence
from completion.mocap.marker_sets.named import choose_layout
from completion.mocap.pose.marked_body import MarkedBody
from model import load_model
from model.human_poses import human_poses

RATE, FRAMES = 60.0, 60


def person(seed=0, name="cmu41", frames=FRAMES, at=(0.0, 0.0)):
    """A subject of the built-in people, its layout, and markers (T, L, 3) while it goes from one pose to another."""
    model = load_model("people")
    rng = np.random.default_rng(seed)
    subject = model.subject(rng.normal(size=8))
    layout, _ = choose_layout(model, name, ())
    body = MarkedBody(subject, layout, 0.3, 0.3)
    ends = human_poses(subject.template, subject.skeleton, 2, np.random.default_rng(seed + 3))
    share = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, frames))
    poses = ends[0] + share[:, None, None] * (ends[1] - ends[0])
    poses[:, 0] = ends[0, 0]
    trans = np.zeros((frames, 3))
    trans[:, np.argsort(np.ptp(subject.template.vertices, axis=0))[:2]] = np.array(at) + 0.4 * share[:, None]
    return subject, layout, body.positions(body.body.join(poses, trans)) + rng.normal(size=(frames, 1, 1)) * 0.0003


def shuffled(places, seed=1):
    """Points (T, C, 3) in another order in every frame, and which marker (T, C) each is."""
    rng = np.random.default_rng(seed)
    order = np.stack([rng.permutation(places.shape[1]) for _ in places])
    return np.take_along_axis(places, order[..., None], axis=1), order


def unnamed(points, rate=RATE):
    """A sequence of points without names."""
    return MarkerSequence(points, tuple(f"*{i}" for i in range(points.shape[1])), rate)


def share_right(columns, truth):
    """The share of the observations that have the right label."""
    frames, rows = np.nonzero(columns >= 0)
    return (truth[frames, columns[frames, rows]] == rows).sum() / (truth >= 0).sum()
