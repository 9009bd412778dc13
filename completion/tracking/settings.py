"""Settings of `track`."""
from __future__ import annotations

from dataclasses import dataclass, field, replace

from scanprep.ranges import Count, Positive, Settings

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
    rounds : int
        Matchings of a frame, at most.
    angle_acceleration : float, radians per second squared
        Standard deviation of the acceleration of joint angles.
    place_acceleration : float, metres per second squared
        Standard deviation of the acceleration of the place.
    lost : float, metres
        A frame is lost when its points lie farther from the body than this, on average.
    search_every : int
        One of so many lost frames is searched from scratch; the others start from the last good pose.
    shape_frames : int
        First frames that are kept until the shape of an unknown person is found from some of them.
    shape_views : int
        How many of these frames are used together, those that differ most.
    smoothing : int
        Rounds of temporal smoothing over the whole sequence at the end; 0 leaves the frame-by-frame solution.
    start : CompletionConfig
        How the first frame, and one that is searched from scratch, is completed.

    Examples
    --------
    >>> TrackConfig(frame_points=500).scan.scan_points
    500

    [SCAPE-patent] claims 11-15
    """

    frame_points: Count = 2000
    body_points: Count = 1000
    normal_points: Count = 24
    rounds: Count = 5
    angle_acceleration: Positive = 60.0
    place_acceleration: Positive = 15.0
    lost: Positive = 0.03
    search_every: Count = 10
    shape_frames: Count = 24
    shape_views: Count = 8
    smoothing: int = 2
    start: CompletionConfig = field(default_factory=CompletionConfig)

    @property
    def scan(self) -> CompletionConfig:
        """Settings of the fit to one frame; its points are too sparse to tell where a camera saw free space."""
        return replace(self.start, scan_points=self.frame_points, model_points=self.body_points, free_space_weight=0.0)
