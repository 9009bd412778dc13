"""A C3D writer of the tests, each field of which can be set to what programs write there wrongly."""
import struct

import numpy as np

from completion.mocap.files.c3d import _Numbers

BLOCK = 512


def c3d_bytes(places, labels, rate=100.0, unit="mm", scale=-1.0, analog=None, more=(), header=None, processor=84):
    """A file of places (T, L, 3) in its own unit, NaN where missing.

    `scale` above 0 makes whole numbers, `analog` is (T * samples, C), `more` further (group, name, value), where
    a value may be an array of numbers, and `processor` 84 to 86.
    `header` are fields that differ: analog, last, rate, and link, that of the last parameter.
    """
    T, L = places.shape[:2]
    header = header or {}
    C = 0 if analog is None else analog.shape[1]
    samples = 0 if analog is None else len(analog) // T
    groups = {"POINT": {"USED": L, "SCALE": float(scale), "DATA_START": 0, "RATE": float(rate), "UNITS": [unit],
                        "LABELS": list(labels)}, "ANALOG": {"USED": C, "RATE": float(rate * samples)}}
    for group, name, value in more:
        groups.setdefault(group, {})[name] = value
    records, numbers = [], _Numbers(processor)
    for number, (group, parameters) in enumerate(groups.items(), start=1):
        records.append((bytes([len(group)]) + struct.pack("b", -number) + group.encode(), b"\0"))
        records += [(bytes([len(name), number]) + name.encode(), _values(value, numbers) + b"\0")
                    for name, value in parameters.items()]
    links = [*(len(tail) + 2 for _, tail in records[:-1]), header.get("link", 0)]
    section = b"".join(head + struct.pack(numbers.order + "H", link) + tail
                       for (head, tail), link in zip(records, links, strict=True))
    blocks = -(-(len(section) + 4) // BLOCK)
    section = (bytes([1, 80, blocks, processor]) + section).ljust(BLOCK * blocks, b"\0")
    words = struct.pack(numbers.order + "BBHHHHH", 2, 80, L, header.get("analog", C * samples), 1,
                        header.get("last", T), 10)
    head = (words + numbers.encode(np.array(scale), "f4") + struct.pack(numbers.order + "HH", 2 + blocks, samples)
            + numbers.encode(np.array(header.get("rate", rate)), "f4")).ljust(BLOCK, b"\0")
    missing = np.isnan(places).any(axis=2)
    values = np.zeros((T, L, 4))
    values[..., :3] = np.where(missing[..., None], 0, places / (1 if scale < 0 else scale))
    values[..., 3] = np.where(missing, -1, 0)
    more_values = np.zeros((T, 0)) if analog is None else analog.reshape(T, -1)
    rows = np.concatenate([values.reshape(T, -1), more_values], axis=1)
    body = numbers.encode(rows, "f4") if scale < 0 else numbers.encode(np.rint(rows), "i2")
    return head + section + body + bytes(-len(body) % BLOCK)


def _values(value, numbers):
    """Kind, dimensions and values of a parameter."""
    if isinstance(value, list):
        width = max(map(len, value), default=0) or 1
        return bytes([255, 2, width, len(value)]) + b"".join(text.encode().ljust(width) for text in value)
    if isinstance(value, np.ndarray):
        real = value.dtype.kind == "f"
        return bytes([4 if real else 2, value.ndim, *value.shape[::-1]]) + numbers.encode(value, "f4" if real else "i2")
    if isinstance(value, float):
        return b"\x04\x00" + numbers.encode(np.array(value), "f4")
    return b"\x02\x00" + struct.pack(numbers.order + "H", value)
