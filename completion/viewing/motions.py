"""Motions of any length as the browser plays them: few columns, from the fast path itself."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from model.linear import Subject
from model.motion.bvh import USUAL_RATE
from scanprep.geometry.farthest_points import spread_indices
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.colors import heat
from scanprep.pictures.low_rank import low_rank
from scanprep.pictures.shading import CLAY, Dots, Moving
from scanprep.words import number_of

from ..mocap.files.markers import MarkerSequence, marker_subjects, read_markers
from ..motion import Motion
from .contents import MARKER, SHOWN_OFF, Content, MarkersTold, Stance, body_shades

MADE = 150                           # frames that the columns are made from
AT_ONCE = 256                        # frames whose coefficients are computed together


def of_motion(name: str, motion: Motion, subject: Subject, markers: MarkerSequence | None = None) -> Content:
    """A body in motion, with the markers that were measured."""
    some = spread_indices(len(motion.poses), MADE)
    frames = motion.vertices(subject, some)
    basis, coefficients = as_columns(motion, subject, frames)
    body = subject.template.with_vertices(frames[0].astype(float))
    shapes = [Moving(body_shades(body, subject.skeleton.part_of_face, name="body"), frames[:1], motion.rate,
                     (basis, coefficients))]
    at_rest = subject.template.with_vertices(subject.vertices(np.zeros((len(subject.skeleton.parents), 3))))
    stance = Stance.of(at_rest, motion.poses).around(frames[:, ::7])
    content = Content(name, shapes, stance, lasting(motion.poses, motion.rate), stance.around(frames[0]))
    return content if markers is None else with_markers(content, motion, markers)


def as_columns(motion: Motion, subject: Subject, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns (N, r) and coefficients (T, r, 3) of all vertices in all frames, from some of the frames (n, N, 3).

    What the fast path adds up for a body lies in few columns, whatever it does. So the columns are those of some
    frames, and in all others the coefficients come from the fast path's own, without a vertex being made.
    """
    basis = columns_of(frames.astype(np.float64))
    columns = subject.operator.combine(basis.T).astype(np.float64)
    place = (subject.origin + motion.trans)[:, None] * basis.sum(axis=0)[:, None]
    out = np.concatenate([columns.relative_positions(motion.poses[i:i + AT_ONCE])
                          for i in range(0, len(motion.poses), AT_ONCE)])
    return basis, np.swapaxes(out, 1, 2) + place


def columns_of(frames: np.ndarray) -> np.ndarray:
    """Orthonormal columns (N, r) in which frames (n, N, 3) lie, the first moves all vertices alike."""
    made, _ = low_rank(frames)
    return np.linalg.qr(np.hstack([np.full((made.shape[0], 1), made.shape[0] ** -0.5), made]))[0]


def with_markers(content: Content, motion: Motion, markers: MarkerSequence) -> Content:
    """The motion with measured markers as dots: the further from where the body puts them, the darker."""
    residuals = np.full(markers.positions.shape[:2], np.nan)
    known = [(markers.labels.index(label), i) for i, label in enumerate(motion.labels) if label in markers.labels]
    if len(markers.positions) == len(motion.poses) and known:
        ours, theirs = (list(side) for side in zip(*known, strict=True))
        residuals[:, ours] = motion.residuals[:, theirs]
        markers = replace(markers, positions=np.where(np.isin(np.arange(len(markers.labels)), ours)[:, None]
                                                      & np.isnan(residuals)[..., None], np.nan, markers.positions))
    seen = np.isfinite(residuals)
    mean = np.where(seen, residuals, 0).sum(axis=0) / np.where(seen.any(axis=0), seen.sum(axis=0), np.nan)
    dots = replace(first_marker_dots(markers), color=heat(mean, 0.0, SHOWN_OFF) if seen.any() else MARKER)
    shown = Moving(dots, markers.positions, markers.rate)
    about = MarkersTold(len(content.shapes), markers.labels, residuals) if seen.any() else None
    return replace(content, shapes=[*content.shapes, shown], markers=about)


def first_marker_dots(markers: MarkerSequence) -> Dots:
    """The markers of the first frame that has any."""
    return Dots(markers.positions[0], MARKER, 0.013, name="markers")


def read_recording(path: Path, unit: str | None, rate: float | None = None) -> MarkerSequence:
    """The markers of all people in a file, labels with the name of each where there are several; played with a usual
    rate where the file does not say its own.
    """
    people = marker_subjects(path)
    if len(people) < 2:
        return read_markers(path, unit, rate=rate, usual_rate=USUAL_RATE)
    each = [read_markers(path, unit, who, rate, USUAL_RATE) for who in people]
    labels = [f"{who}:{label}" for who, one in zip(people, each, strict=True) for label in one.labels]
    return MarkerSequence(np.concatenate([one.positions for one in each], axis=1), tuple(labels), each[0].rate)


def of_markers(name: str, markers: MarkerSequence) -> Content:
    """Measured markers alone."""
    whole = int(markers.seen.sum(axis=1).argmax())
    points = markers.positions[whole][markers.seen[whole]]
    if not len(points):
        raise ValueError(f"{name}: no marker was seen in any frame")
    stance = Stance.of(Mesh(points, np.zeros((0, 3), dtype=np.int64)))
    every = markers.positions[::max(1, len(markers.positions) // 200)].reshape(-1, 3)
    every = every[np.isfinite(every).all(axis=1)]
    every = np.concatenate([every, points])
    dots = replace(first_marker_dots(markers), labels=markers.labels, color=CLAY)
    about = f"{number_of(len(markers.labels), 'marker')}, {lasting(markers.positions, markers.rate)}"
    return Content(name, [Moving(dots, markers.positions, markers.rate)], stance.around(every), about,
                   stance.around(points))


def lasting(frames: np.ndarray, rate: float) -> str:
    """How long a motion is."""
    return f"{number_of(len(frames), 'frame')} at {rate:g}/s, {len(frames) / rate:.3g} s"
