"""The schedule of a non-rigid registration, as data. Lengths are multiples of the template's size, √area."""
from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

from ..ranges import FLAG, Axis, Cell, Count, Positive, Settings

NOISE_WIDTH = 0.007                    # sizes, 1 cm on a man: about five points of a scanner on either side


@dataclass(frozen=True)
class GraphStage(Settings):
    """One stage of the coarse registration. Lengths are multiples of the template's size, √area.

    Attributes
    ----------
    nodes : int
        Nodes of the graph.
    stretch, growth : float
        Stiffness of the nodes: the distance to the data that costs as much as a strain of one, or as a growth by e
        between neighbours. With a growth of 0 nodes keep their size. A rotation by a radian costs a tenth of a strain.
    landmarks : float
        Weight of one landmark, as a share of the surface.
    reach : float
        Largest distance of a match; 0 ignores the scan.
    slide : float
        Pull of a match along the surface, as a share of that across it.
    rounds : int
        How often matches are found anew.
    detail : float
        Spacing to which scan and template are thinned for matching.
    positions : float
        Weight of positions in matching; 0 matches by path lengths alone.
    paths : float
        Distance that equals a factor of e between path lengths to the landmarks in matching.
    hints : float
        Weight of all given correspondences together, as a share of the surface.
    ends : int
        How many ends of the body (head, hands, feet) are tried in other rotations afterwards.
    """

    nodes: Count
    stretch: Positive
    growth: float
    landmarks: float
    reach: float
    slide: float = 0.02
    rounds: Count = 2
    detail: Cell = 0.02
    positions: float = 1.0
    paths: float = 0.0
    hints: float = 0.0
    ends: int = 0

    @property
    def bend(self) -> float:
        """Stiffness against a rotation of one radian between neighbours; rounded, so that 0.7 gives 0.07."""
        return round(0.1 * self.stretch, 9)


def stages(table: str) -> tuple[GraphStage, ...]:
    """Read stages from a table: a line of column names, then one line per stage with its reason after a bar.

    A dash stands for the default.

    Examples
    --------
    >>> stages("nodes stretch growth landmarks reach rounds | why\\n 80 0.1 0.7 0.01 0.08 - | arms")[0].rounds
    2
    """
    names, *rows = (line.partition("|")[0].split() for line in table.strip().splitlines())
    number: dict[str, Any] = {"nodes": int, "rounds": int, "ends": int}
    return tuple(GraphStage(**{name: number.get(name, float)(value)
                               for name, value in zip(names, row, strict=True) if value != "-"}) for row in rows)


# Path lengths alone first, which need no initial alignment; then stiffness and reach fall as matches become right.
USUAL = stages("""
nodes stretch growth landmarks reach slide rounds detail positions paths hints ends | why
150   0.7     2.0    0.1       1.0   1.0   4      -      0.0       0.3   1.0   -    | limbs bend to where paths match
150   0.5     2.0    0.1       0.3   0.3   5      -      0.3       0.3   1.0   -    | positions tell skins apart
150   0.3     0.7    0.05      0.2   0.1   4      -      -         0.2   0.5   -    | neighbours grow alike
150   0.2     0.7    0.01      0.15  0.05  5      -      -         0.1   0.2   -    | clicked landmarks have errors
150   0.13    0.7    0.01      0.11  0.0   4      -      -         0.05  0.1   -    | hints fade: some are wrong
300   0.09    0.7    0.01      0.08  0.0   4      -      -         -     -     -    | forearms and shins follow
300   0.06    0.7    0.01      0.06  0.0   4      -      -         -     -     -    | hands and feet follow
300   0.02    0.7    0.01      0.05  0.0   5      0.014  -         -     -     5    | try other rotations of ends
1000  0.02    0.35   0.01      0.037 -     -      0.008  -         -     -     -    | fingers, muscles
1000  0.015   0.35   0.005     0.028 -     -      0.008  -         -     -     -    | surface outweighs clicks
""")


@dataclass(frozen=True)
class RegistrationConfig(Settings):
    """Settings of `register`.

    Attributes
    ----------
    graph : stages of the deformation graph
    rolls : int
        How many other rolls are tried where limbs are anatomically impossible; 0 tries none.
    final_fit : bool
        The last pass: the surface follows the scan to its noise.
    noise_width : float
        Neighbourhood over which the last pass averages the scan's noise, as a multiple of the template's size.
    up : 'x', '-x', 'y', '-y', 'z' or '-z', optional
        The axis of the scan that points up, where it is known: people mostly stand, so a body model finds them better.

    Examples
    --------
    >>> RegistrationConfig.quick().final_fit
    False
    """

    graph: tuple[GraphStage, ...] = USUAL
    rolls: int = 3
    final_fit: bool = True
    noise_width: Positive = NOISE_WIDTH
    up: Annotated[Axis | None, FLAG] = None

    @property
    def near_stages(self) -> list[GraphStage]:
        """The stages that match by position alone; they need the template near the scan."""
        return [stage for stage in self.graph if stage.positions == 1 and not stage.paths and stage.reach]

    @classmethod
    def quick(cls) -> RegistrationConfig:
        """Return settings without the last steps: a third of the time, 7 mm from true landmarks instead of 6."""
        whole = cls()
        return replace(whole, graph=whole.graph[:-1], final_fit=False)

    @classmethod
    def from_paper(cls) -> RegistrationConfig:
        """The registration that [SCAPE] used: rigid links between neighbours, matches point to point [Hahnel].

        Nodes keep their size. The template is pulled to the landmarks first, then to the scan with ever softer links.
        Not from the paper, as it gives no values: how soft links are, and when. Not in the paper: inverted triangles
        are repaired, and commands press soles to a scan that ends flat around the feet.
        """
        # first landmarks with growing weight, then the scan with softening links; matches are found anew in each round
        return cls(stages("""
            nodes stretch growth landmarks reach slide rounds detail | why
            500   0.7     0      0.001     0     1     24     0.0001 | the whole body turns
            500   0.7     0      0.1       0     1     24     0.0001 | limbs swing
            500   0.7     0      10.0      0     1     24     0.0001 | landmarks are met
            500   0.2     0      0.01      0.4   1     6      0.0001 | the scan takes over, from afar
            500   0.1     0      0.01      0.2   1     6      0.0001 | limbs
            500   0.06    0      0.01      0.12  1     6      0.0001 | hands and feet
            500   0.04    0      0.01      0.08  1     6      0.0001 | shape, coarsely
            2000  0.04    0      0.005     0.04  1     6      0.0001 | the same, with more nodes
            2000  0.02    0      0.005     0.04  1     6      0.0001 | shape
            """), rolls=0, final_fit=False)
