"""Arrange things side by side, or over each other in one pane."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import Camera
from scanprep.pictures.scene import Pane, match_camera_scales
from scanprep.pictures.shading import CLAY, Moving, Shape, Solid

from .contents import Content, Stance

# colours of things laid over each other: equally light, so that none dominates
LAID_OVER = (CLAY, (0.55, 0.66, 0.80), (0.83, 0.62, 0.55), (0.62, 0.75, 0.60), (0.72, 0.63, 0.78))


def arrange_side_by_side(contents: Sequence[Content], up: np.ndarray | None = None) -> tuple[list[Camera], list[Pane]]:
    """Make one pane per thing, all in one scale for comparison; a thing with a view of its own keeps it."""
    # things at the same place, such as a scan and its result, are seen from the same side
    stances = list[Stance]()
    for one in (content.stance for content in contents):
        first = next((other for other in stances if _same_place(one, other)), one)
        stances.append(replace(one, up=first.up, front=first.front))
    panes = [Pane(content.shapes, stance.camera(up), content.name)
             for content, stance in zip(contents, stances, strict=True)]
    free = [i for i, content in enumerate(contents) if content.stance.seen is None]
    sizes = [panes[i].camera.distance for i in free]
    if free and max(sizes) < 3 * min(sizes):           # more than a factor of 3: one of them is in another unit
        for i, pane in zip(free, match_camera_scales([panes[i] for i in free]), strict=True):
            panes[i] = pane
    return [pane.camera for pane in panes], panes


def _same_place(one: Stance, other: Stance) -> bool:
    """Return whether most of the smaller box is inside the larger one, and both face roughly the same way."""
    if one.seen or other.seen or one.up @ other.up < 0.9 or one.front @ other.front < 0.25:
        return False
    (low, high), (other_low, other_high) = one.extent, other.extent
    common = np.clip(np.minimum(high, other_high) - np.maximum(low, other_low), 0, None).prod()
    return bool(common > 0.8 * max(min((high - low).prod(), (other_high - other_low).prod()), np.finfo(float).tiny))


def over_each_other(contents: Sequence[Content], up: np.ndarray | None = None) -> tuple[list[Camera], list[Pane]]:
    """Make one pane for all things, each with its own colour, and with a name so that it can be hidden."""
    shapes = list[Shape | Moving]()
    for i, content in enumerate(contents):
        for k, shape in enumerate(content.shapes):
            inner = shape.shape if isinstance(shape, Moving) else Solid(shape) if isinstance(shape, Mesh) else shape
            shown: Any = replace(inner, name=f"{content.name}: {inner.name}" if k else content.name)
            if not k and isinstance(shown, Solid):
                shown = replace(shown, color=LAID_OVER[i % len(LAID_OVER)])
            shapes.append(replace(shape, shape=shown) if isinstance(shape, Moving) else shown)
    extent = np.concatenate([content.stance.extent for content in contents])
    camera = replace(contents[0].stance, extent=np.stack([extent.min(axis=0), extent.max(axis=0)])).camera(up)
    return [camera], [Pane(shapes, camera)]
