"""Click joint centres inside a body in the browser: `scape pick --joints`.

A click is a ray through the body. The middle of where it is inside is proposed as the joint. The ray that is mirrored
at the body's symmetry proposes the joint of the other side, which a click accepts.
"""
from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from ..geometry.mesh import Mesh
from ..geometry.sides import other_side, side_of, split_side
from ..skeleton.symmetry import MirrorPlane, find_symmetry
from .app import Send
from .clicked import Clicked
from .landmark_names import AIMS
from .pick import TEMPLATE, PickApp, as_direction, as_point
from .surface_clicks import Clickable


def mirror_click(body: Clickable, plane: MirrorPlane, origin: np.ndarray, direction: np.ndarray, inside: bool
                 ) -> np.ndarray | None:
    """Find what a click (3,), (3,) means on the other side: in the middle of the body or on it; None beside it.

    The ray is mirrored, not the place, so that the other side's own thickness counts.
    """
    mirrored = plane.reflect(origin), plane.matrix @ direction
    return body.middle(*mirrored) if inside else body.hit(*mirrored)


class JointApp(PickApp):
    """`scape pick --joints`: one body that is seen through, names of joints in it and of points on it."""

    title = "Joints"

    def __init__(self, body: Clicked, names: Sequence[str], on_surface: Collection[str]) -> None:
        if not body.body.has_surface:
            raise ValueError(f"{body.path}: expected triangles, got points; a point cloud has no inside for joints")
        super().__init__(body, (), names)
        self.on_surface = frozenset(on_surface)

    @cached_property
    def _symmetry(self) -> MirrorPlane:
        """The plane of the body's symmetry, found on what is drawn."""
        solid = self.template.shown
        mesh = getattr(solid, "mesh", None)
        assert isinstance(mesh, Mesh), "checked at the start"
        return find_symmetry(mesh)

    def mirror_plane(self) -> MirrorPlane:
        """Find the plane between left and right: from two pairs of clicks on, else that of the body's symmetry."""
        places = self.template.places
        left = [name for name in places if side_of(name) > 0 and other_side(name) in places]
        if len(left) < 2:
            return self._symmetry
        of_left = np.array([places[name] for name in left])
        of_right = np.array([places[str(other_side(name))] for name in left])
        return MirrorPlane.between(np.vstack([of_left, of_right]), np.vstack([of_right, of_left]))

    def more(self) -> dict[str, Any]:
        """Return the depth of the last click, and what to aim at next."""
        name = self.chosen or ""
        plain, side = split_side(name)
        where = "on the surface" if name in self.on_surface else AIMS.get(plain, f"middle of the {plain}")
        whose = f", {side} as the body itself has it" if side else ""
        return {"joints": True, "depth": self.depth, "hint": f"Click “{name}”: {where}{whose}." if name else ""}

    def on_place(self, send: Send, pane: int, name: str, origin: list[float], direction: list[float],
                 inside: bool = False, seen: list[float] | None = None, drag: int = 0) -> None:
        """Place a joint half way through the body or a point on it, and propose that of the other side."""
        body, joint = self.template, name not in self.on_surface
        ray = as_point(origin), as_direction(direction)
        stretch = body.body.interval(*ray) if joint else None
        if joint and stretch is None:
            self.note = "the click meets no body with a front and a back: turn it, or click beside the place"
            return
        super().on_place(send, TEMPLATE, name, origin, direction, joint, seen, drag)
        if stretch is not None:
            self.depth = {"name": name, "ends": stretch.tolist()}
        other = other_side(name)
        if other is None or other in body.places:
            return
        body.predicted.pop(other, None)
        mirrored = mirror_click(body.body, self.mirror_plane(), *ray, joint)
        if mirrored is not None:
            body.predicted[other] = mirrored
            self.note = f"“{other}” is proposed where the mirror has it: click its blue ball, or another place"
