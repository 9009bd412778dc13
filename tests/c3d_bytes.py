"""A C3D writer of the tests, each field of which can be set to what programs write there wrongly."""
import struct

import numpy as np

BLOCK = 512


def c3d_bytes(places, labels, rate=100.0, unit="mm", scale=-1.0, analog=None, more=(), header=None):
    """A file of places (T, L, 3) in its own unit, NaN where missing.

    `scale` above 0 makes whole numbers, `analog` is (T * samples, C), `more` further (group, name, value).
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
    records = []
    for number, (group, parameters) in enumerate(groups.items(), start=1):
        records.append((bytes([len(group)]) + struct.pack("b", -number) + group.encode(), b"\0"))
        records += [(bytes([len(name), number]) + name.encode(), _values(value) + b"\0")
                    for name, value in parameters.items()]
    section = b"".join(head + struct.pack("<H", len(tail) + 2 if i < len(records) - 1 else header.get("link", 0)) + tail
                       for i, (head, tail) in enumerate(records))
    blocks = -(-(len(section) + 4) // BLOCK)
    section = (bytes([1, 80, blocks, 84]) + section).ljust(BLOCK * blocks, b"\0")
    head = struct.pack("<BBHHHHHfHHf", 2, 80, L, header.get("analog", C * samples), 1, header.get("last", T), 10, scale,
                       2 + blocks, samples, header.get("rate", rate)).ljust(BLOCK, b"\0")
    missing = np.isnan(places).any(axis=2)
    values = np.zeros((T, L, 4))
    values[..., :3] = np.where(missing[..., None], 0, places / (1 if scale < 0 else scale))
    values[..., 3] = np.where(missing, -1, 0)
    more_values = np.zeros((T, 0)) if analog is None else analog.reshape(T, -1)
    rows = np.concatenate([values.reshape(T, -1), more_values], axis=1)
    body = rows.astype("<f4").tobytes() if scale < 0 else np.rint(rows).astype("<i2").tobytes()
    return head + section + body + bytes(-len(body) % BLOCK)


def _values(value):
    """Kind, dimensions and values of a parameter."""
    if isinstance(value, list):
        width = max(map(len, value), default=0) or 1
        return bytes([255, 2, width, len(value)]) + b"".join(text.encode().ljust(width) for text in value)
    if isinstance(value, float):
        return b"\x04\x00" + struct.pack("<f", value)
    return b"\x02\x00" + struct.pack("<H", value)
