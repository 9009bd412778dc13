"""Settings of `track`."""
from __future__ import annotations

from dataclasses import dataclass, field, replace

from scanprep.ranges import Count, Positive, Settings

from ..partial.settings import CompletionConfig

BODY_POINTS = 1000                   # vertices of the body that are matched to a frame, half as many as its points


@dataclass(frozen=True)
class TrackConfig(Settings):
    """Settings of `track`.

    Attributes
    ----------
    frame_points : int
        Points of a frame that are matched to the body, all cameras together.
    lost : float, metres
        A frame is lost when its points lie farther from the body than this, on average.
    shape_frames : int
        First frames that are kept until the shape of an unknown person is found from some of them.
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
    lost: Positive = 0.03
    shape_frames: Count = 24
    smoothing: int = 2
    start: CompletionConfig = field(default_factory=CompletionConfig)

    @property
    def scan(self) -> CompletionConfig:
        """Settings of the fit to one frame; its points are too sparse to tell where a camera saw free space."""
        return replace(self.start, scan_points=self.frame_points, model_points=BODY_POINTS, free_space_weight=0.0)
