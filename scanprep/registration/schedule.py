"""The schedule of a non-rigid registration, as data."""
from __future__ import annotations

from dataclasses import dataclass, field

from ..ranges import Cell, Count, Positive, Settings
from .affine import LinkStage, allen_stages, amberg_stages, hahnel_stages
from .final_fit import SettleConfig
from .limb_twists import TwistConfig


@dataclass(frozen=True)
class GraphStage(Settings):
    """One stage of the coarse registration. Lengths are multiples of the template's size, √area.

    Attributes
    ----------
    nodes : int
        Nodes of the graph.
    stretch, bend, growth : float
        Resistance of the nodes, as the distance to the data that a strain, a turn by a radian between
        neighbours, or a growth by e between them is worth.
    landmarks : float
        The share of the surface that one landmark weighs as much as.
    reach : float
        Farthest match that counts; 0 leaves the scan out.
    slide : float
        Force of a match along the surface, as a share of that across it.
    rounds : int
        Times that matches are sought anew; without matches, most steps.
    detail : float
        Spacing to which scan and template are thinned for matching.
    place : float
        How much positions count when matches are sought; 0 seeks by paths alone.
    paths : float
        Distance that a difference by e between path lengths to the landmarks is worth when matching.
    twists : bool
        Afterwards, see whether ends of the body are turned about themselves.
    hints : float
        The share of the surface that all given correspondences together weigh as much as.
    """

    nodes: Count
    stretch: Positive
    bend: Positive
    growth: Positive
    landmarks: float
    reach: float
    slide: float = 0.02
    rounds: Count = 2
    detail: Cell = 0.02
    place: float = 1.0
    paths: float = 0.0
    hints: float = 0.0
    twists: bool = False


@dataclass(frozen=True)
class ShellStage(Settings):
    """One round of the last pass. Lengths are multiples of the template's size, √area.

    Attributes
    ----------
    smoothing : float
        Details smaller than this are damped.
    tension : float
        Distance to the data that a gradient of one is worth.
    landmarks, reach, slide : float
        As in `GraphStage`.
    """

    smoothing: float
    tension: Positive
    landmarks: float
    reach: Positive
    slide: float = 0.02


@dataclass(frozen=True)
class RegistrationConfig(Settings):
    """Settings of `register`.

    Attributes
    ----------
    graph : stages of the coarse registration
    links : stages of a published regulariser, after or instead of those of the graph (see `published`)
    shell : rounds in which the surface follows the scan as a thin shell
    twists : TwistConfig
        The search for ends of the body that are turned about themselves.
    settle : SettleConfig or None
        The last pass.
    path_cell : float
        Spacing of the points that paths to the landmarks run over, as a multiple of the template's size.
    neighbours : int
        Points of the scan over which its normals are averaged.
    normal_weight : float
        Distance, as a multiple of the template's size, that a difference of normals of one is worth when
        matching.
    near : float
        Data farther from a vertex than this multiple of the size are not data of that vertex.
    settled : float
        Converged when the last round moves the mean vertex by less than this multiple of the size.
    """

    graph: tuple[GraphStage, ...] = (
        GraphStage(300, 0.7, 0.07, 2.0, 0.1, 1.0, 1.0, rounds=4, place=0.0, paths=0.3, hints=1.0),
        GraphStage(300, 0.5, 0.05, 2.0, 0.1, 0.3, 0.3, rounds=5, place=0.3, paths=0.3, hints=1.0),
        GraphStage(300, 0.3, 0.03, 0.7, 0.05, 0.2, 0.1, rounds=4, paths=0.2, hints=0.5),
        GraphStage(300, 0.2, 0.02, 0.7, 0.01, 0.15, 0.05, rounds=5, paths=0.1, hints=0.2),
        GraphStage(300, 0.13, 0.013, 0.7, 0.01, 0.11, 0.0, rounds=4, paths=0.05, hints=0.1),
        GraphStage(300, 0.09, 0.009, 0.7, 0.01, 0.08, 0.0, rounds=4),
        GraphStage(300, 0.06, 0.006, 0.7, 0.01, 0.06, 0.0, rounds=4),
        GraphStage(300, 0.02, 0.002, 0.7, 0.01, 0.05, 0.0, rounds=5, twists=True),
        GraphStage(1000, 0.02, 0.002, 0.35, 0.01, 0.037, detail=0.008),
        GraphStage(1000, 0.015, 0.0015, 0.35, 0.005, 0.028, detail=0.008),
    )
    links: tuple[LinkStage, ...] = ()
    shell: tuple[ShellStage, ...] = ()
    twists: TwistConfig = field(default_factory=TwistConfig)
    settle: SettleConfig | None = field(default_factory=SettleConfig)
    path_cell: Cell = 0.012
    neighbours: Count = 16
    normal_weight: float = 0.04
    near: Positive = 0.015
    settled: float = 0.001


PUBLISHED = {"hahnel": hahnel_stages, "allen": allen_stages, "amberg": amberg_stages}


def published(method: str) -> RegistrationConfig:
    """Settings with the regulariser of a published method in place of ours, and without our last pass.

    Parameters
    ----------
    method : "hahnel", "allen" or "amberg"

    Raises
    ------
    ValueError
        Another name.

    [Hahnel], [Allen], [Amberg]
    """
    if method not in PUBLISHED:
        raise ValueError(f"method: expected one of {', '.join(PUBLISHED)}, got {method!r}")
    return RegistrationConfig(graph=(), links=PUBLISHED[method](), settle=None)
