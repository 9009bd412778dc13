"""Read PNG images with 16 bits per channel: Pillow keeps only the upper eight bits of coloured ones."""
from __future__ import annotations

import struct
import zlib

import numpy as np

from ..geometry.images import check_pixels

SIGNATURE = b"\x89PNG\r\n\x1a\n"
CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}  # colour type of the PNG standard -> channels; a palette (3) has none


def depth(data: bytes) -> tuple[int, int]:
    """Return bits and channels of a PNG file; channels are 0 where it has a palette."""
    if data[:8] != SIGNATURE or data[12:16] != b"IHDR" or len(data) < 33:
        raise ValueError("it is not a PNG file")
    return data[24], CHANNELS.get(data[25], 0)


def decode_png16(data: bytes) -> np.ndarray:
    """Decode a PNG file with 16 bits per channel to (H, W, C) uint16."""
    bits, channels = depth(data)
    width, height = struct.unpack(">II", data[16:24])
    if bits != 16 or not channels or data[28]:
        raise ValueError("expected 16 bits a channel, not interlaced")
    if not width * height:
        raise ValueError(f"expected pixels, got {width} x {height}")
    check_pixels((width, height))
    # each row is one byte for its filter, then two bytes per channel, high byte first
    row = 1 + 2 * channels * width
    try:
        raw = zlib.decompressobj().decompress(b"".join(_chunks(data, b"IDAT")), row * height + 1)
    except zlib.error as error:
        raise ValueError(f"its pixels cannot be unpacked ({error})") from None
    if len(raw) < row * height:
        raise ValueError("it is cut short")
    lines = np.frombuffer(raw, np.uint8, row * height).reshape(height, row)
    pixels = _unfilter(lines[:, 1:].reshape(height, width, 2 * channels), lines[:, 0])
    return pixels.reshape(height, width, channels, 2) @ np.array([256, 1], dtype=np.uint16)


def _chunks(data: bytes, wanted: bytes) -> list[bytes]:
    """Return the contents of all chunks of a kind."""
    contents, at = [], 8
    while at + 8 <= len(data):
        length = int.from_bytes(data[at:at + 4], "big")
        if data[at + 4:at + 8] == wanted:
            contents.append(data[at + 8:at + 8 + length])
        at += 12 + length
    return contents


def _unfilter(stored: np.ndarray, kinds: np.ndarray) -> np.ndarray:
    """Undo the row filters of PNG: bytes (H, W, B) from their differences to those left, above and above left.

    A pixel depends only on pixels of earlier diagonals, so a whole diagonal is computed at once.
    """
    if (kinds > 4).any():
        raise ValueError(f"unknown filter {kinds.max()}")
    height, width, _ = stored.shape
    out = np.zeros((height + 1, width + 1, stored.shape[2]), dtype=np.int16)
    for diagonal in range(height + width - 1):
        y = np.arange(max(0, diagonal - width + 1), min(height, diagonal + 1))
        x = diagonal - y
        a, b, c = out[y + 1, x], out[y, x + 1], out[y, x]
        # Paeth predictor: the neighbour nearest to a + b - c
        p, q, r = np.abs(b - c), np.abs(a - c), np.abs(a + b - 2 * c)
        paeth = np.where((p <= q) & (p <= r), a, np.where(q <= r, b, c))
        kind = kinds[y, None]
        prediction = np.choose(kind, [np.zeros_like(a), a, b, (a + b) // 2, paeth])
        out[y + 1, x + 1] = (stored[y, x] + prediction) & 255
    return out[1:, 1:].astype(np.uint16)
