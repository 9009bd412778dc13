"""Motions of any length for the browser: a few columns and coefficients, without computing all vertices."""
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
from .contents import MARKER, SHOWN_OFF, Content, MarkerResiduals, Stance, body_shades

MADE = 150                           # frames that the columns are computed from: they span more than a body has
AT_ONCE = 256                        # frames computed together: fast, and little memory


def of_motion(name: str, motion: Motion, subject: Subject, markers: MarkerSequence | None = None) -> Content:
    """Show a body in motion, with the measured markers."""
    sample = spread_indices(len(motion.poses), MADE)
    frames = motion.vertices(subject, sample)
    basis, coefficients = as_columns(motion, subject, frames)
    body = subject.template.with_vertices(frames[0].astype(float))
    shapes = [Moving(body_shades(body, subject.skeleton.part_of_face, name="body"), frames[:1], motion.rate,
                     (basis, coefficients))]
    at_rest = subject.template.with_vertices(subject.vertices(np.zeros((len(subject.skeleton.parents), 3))),
                                             subject.template.up)
    stance = Stance.of(at_rest, motion.poses).around(frames[:, ::7])
    content = Content(name, shapes, stance, lasting(motion.poses, motion.rate), stance.around(frames[0]))
    return content if markers is None else with_markers(content, motion, markers)


def as_columns(motion: Motion, subject: Subject, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factor all vertices in all frames into columns (N, r) and coefficients (T, r, 3), from sample frames (n, N, 3).

    The body's vertices lie in the span of few columns, whatever it does. So the columns come from the sample. For all
    other frames the fast path computes coefficients directly, without computing vertices.
    """
    basis = columns_of(frames.astype(np.float64))
    columns = subject.operator.combine(basis.T).astype(np.float64)
    # the body's place, expressed in the columns
    place = (subject.origin + motion.trans)[:, None] * basis.sum(axis=0)[:, None]
    relative = np.concatenate([columns.relative_positions(motion.poses[i:i + AT_ONCE])
                               for i in range(0, len(motion.poses), AT_ONCE)])
    return basis, np.swapaxes(relative, 1, 2) + place


def columns_of(frames: np.ndarray) -> np.ndarray:
    """Compute orthonormal columns (N, r) that span frames (n, N, 3); the first moves all vertices alike."""
    made, _ = low_rank(frames)
    return np.linalg.qr(np.hstack([np.full((made.shape[0], 1), made.shape[0] ** -0.5), made]))[0]


def with_markers(content: Content, motion: Motion, markers: MarkerSequence) -> Content:
    """Add measured markers as dots: the darker, the further from where the body puts them."""
    residuals = np.full(markers.positions.shape[:2], np.nan)
    pairs = [(markers.labels.index(label), i) for i, label in enumerate(motion.labels) if label in markers.labels]
    # residuals of markers that both have; where a marker was not used, it is not drawn
    if len(markers.positions) == len(motion.poses) and pairs:
        in_recording, in_motion = (list(side) for side in zip(*pairs, strict=True))
        residuals[:, in_recording] = motion.residuals[:, in_motion]
        markers = replace(markers, positions=np.where(np.isin(np.arange(len(markers.labels)), in_recording)[:, None]
                                                      & np.isnan(residuals)[..., None], np.nan, markers.positions))
    seen = np.isfinite(residuals)
    mean = np.where(seen, residuals, 0).sum(axis=0) / np.where(seen.any(axis=0), seen.sum(axis=0), np.nan)
    dots = replace(first_marker_dots(markers), color=heat(mean, 0.0, SHOWN_OFF) if seen.any() else MARKER)
    shown = Moving(dots, markers.positions, markers.rate)
    about = MarkerResiduals(len(content.shapes), markers.labels, residuals) if seen.any() else None
    return replace(content, shapes=[*content.shapes, shown], markers=about)


def first_marker_dots(markers: MarkerSequence) -> Dots:
    """Return the markers of the first frame as dots."""
    return Dots(markers.positions[0], MARKER, 0.013, name="markers")


def read_recording(path: Path, unit: str | None, rate: float | None = None) -> MarkerSequence:
    """Read the markers of all people in a file; with several people, labels begin with the name of the person.

    A file without a frame rate is played at a usual one.
    """
    people = marker_subjects(path)
    if len(people) < 2:
        return read_markers(path, unit, rate=rate, usual_rate=USUAL_RATE)
    each = [read_markers(path, unit, who, rate, USUAL_RATE) for who in people]
    labels = [f"{who}:{label}" for who, one in zip(people, each, strict=True) for label in one.labels]
    return MarkerSequence(np.concatenate([one.positions for one in each], axis=1), tuple(labels), each[0].rate)


def of_markers(name: str, markers: MarkerSequence) -> Content:
    """Show measured markers alone."""
    # the frame with most markers shows how the person stands; 200 frames show where it goes
    fullest = int(markers.seen.sum(axis=1).argmax())
    points = markers.positions[fullest][markers.seen[fullest]]
    if not len(points):
        raise ValueError(f"{name}: no marker was seen in any frame")
    stance = Stance.of(Mesh(points, np.zeros((0, 3), dtype=np.int64)))
    all_points = markers.positions[::max(1, len(markers.positions) // 200)].reshape(-1, 3)
    all_points = all_points[np.isfinite(all_points).all(axis=1)]
    all_points = np.concatenate([all_points, points])
    dots = replace(first_marker_dots(markers), labels=markers.labels, color=CLAY)
    about = f"{number_of(len(markers.labels), 'marker')}, {lasting(markers.positions, markers.rate)}"
    return Content(name, [Moving(dots, markers.positions, markers.rate)], stance.around(all_points), about,
                   stance.around(points))


def lasting(frames: np.ndarray, rate: float) -> str:
    """Return the length of a motion as text."""
    return f"{number_of(len(frames), 'frame')} at {rate:g}/s, {len(frames) / rate:.3g} s"
