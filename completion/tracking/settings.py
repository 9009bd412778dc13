"""Settings of `track`."""
from __future__ import annotations

from dataclasses import dataclass, field, replace

from scanprep.ranges import Count, Positive, Settings, Share

from ..partial.settings import CompletionConfig


@dataclass(frozen=True)
class TrackConfig(Settings):
    """Settings of `track`.

    Attributes
    ----------
    frame_points : int
        Points of a frame that are matched to the body, all cameras together.
    body_points : int
        Vertices of the body that are matched to the frame.
    normal_points : int
        Neighbours that make one normal; more where the points are noisy.
    reach : float, metres
        First limit on the distance of matches of a frame; it shrinks to `final_reach`.
    final_reach : float, metres
    rounds : int
        Matchings of a frame, at most.
    settled : float, metres
        A frame is settled when a round moves the body by less, as a root mean square.
    evidence : float
        How many independent measurements a frame is worth against what is known before, as in `CompletionConfig`.
    prior_weight : float
        Factor on the pose prior.
    silhouette_weight : float
        How much a vertex counts that stands where a camera saw nothing. A frame is thinned too much to be sure of
        that, so it helps only where many points are kept.
    angle_acceleration : float, radians per second squared
        How strongly joints accelerate, as a standard deviation.
    place_acceleration : float, metres per second squared
        The same for the place.
    momentum : float in [0, 1]
        Share of the velocity that the prediction keeps from frame to frame.
    lost : float, metres
        A frame whose points lie farther from the body than this, on average, is lost.
    explained : float
        So is one of whose points a smaller share has the body near.
    search_every : int
        Of so many frames that are lost one is searched from scratch; the others from the last good pose.
    shape_frames : int
        First frames that are kept until the shape of an unknown person is found from some of them.
    shape_views : int
        How many of these are used together.
    shape_rounds : int
        Matchings of all of them.
    smoothing : int
        Rounds over the whole sequence at the end; 0 leaves the frame-by-frame solution.
    start : CompletionConfig
        How the first frame is completed, and one that is searched from scratch.
    """

    frame_points: Count = 2000
    body_points: Count = 1000
    normal_points: Count = 24
    reach: Positive = 0.1
    final_reach: Positive = 0.03
    rounds: Count = 5
    settled: float = 1e-3
    evidence: float = 400.0
    prior_weight: float = 1.0
    silhouette_weight: float = 0.0
    angle_acceleration: Positive = 60.0
    place_acceleration: Positive = 15.0
    momentum: Share = 0.9
    lost: Positive = 0.03
    explained: Share = 0.7
    search_every: Count = 10
    shape_frames: Count = 24
    shape_views: Count = 8
    shape_rounds: Count = 4
    smoothing: int = 2
    start: CompletionConfig = field(default_factory=CompletionConfig)

    @property
    def scan(self) -> CompletionConfig:
        """How the points of a frame count."""
        return replace(self.start, scan_points=self.frame_points, model_points=self.body_points,
                       evidence=self.evidence, prior_weight=self.prior_weight,
                       silhouette_weight=self.silhouette_weight)
