"""Check a scan and its landmarks, and convert them to metres."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from model.fitting.bodies import FixedBody
from model.fitting.scale import landmark_scale, rough_scale
from model.fitting.scan import Scan, ScanPoints, all_points, check_mask, prepare_picture, prepare_scan
from scanprep.correspondence.correspondences import check_pairs
from scanprep.depth_camera.picture import DepthPicture
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import size
from scanprep.plausible import check_unit

from .settings import CompletionConfig


@dataclass(frozen=True, eq=False)
class Given:
    """A scan and its landmarks, in metres."""

    cloud: ScanPoints       # of all views
    vertices: np.ndarray    # (L,) int
    points: np.ndarray      # (L, 3), metres, the landmarks
    metres: float = 1.0     # per unit of the original scan

    def scale_by(self, factor: float) -> Given:
        """Return a copy with all lengths multiplied by a factor."""
        return replace(self, cloud=self.cloud.scale_by(factor), points=factor * self.points,
                       metres=factor * self.metres)


def prepare_in_metres(body: FixedBody, scan: Scan, landmarks: tuple[np.ndarray, np.ndarray] | None,
                      masked: np.ndarray | None, config: CompletionConfig) -> Given:
    """Prepare a scan for matching; a scan of unknown scale comes as close to metres as possible before the fit."""
    metres = 1.0
    if isinstance(scan, DepthPicture):
        return _of_picture(body, scan, landmarks, masked, config)
    # unknown unit: a first guess from how far the points without clothing extend
    if config.free_scale:
        every = all_points(scan)
        bare = every if masked is None else every[~check_mask(masked, len(every))]
        metres = rough_scale(body, bare)
    else:
        check_unit(all_points(scan), body.template.vertices, "the scan is")
    # landmarks in the same unit; with enough of them the scale is refined
    vertices, points = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    if landmarks is not None:
        vertices, points = check_landmarks((landmarks[0], metres * np.asarray(landmarks[1])), body.template)
    given = Given(prepare_scan(scan, config.viewpoint, masked, metres), vertices, points, metres)
    if config.free_scale and len(vertices):
        return given.scale_by(landmark_scale(body, vertices, points, config))
    return given


def _of_picture(body: FixedBody, picture: DepthPicture, landmarks: tuple[np.ndarray, np.ndarray] | None,
                masked: np.ndarray | None, config: CompletionConfig) -> Given:
    """Return the person in a picture; ValueError for settings that only other scans have."""
    excluded = {"free_scale": config.free_scale, "viewpoint": config.viewpoint is not None,
                "masked": masked is not None}
    if any(excluded.values()):
        raise ValueError(f"{next(name for name in excluded if excluded[name])}: expected none with a depth picture, "
                         "which is in metres in its camera's frame; set the depth of what is to be left out to 0")
    marks = (np.zeros(0, dtype=np.int64), np.zeros((0, 3))) if landmarks is None else \
        check_landmarks(landmarks, body.template)
    return Given(prepare_picture(picture, size(body.template), marks[1]), *marks)


def check_landmarks(landmarks: tuple[np.ndarray, np.ndarray], template: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return landmark vertices (L,) and points (L, 3) as arrays; ValueError for another size than the template's."""
    vertices, points = check_pairs(template, *landmarks, "landmarks")
    extent, whole = (float(np.ptp(p, axis=0).max()) for p in (points, template.vertices))
    if not whole / 100 < extent < 5 * whole:
        raise ValueError(f"landmarks: they extend over {extent:.3g} m, the template over {whole:.3g} m; "
                         "expected the scan in metres: the wrong unit? (--unit)")
    return vertices, points
