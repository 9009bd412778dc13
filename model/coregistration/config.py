"""Settings of co-registration."""
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from scanprep.batch.pool import Workers
from scanprep.ranges import FLAG, Cell, Count, Positive, Settings, Share, Signed
from scanprep.registration.schedule import GraphStage, RegistrationConfig

from ..learning.config import LearnConfig


@dataclass(frozen=True)
class PoseStage(Settings):
    """One stage of bringing the model to a scan by its pose and betas alone. Lengths are shares of √area.

    Attributes
    ----------
    reach : float
        Farthest match that counts.
    slide : float
        Force of a match along the surface, as a share of that across it.
    prior : float
        Distance to the data that a joint one standard deviation away from the training poses is worth.
    landmarks : float
        The share of the surface that one landmark weighs as much as.
    rounds : int
        Times that matches are sought anew.
    detail : float
        Spacing to which the scan is thinned.
    sample : int
        Vertices of the model that are matched.
    """

    reach: Positive
    slide: float
    prior: Positive
    landmarks: float
    rounds: Count = 5
    detail: Cell = 0.02
    sample: Count = 600


@dataclass(frozen=True)
class ModelFitConfig(Settings):
    """Settings of bringing the model to a scan.

    Attributes
    ----------
    search : stages that every start goes through
    refine : stages that follow, once for starts that end alike
    axes : int
        Typical poses are the mean of the training poses and a step both ways along so many main directions.
    turns : int
        Without landmarks, each typical pose is turned so often about the vertical.
    up : (3,) float, optional
        The vertical; by default the coordinate axis along which the template is longest.
    normal_weight : float
        Distance, as a share of √area, that a difference of normals of one is worth when matching.
    n_betas : int
        Most shape components used while the pose is sought.
    shape_prior : float
        Distance to the data, as a share of √area, that one standard deviation of a beta is worth.
    least : int
        Starts that are tried in any case: an arm turned about itself explains a scan as well.
    agreed : int
        After more than `turns`, none is tried once so many have ended alike, better than all others.
    near, enough : float
        Nor is any, after the least, once the share `enough` of the scan's points is nearer to the body than the share
        `near` of √area.
    """

    search: tuple[PoseStage, ...] = (
        PoseStage(0.25, 0.5, 0.003, 0.02, 5, 0.04, 250),
        PoseStage(0.15, 0.3, 0.002, 0.02, 5, 0.04, 250),
    )
    refine: tuple[PoseStage, ...] = (
        PoseStage(0.1, 0.2, 0.0015, 0.01),
        PoseStage(0.06, 0.1, 0.001, 0.01),
        PoseStage(0.04, 0.05, 0.0007, 0.01),
    )
    axes: int = 6
    turns: Count = 8
    up: tuple[Signed, Signed, Signed] | None = None
    normal_weight: float = 0.05
    n_betas: int = 20
    shape_prior: Positive = 0.0005
    least: Count = 2
    agreed: Count = 4
    near: Positive = 0.02
    enough: Share = 0.98


EXPLAINED = 0.006                    # share of √area: scan points so near to the mesh, facing alike, are explained

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
    fit : ModelFitConfig
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

    fit: ModelFitConfig = field(default_factory=ModelFitConfig)
    registration: RegistrationConfig = NEAR
    learn: LearnConfig = field(default_factory=LearnConfig)
    rounds: Annotated[Count, FLAG] = 3
    tolerance: float = 0.0007
    failed: Share = 0.015
    workers: Workers = field(default_factory=Workers)
