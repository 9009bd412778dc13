"""Settings of co-registration."""
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from scanprep.batch.pool import Workers
from scanprep.ranges import FLAG, Count, Settings, Share
from scanprep.registration.schedule import GraphStage, RegistrationConfig

from ..fitting.settings import ScanFitConfig
from ..learning.config import LearnConfig

# the predicted mesh lies near already: fine stages only, whose stiffness is relative to the prediction's own shape
NEAR = RegistrationConfig(graph=(
    GraphStage(300, 0.09, 0.7, 0.01, 0.08),
    GraphStage(300, 0.06, 0.7, 0.01, 0.06),
    GraphStage(1000, 0.04, 0.35, 0.01, 0.05, detail=0.008),
    GraphStage(1000, 0.025, 0.35, 0.01, 0.037, detail=0.008),
))


@dataclass(frozen=True)
class CoregistrationConfig(Settings):
    """Settings of `register_with_model` and `coregister`.

    Attributes
    ----------
    fit : ScanFitConfig
        How the model is brought to a scan.
    registration : RegistrationConfig
        Of the template as the model predicts it, which resists by the predicted shape.
    learn : LearnConfig
        How the model is learned again.
    rounds : int
        Most times that all scans are registered and the model is learned.
    tolerance : float
        Settled when a round moves the mean vertex by less than this share of √area.
    failed : float
        A scan of which a larger share of points stays unexplained has failed, and does not teach the model.
    workers : Workers
    """

    # with 0.008 m, the value of `complete`, predicted bodies of 20 scans were 12.58 mm off on average, not 12.43
    fit: ScanFitConfig = field(default_factory=lambda: ScanFitConfig(scan_sd=0.015))
    registration: RegistrationConfig = NEAR
    learn: LearnConfig = field(default_factory=LearnConfig)
    rounds: Annotated[Count, FLAG] = 3
    tolerance: float = 0.0007
    failed: Share = 0.015
    workers: Workers = field(default_factory=Workers)
