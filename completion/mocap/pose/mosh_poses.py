"""The second stage: the poses of every frame of a person whose shape and markers are known."""
from __future__ import annotations

import numpy as np

from model.linear import Subject

from ...motion import Motion
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..settings import FollowConfig
from .follow import Progress, animate
from .settings import AnimateConfig

CENTIMETRE = 0.01                    # metres
RATE = 120.0                         # frames per second for which the weight of the velocity is meant


def follow_poses(subject: Subject, markers: MarkerSequence, layout: MarkerLayout, config: FollowConfig | None = None,
                 progress: Progress | None = None) -> Motion:
    """The motion of a person in a sequence; `animate` with the weights of the paper.

    Parameters
    ----------
    subject : Subject
        The person.
    markers : MarkerSequence
    layout : MarkerLayout
        Where the markers sit on the person.
    config : FollowConfig, optional
    progress : callable, optional
        Called with (done, total) frames.

    Raises
    ------
    ValueError
        Fewer than 3 markers in common, no frame with 3 of them, a layout of another body.

    [MoSh] Eq. 23
    """
    return animate(subject, markers, layout, animate_config(config or FollowConfig()), progress)


def animate_config(config: FollowConfig) -> AnimateConfig:
    """The settings of `animate` for weights of the terms.

    A weight is the inverse of a squared deviation. That of the velocity's change from frame to frame is meant for 120
    frames per second; at another rate the acceleration that it allows is the same.

    [MoSh] Eq. 17, Eq. 21, Eq. 22
    """
    return AnimateConfig(marker_sd=CENTIMETRE / np.sqrt(config.data), prior_weight=config.pose,
                         angle_acceleration=RATE**2 / np.sqrt(config.velocity), outlier=config.outlier,
                         prior_shrinkage=config.prior_shrinkage)
