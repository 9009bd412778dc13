"""Where tapes run on a template, carried by its vertices."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from scanprep.geometry.mesh import Mesh

from .section import Carried, SectionCurve


@dataclass(frozen=True, eq=False)
class Girth:
    """A tape around a part, in the plane through `centre`: level where there is no axis, else across the axis.

    `faces` (F', 3) are the triangles near it on the template, without arms or the other leg. With `under_arms`, the
    tape runs straight on where they end at the arms. Where the plane meets the trunk or the other leg, it moves along
    its normal (`aside` 1) or against it (-1); 0 if it stays. A plane with a `level` is as high as that point. With
    `between`, the tape is the longest of level ones between two points.
    """

    centre: Carried
    axis: tuple[Carried, Carried] | None
    faces: np.ndarray
    ring: SectionCurve                          # on the template
    under_arms: bool = False
    aside: int = 0
    level: Carried | None = None
    between: tuple[Carried, Carried] | None = None

    @property
    def height(self) -> Carried:
        """The point that the plane goes through."""
        return self.centre if self.level is None else self.level


@dataclass(frozen=True, eq=False)
class Span:
    """A breadth of the section of a girth along one of the body's `axes` (0 up, 1 left, 2 ahead)."""

    girth: str
    axis: int


@dataclass(frozen=True, eq=False)
class Leg:
    """One leg: the joint of the hip, the centres of knee and shin, and the sole.

    `sole` are vertices that are on average `arch`, metres, above the floor that the foot stands on: a foot that is
    turned a little keeps their mean, but not its lowest vertex. The way over the centres is longer than the leg by a
    bow, as knees are further ahead: `straight` is its share that a straight leg has. `share` is the height of the hip
    above the ankle, over that of the first centre above the last.
    """

    centres: tuple[Carried, Carried, Carried]
    sole: np.ndarray
    arch: float
    straight: float
    share: float


@dataclass(frozen=True, eq=False)
class Height:
    """Height above the floor of a carried point, or of the highest vertex, as if the legs were straight and upright."""

    top: Carried | None


@dataclass(frozen=True, eq=False)
class Straight:
    """The straight distance between two carried points."""

    first: Carried
    second: Carried


@dataclass(frozen=True, eq=False)
class Extent:
    """The extent of some vertices (k,) along the level direction from one carried point to another."""

    vertices: np.ndarray
    first: Carried
    second: Carried


@dataclass(frozen=True, eq=False)
class Way:
    """Shortest paths along the surface from vertex to vertex, one after the other, and the triangles for each.

    With `until`, the last path is extended or cut to the plane of a girth, since a vertex of the template's section may
    be 2 cm from the section of another body.
    """

    vertices: tuple[int, ...]
    faces: tuple[np.ndarray, ...]
    until: str | None = None


@dataclass(frozen=True, eq=False)
class Weight:
    """The weight of a person, from the volume of a closed surface."""


Found = Girth | Span | Height | Straight | Extent | Way | Weight


@dataclass(frozen=True, eq=False)
class Tapes:
    """All measurements of a template: `found` by name, `missing` with the reason; `axes` (3, 3) up, left, ahead.

    `limbs` are directions that tell the pose. Without `legs`, the floor is at the lowest vertex.
    """

    template: Mesh
    axes: np.ndarray
    found: Mapping[str, Found]
    missing: Mapping[str, str] = field(default_factory=dict)
    limbs: Mapping[str, tuple[Carried, Carried]] = field(default_factory=dict)
    legs: tuple[Leg, ...] = ()
