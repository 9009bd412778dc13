"""Packed scenes, and pages with scenes, read again: what a browser makes of them, written down a second time."""
import base64
import json
import re
import zlib

import numpy as np


class SceneReader:
    """A packed scene: its header, its columns, and the layers by name."""

    def __init__(self, packed):
        data = zlib.decompress(packed)
        length = int.from_bytes(data[:4], "little")
        self.header = json.loads(data[4:4 + length])
        self.columns = [self._column(data[4 + length:], c) for c in self.header["columns"]]
        self.origins = {id(layer): np.array(pane["origin"]) for pane in self.header["panes"]
                        for layer in pane["layers"]}

    @staticmethod
    def _column(data, described):
        kind, rows, width = np.dtype(described["type"]), described["rows"], described["width"]
        planes = np.frombuffer(data, np.uint8, kind.itemsize * rows * width, described["at"])
        values = planes.reshape(kind.itemsize, -1).T.copy().view(kind).reshape(rows, width)
        if not described["differences"]:
            return values
        modulus = 256**kind.itemsize
        wide = values.astype(np.int64)
        steps = np.where(wide % 2, -(wide + 1) // 2, wide // 2)
        return (np.cumsum(steps, axis=0) % modulus).astype(kind)

    @property
    def layers(self):
        return [layer for pane in self.header["panes"] for layer in pane["layers"]]

    def layer(self, name):
        return next(layer for layer in self.layers if layer["name"] == name)

    def positions(self, layer):
        """(n, 3), NaN where hidden."""
        place = layer["positions"]
        points = np.array(place["low"]) + place["step"] * self.columns[place["column"]].astype(float)
        points += self.origins[id(layer)]
        points[layer["hidden"]] = np.nan
        return points

    def faces(self, layer):
        return self.columns[layer["faces"]].astype(int)

    def frames(self, layer):
        """(T, n, 3), NaN where hidden."""
        motion = layer["motion"]
        rows = self.columns[motion["coefficients"]].view(np.int16).reshape(motion["frames"], motion["rank"], 3)
        rows = rows * np.array(motion["scale"])[:, None]
        if motion["basis"] is not None:
            rows = np.einsum("nr,trc->tnc", self.columns[motion["basis"]].astype(float), rows)
        rows += self.origins[id(layer)]
        if "seen" in motion:
            rows[self.columns[motion["seen"]] == 0] = np.nan
        return rows

    def colors(self, shade, count):
        """(n, 3) whole numbers to 255."""
        if "colors" in shade:
            return self.columns[shade["colors"]]
        palette = np.frombuffer(bytes.fromhex(shade["palette"]), np.uint8).reshape(-1, 3)
        return palette[self.columns[shade["index"]].ravel()] if "index" in shade else np.tile(palette, (count, 1))


def scenes_of(page):
    """The scenes that a page carries, one for each figure that turns."""
    found = re.findall(r'<script type="text/plain" id="(scene\d+)">([^<]*)</script>', page)
    assert [name for name, _ in found] == sorted(re.findall(r'data-scene="(scene\d+)"', page), key=lambda s: int(s[5:]))
    return [SceneReader(base64.b64decode(text)) for _, text in found]
