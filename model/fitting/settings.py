"""Settings of the fit of a body to a scan."""
from __future__ import annotations

from dataclasses import dataclass

from scanprep.ranges import Count, Positive, Settings, Signed


@dataclass(frozen=True)
class ScanFitConfig(Settings):
    """Settings of the fit of a body to a scan.

    Attributes
    ----------
    twist_weight : float
        w_T of Eq. 11: how strongly one round holds the joint angles of the round before; for the alternation in
        square metres, against the squared edges of a part.
    landmark_sd : float, metres
        How far a landmark may lie from its vertex.
    scan_sd : float, metres
        How far the scan lies from the predicted mesh, as the model is not exact.
    prior_weight : float
        Factor on the pose prior once the scan is used.
    correspondences : bool
        Landmarks are multiplied first, by correlated correspondence, for closer starts; on the poses this was
        tuned on it changed the starts and not where they ended.
    rounds : int
        Matchings while the reach of matches shrinks.
    scan_points : int
        Points of the scan that are matched to the model.
    model_points : int
        Vertices of the model that are matched to the scan.
    random_starts : int
        Poses drawn at random around each start, and for each limb that may be wrong.
    free_space_weight : float
        How much a vertex counts that stands where a single camera saw nothing, against one that lies on the
        scan; 0 when the scan has parts cut away by hand.
    up : (3,) floats, optional
        The direction that is up in the scan, where people in it mostly stand; without it all directions are tried,
        and for a depth picture its four sides.
    ignored_parts : names of parts
        Parts of the body that the scan says nothing about, though it may show something there.
    """

    twist_weight: float = 1.0
    landmark_sd: Positive = 0.01
    scan_sd: Positive = 0.008
    prior_weight: float = 1.0
    correspondences: bool = False
    rounds: Count = 8
    scan_points: Count = 2500
    model_points: Count = 1200
    random_starts: int = 60
    free_space_weight: float = 0.5
    up: tuple[Signed, Signed, Signed] | None = None
    ignored_parts: tuple[str, ...] = ()
