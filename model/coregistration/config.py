"""Settings of co-registration."""
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from scanprep.batch.pool import Workers
from scanprep.ranges import FLAG, Count, Settings, Share
from scanprep.registration.schedule import GraphStage, RegistrationConfig

from ..fitting.settings import ScanFitConfig
from ..learning.config import LearnConfig

# the predicted mesh is near the scan already: fine stages only, whose stiffness is relative to the predicted shape
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
        Settings of the fit of the model to a scan.
    registration : RegistrationConfig
        Settings of the non-rigid registration, which starts from the predicted mesh and keeps its shape.
    learn : LearnConfig
        Settings of learning the model again.
    rounds : int
        Largest number of rounds of registering all scans and learning the model.
    failed : float
        A scan has failed if a larger share of its points stays unexplained. The model is not learned from it.
    workers : Workers
        Processes that register scans at the same time.

    Examples
    --------
    >>> CoregistrationConfig(rounds=1).rounds
    1

    [BlendSCAPE]
    """

    # 15 mm: predicted bodies of 20 scans were 12.43 mm off on average; with 8 mm, as in `complete`, 12.58 mm
    fit: ScanFitConfig = field(default_factory=lambda: ScanFitConfig(scan_sd=0.015))
    registration: RegistrationConfig = NEAR
    learn: LearnConfig = field(default_factory=LearnConfig)
    rounds: Annotated[Count, FLAG] = 3
    failed: Share = 0.015
    workers: Workers = field(default_factory=Workers)
