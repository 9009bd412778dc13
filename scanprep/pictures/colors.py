"""Colours that stand for numbers: heat maps with their legend, and a palette for parts."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..geometry.format_common import as_seen

HEAT = "magma_r"      # light where values are low, so that a good result looks like a plain body
NO_VALUE = (0.72, 0.74, 0.76)      # grey, which the colour map does not contain


def heat(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Convert values to colours (..., 3) in [0, 1] of a perceptually uniform map of matplotlib; NaN becomes grey."""
    from matplotlib import colormaps

    values = np.asarray(values, dtype=float)
    place = np.clip((values - low) / max(high - low, 1e-30), 0, 1)
    # leave out the darkest end of the map, where shading would not show
    colors = colormaps[HEAT](np.nan_to_num(place) * 0.86)[..., :3]
    colors[np.isnan(values)] = NO_VALUE
    return colors


@dataclass(frozen=True, eq=False)
class Heat:
    """Values of vertices shown as colours between two limits; NaN is grey."""

    values: np.ndarray  # (N,) float
    low: float
    high: float
    title: str = ""  # what the values are
    unit: Literal["mm", "%"] = "mm"  # of the legend: mm for lengths in metres, % for shares

    def colors(self) -> np.ndarray:
        """Compute the colours (N, 3) in [0, 1]."""
        return heat(self.values, self.low, self.high)


def color_bar(low: float, high: float, title: str, scale: float = 1000.0, unit: str = "mm") -> np.ndarray:
    """Draw a legend (H, W, 3) uint8 for `heat`; the numbers on it are `scale` times `low` to `high`, in `unit`."""
    from PIL import Image, ImageDraw

    from .sheets import INK, font

    # pixels: as wide as a picture of a body; the pad leaves room for half a number at either end
    width, pad, top, thick = 320, 26, 26, 14
    image = Image.new("RGB", (width, top + thick + 26), "white")
    draw = ImageDraw.Draw(image)
    draw.text((width / 2, 4), title, fill=INK, anchor="ma", font=font(14))
    ramp = heat(np.linspace(low, high, width - 2 * pad), low, high)
    image.paste(Image.fromarray(np.repeat((255 * ramp[None] + 0.5).astype(np.uint8), thick, axis=0)), (pad, top))
    # five ticks with their values; the last one has the unit
    for place in np.linspace(0, 1, 5):
        x = pad + place * (width - 2 * pad - 1)
        draw.line((x, top + thick, x, top + thick + 3), fill=INK)
        value = f"{scale * (low + place * (high - low)):.3g}" + (f" {unit}" if place == 1 else "")
        draw.text((x, top + thick + 5), value, fill=INK, anchor="ma", font=font(13))
    return np.asarray(image)


def part_palette(count: int) -> np.ndarray:
    """Make colours (count, 3) in [0, 1]; consecutive numbers differ strongly in hue."""
    number = np.arange(count)
    # steps of the golden ratio never come close to an earlier hue; lightness and chroma vary too
    hue = 2 * np.pi * (0.07 + number * 0.61803398875)
    lightness = np.array([0.74, 0.64, 0.82])[number % 3]
    chroma = np.array([0.11, 0.13, 0.095])[number % 3]
    return _from_oklab(np.stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1))


def part_colors(part_of_face: np.ndarray) -> np.ndarray:
    """Return a distinct colour (F, 3) for each part number (F,); negative numbers are grey."""
    part_of_face = np.asarray(part_of_face)
    palette = part_palette(int(part_of_face.max(initial=0)) + 1)
    return np.where(part_of_face[:, None] < 0, np.array(NO_VALUE), palette[part_of_face])


def _from_oklab(lab: np.ndarray) -> np.ndarray:
    """Convert Björn Ottosson's Oklab coordinates (..., 3) to sRGB in [0, 1]."""
    # the inverse matrices of his definition of Oklab
    to_lms = np.array([[1, 0.3963377774, 0.2158037573], [1, -0.1055613458, -0.0638541728],
                       [1, -0.0894841775, -1.2914855480]])
    to_rgb = np.array([[4.0767416621, -3.3077115913, 0.2309699292], [-1.2684380046, 2.6097574011, -0.3413193965],
                       [-0.0041960863, -0.7034186147, 1.7076147010]])
    return as_seen((lab @ to_lms.T) ** 3 @ to_rgb.T)
