"""Open image files of other programs, with a limit on their pixels and the file's name in every error."""
from __future__ import annotations

import contextlib
import io
import math
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from . import storage
from .budget import spend

if TYPE_CHECKING:
    from PIL import Image

LARGEST = 8192                       # pixels a side of the largest textures that scanners write: 1.6 GB of memory


def check_pixels(size: Sequence[int], side: int = LARGEST) -> None:
    """Raise ValueError for an image of more pixels than a square of `side`: a small file may unpack to one."""
    if math.prod(size) > side**2:
        raise ValueError(f"{' x '.join(map(str, size))} pixels, expected at most {side} x {side}")
    spend(memory=8 * math.prod(size))        # a picture of 4096 x 4096 of one colour is within the budget of any mesh


@contextlib.contextmanager
def open_image(path: str | Path, what: str, data: bytes | None = None, side: int = LARGEST
               ) -> Iterator[Image.Image]:
    """Yield an image whose header is read and whose pixels are not yet; StorageError with its name for any problem.

    `data` is what the file holds, where it is read already. The pixels must be decoded inside the block.
    """
    from PIL import Image, UnidentifiedImageError

    data = storage.read_bytes(path, what) if data is None else data
    # Pillow counts pixels too, with another limit; the smaller one holds for both
    with storage.taking_apart(path, what), warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        try:
            image = Image.open(io.BytesIO(data))
        except UnidentifiedImageError:
            raise ValueError("it is no image") from None
        with image:
            check_pixels(image.size, side)
            yield image
