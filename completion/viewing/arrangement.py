"""Contents beside each other or in one place."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import Camera
from scanprep.pictures.scene import Pane, framed_alike
from scanprep.pictures.shading import CLAY, Moving, Shape, Solid

from .contents import Content, Stance

SAME = 0.8                           # of the smaller one of two things in the other: they are at one place
ALIKE = 3.0                          # things whose sizes differ less are shown in one scale
LAID_OVER = (CLAY, (0.55, 0.66, 0.80), (0.83, 0.62, 0.55), (0.62, 0.75, 0.60), (0.72, 0.63, 0.78))


def side_by_side(contents: Sequence[Content], up: np.ndarray | None = None) -> tuple[list[Camera], list[Pane]]:
    """A pane for each, in one scale, so that they can be compared; what has a view of its own keeps it."""
    panes = [Pane(content.shapes, stance.camera(up), content.name)
             for content, stance in zip(contents, _seen_alike([content.stance for content in contents]), strict=True)]
    free = [i for i, content in enumerate(contents) if content.stance.seen is None]
    sizes = [panes[i].camera.distance for i in free]
    if free and max(sizes) < ALIKE * min(sizes):       # else one of them is in another unit
        for i, pane in zip(free, framed_alike([panes[i] for i in free]), strict=True):
            panes[i] = pane
    return [pane.camera for pane in panes], panes


def _seen_alike(stances: Sequence[Stance]) -> list[Stance]:
    """Things at one place, such as a scan and what was made of it, are seen from the side of the first of them."""
    out: list[Stance] = []
    for one in stances:
        first = next((other for other in out if _same_place(one, other)), one)
        out.append(replace(one, up=first.up, front=first.front))
    return out


def _same_place(one: Stance, other: Stance) -> bool:
    """Whether most of the smaller box is in the larger one, and both face roughly the same way."""
    if one.seen or other.seen or one.up @ other.up < 0.9 or one.front @ other.front < 0.25:
        return False
    (low, high), (least, most) = one.extent, other.extent
    common = np.clip(np.minimum(high, most) - np.maximum(low, least), 0, None).prod()
    return bool(common > SAME * max(min((high - low).prod(), (most - least).prod()), np.finfo(float).tiny))


def over_each_other(contents: Sequence[Content], up: np.ndarray | None = None) -> tuple[list[Camera], list[Pane]]:
    """One pane for all, each in its own colour and with its name, so that it can be hidden."""
    shapes = [_renamed(shape, content, k, LAID_OVER[i % len(LAID_OVER)])
              for i, content in enumerate(contents) for k, shape in enumerate(content.shapes)]
    extent = np.concatenate([content.stance.extent for content in contents])
    camera = replace(contents[0].stance, extent=np.stack([extent.min(axis=0), extent.max(axis=0)])).camera(up)
    return [camera], [Pane(shapes, camera)]


def _renamed(shape: Shape | Moving, content: Content, number: int, color: tuple[float, float, float]
             ) -> Shape | Moving:
    """A shape of a content with its name, the first of them in its colour."""
    if isinstance(shape, Moving):
        inner = _renamed(shape.shape, content, number, color)
        assert not isinstance(inner, Moving)
        return replace(shape, shape=inner)                                         # type: ignore[arg-type]
    shape = Solid(shape) if isinstance(shape, Mesh) else shape
    name = f"{content.name}: {shape.name}" if number else content.name
    return replace(shape, name=name, color=color) if isinstance(shape, Solid) and not number else replace(
        shape, name=name)
