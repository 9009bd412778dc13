"""Contact sheets of pictures, and picture files."""
from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..geometry.images import open_image
from ..geometry.storage import write_file
from ..words import printable

INK = (58, 62, 68)                   # colour of text: dark grey, softer than black


def font(size: int):
    """Return the typeface that Pillow contains, so that labels look the same on every machine."""
    from PIL import ImageFont

    return ImageFont.load_default(size=size)


def contact_sheet(images: Sequence[np.ndarray], labels: Sequence[str] | None = None, columns: int | None = None
                  ) -> np.ndarray:
    """Put pictures of any size side by side, each centred in its cell with a line of text below.

    Parameters
    ----------
    images : sequence of (h, w, 3) uint8
        The pictures.
    labels : sequence of str, optional
        One for each picture.
    columns : int, optional
        Pictures in a row; by default all.

    Returns
    -------
    (H, W, 3) uint8
    """
    from PIL import Image, ImageDraw

    if not len(images):
        raise ValueError("images: expected at least one, got none")
    if labels is not None and len(labels) != len(images):
        raise ValueError(f"labels: expected {len(images)}, one for each image, got {len(labels)}")
    gap = 8  # pixels between cells
    columns, labels = min(columns or len(images), len(images)), [printable(label) for label in labels or ()]
    # the widest picture or label sets the width of all cells, the highest picture of a row its height
    rows = -(-len(images) // columns)
    text = 24 if labels else 0
    cell_w = max([*(i.shape[1] for i in images), *(int(font(15).getlength(label)) + 2 * gap for label in labels)])
    heights = [max(len(i) for i in images[r * columns:(r + 1) * columns]) for r in range(rows)]
    tops = np.concatenate([[0], np.cumsum([h + text + gap for h in heights])])
    sheet = Image.new("RGB", (columns * (cell_w + gap) - gap, int(tops[-1]) - gap), "white")
    draw = ImageDraw.Draw(sheet)
    for number, image in enumerate(images):
        x, y, cell_h = (number % columns) * (cell_w + gap), int(tops[number // columns]), heights[number // columns]
        h, w = image.shape[:2]
        sheet.paste(Image.fromarray(image), (x + (cell_w - w) // 2, y + (cell_h - h) // 2))
        if labels:
            draw.text((x + cell_w / 2, y + cell_h + 4), labels[number], fill=INK, anchor="ma", font=font(15))
    return np.asarray(sheet)


def png_bytes(image: np.ndarray) -> bytes:
    """Encode a picture (H, W, 3) uint8, or grey (H, W) uint8 or uint16, as PNG."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(image).save(out, format="PNG", optimize=image.size < 4_000_000)      # too slow for larger
    return out.getvalue()


def webp_bytes(image: np.ndarray) -> bytes:
    """Encode a picture (H, W, 3) uint8 as WebP, a tenth of the size of a PNG."""
    from PIL import Image

    out = io.BytesIO()
    # quality at which compression does not show on shaded bodies
    Image.fromarray(image).save(out, format="WEBP", quality=82, method=4)
    return out.getvalue()


def small_picture(path: Path) -> bytes:
    """Read a picture from a file and encode it as WebP, no wider than a page of many results shows it."""
    width = 700  # pixels
    with open_image(path, "a picture") as image:
        image.thumbnail((width, width))
        return webp_bytes(np.asarray(image.convert("RGB")))


def save_png(path: str | Path, image: np.ndarray) -> None:
    """Write a picture (H, W, 3) uint8, completely or not at all."""
    write_file(path, png_bytes(image))
