"""The schedule of a non-rigid registration, as data. Lengths are multiples of the template's size, √area."""
from __future__ import annotations

from dataclasses import dataclass, field, replace

from ..ranges import Cell, Count, Positive, Settings


@dataclass(frozen=True)
class FinalFitRound(Settings):
    """One round of `final_fit`. Lengths are multiples of the template's size, √area.

    Attributes
    ----------
    field : float
        Length over which rotations and stretches are smoothed.
    tension : float
        Distance to the data that a gradient of one off the smooth field is worth.
    reach : float
        Farthest match that counts.
    """

    field: Positive
    tension: Positive
    reach: Positive


@dataclass(frozen=True)
class FinalFitConfig(Settings):
    """Settings of `final_fit`. Lengths are multiples of the template's size, √area.

    Attributes
    ----------
    rounds : of measuring, smoothing and laying out
    noise_width : float
        Neighbourhood over which the scan's noise is averaged.
    slide : float
        Force of the data along the surface, as a share of that across it.
    stay : float
        Force towards the start where there are no data, as a share of what the data would have.
    landmarks : float
        The share of the surface that one landmark weighs as much as.
    """

    rounds: tuple[FinalFitRound, ...] = (
        FinalFitRound(0.02, 0.007, 0.02),
        FinalFitRound(0.015, 0.004, 0.015),
        FinalFitRound(0.015, 0.004, 0.015),
        FinalFitRound(0.015, 0.004, 0.015),
    )
    noise_width: Positive = 0.007
    slide: float = 0.05
    stay: float = 0.003
    landmarks: float = 0.0002


@dataclass(frozen=True)
class GraphStage(Settings):
    """One stage of the coarse registration. Lengths are multiples of the template's size, √area.

    Attributes
    ----------
    nodes : int
        Nodes of the graph.
    stretch, bend, growth : float
        Resistance of the nodes, as the distance to the data that a strain, a rotation by a radian between
        neighbours, or a growth by e between them is worth; with a growth of 0 nodes keep their size.
    landmarks : float
        The share of the surface that one landmark weighs as much as.
    reach : float
        Farthest match that counts; 0 leaves the scan out.
    slide : float
        Force of a match along the surface, as a share of that across it.
    rounds : int
        Times that matches are sought anew.
    detail : float
        Spacing to which scan and template are thinned for matching.
    positions : float
        How much positions count when matches are sought; 0 seeks by paths alone.
    paths : float
        Distance that a difference by e between path lengths to the landmarks is worth when matching.
    hints : float
        The share of the surface that all given correspondences together weigh as much as.
    ends : bool
        Afterwards, see whether ends of the body are rotated about themselves.
    """

    nodes: Count
    stretch: Positive
    bend: Positive
    growth: float
    landmarks: float
    reach: float
    slide: float = 0.02
    rounds: Count = 2
    detail: Cell = 0.02
    positions: float = 1.0
    paths: float = 0.0
    hints: float = 0.0
    ends: bool = False


@dataclass(frozen=True)
class RegistrationConfig(Settings):
    """Settings of `register`.

    Attributes
    ----------
    graph : stages of the coarse registration by a deformation graph
    ends : int
        How many ends of the body are tried in other rotations about themselves; 0 leaves that out.
    rolls : int
        How many other rolls of the limbs are tried where limbs lie as no person's do; 0 leaves that out.
    final_fit : FinalFitConfig or None
        The last pass: the surface follows the scan below its noise.
    """

    graph: tuple[GraphStage, ...] = (
        GraphStage(150, 0.7, 0.07, 2.0, 0.1, 1.0, 1.0, rounds=4, positions=0.0, paths=0.3, hints=1.0),
        GraphStage(150, 0.5, 0.05, 2.0, 0.1, 0.3, 0.3, rounds=5, positions=0.3, paths=0.3, hints=1.0),
        GraphStage(150, 0.3, 0.03, 0.7, 0.05, 0.2, 0.1, rounds=4, paths=0.2, hints=0.5),
        GraphStage(150, 0.2, 0.02, 0.7, 0.01, 0.15, 0.05, rounds=5, paths=0.1, hints=0.2),
        GraphStage(150, 0.13, 0.013, 0.7, 0.01, 0.11, 0.0, rounds=4, paths=0.05, hints=0.1),
        GraphStage(300, 0.09, 0.009, 0.7, 0.01, 0.08, 0.0, rounds=4),
        GraphStage(300, 0.06, 0.006, 0.7, 0.01, 0.06, 0.0, rounds=4),
        GraphStage(300, 0.02, 0.002, 0.7, 0.01, 0.05, 0.0, rounds=5, detail=0.014, ends=True),
        GraphStage(1000, 0.02, 0.002, 0.35, 0.01, 0.037, detail=0.008),
        GraphStage(1000, 0.015, 0.0015, 0.35, 0.005, 0.028, detail=0.008),
    )
    ends: int = 5
    rolls: int = 3
    final_fit: FinalFitConfig | None = field(default_factory=FinalFitConfig)

    @classmethod
    def quick(cls) -> RegistrationConfig:
        """Without the last steps: a third of the time, 7 mm from true landmarks instead of 6."""
        whole = cls()
        return replace(whole, graph=whole.graph[:-1], final_fit=None)

    @classmethod
    def published(cls) -> RegistrationConfig:
        """The registration that [SCAPE] used: rigid links between neighbours, matches point to point [Hahnel].

        Nodes keep their size; the template is drawn to the landmarks first, then to the scan with ever softer links.
        Not as in the paper: how soft they are and when, which it does not tell; triangles that end inverted are mended,
        and commands press soles to a scan that ends flat around the feet.
        """
        def stage(nodes: int, length: float, landmarks: float, reach: float, rounds: int) -> GraphStage:
            return GraphStage(nodes, length, round(0.1 * length, 6), 0.0, landmarks, reach, 1.0, rounds, detail=1e-4)

        first = (stage(500, 0.7, landmarks, 0.0, 24) for landmarks in (0.001, 0.1, 10.0))
        coarse = (stage(500, length, 0.01, 2 * length, 6) for length in (0.2, 0.1, 0.06, 0.04))
        fine = (stage(2000, length, 0.005, 0.04, 6) for length in (0.04, 0.02))
        return cls((*first, *coarse, *fine), 0, 0, None)
