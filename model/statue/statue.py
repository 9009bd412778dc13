"""A statue: a fitted control model with the displacement map of one scan."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .control.model import ControlModel

OUTSIDE, HOLE, FOLDED, MEASURED = 0, 85, 170, 255      # grey values of the coverage image


@dataclass(frozen=True, eq=False)
class DisplacementMap:
    """Images over the chart of a control model; rows from the top.

    Attributes
    ----------
    heights : (H, W) float32, metres
        Along the interpolated normal of the control mesh. Filled smoothly in holes and folds, continued outside.
    coverage : (H, W) uint8
        MEASURED; FOLDED where the surface is not one-to-one with the control mesh; HOLE where there are no data;
        OUTSIDE the chart.
    vectors : (H, W, 3) float32, metres, optional
        To be added to the heights along the normals, in the axes of the world as the scan stands: zero where the
        surface is one-to-one with the control mesh, and in folds what no height can say.
    """

    heights: np.ndarray
    coverage: np.ndarray
    vectors: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Statue:
    """One person as control model, displacement map and texture.

    Attributes
    ----------
    control : ControlModel
        Fitted: its default pose is that of the scan.
    pose : (J, 3) float, radians
        How the generic model's parts were turned from its default pose to that of the scan.
    map : DisplacementMap
    texture : (H, W, 3) uint8, optional
        Colours over the same chart.
    """

    control: ControlModel
    pose: np.ndarray
    map: DisplacementMap
    texture: np.ndarray | None = None
