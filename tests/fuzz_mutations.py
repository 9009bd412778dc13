"""Ways in which a file may be damaged: bytes, numbers in text, JSON trees, arrays inside archives, chunks of GLB."""
from __future__ import annotations

import contextlib
import gzip
import io
import json
import re
import struct
import zipfile
from typing import Any

import numpy as np

WORDS = ("1e300", "-1", "nan", "inf", "-1e308", "0", "99999999999999999999", "2147483648", "4294967295", "1e-300",
         "0.5", "x", "", "1,5", "9" * 5000)
VALUES: tuple[Any, ...] = (None, True, [], {}, -1, 0, 1e300, 10**30, 2**31, "x", "", [[]], [1, 2, 3], {"a": 1}, 0.5,
                           float("nan"), float("inf"), [None], 10**18, "\ud800", [[[[[]]]]])
PATTERNS = (b"\xff" * 8, b"\x7f" * 8, b"\0" * 8, b"\x80\0\0\0\0\0\0\0", b"\0\0\xc0\x7f" * 2, b"\0\0\x80\x7f" * 2)


def mutated(data: bytes, name: str, rng: np.random.Generator) -> bytes:
    """The bytes of a file, damaged in one way of many, or in two."""
    for _ in range(rng.integers(1, 3)):
        ways = [_bytes, _bytes, _numbers]
        if name.endswith((".json", ".gltf")):
            ways += [_json, _json, _nested]
        elif name.endswith(".npz"):
            ways = [_bytes, _archive, _archive, _archive, _members]
        elif name.endswith(".npy"):
            ways = [_bytes, _npy_header]
        elif name.endswith(".glb"):
            ways = [_bytes, _glb, _glb, _glb]
        elif name.endswith(".gz"):
            ways = [_bytes, _packed, _packed]
        with contextlib.suppress(Exception):         # where the first damage bars the second
            data = _pick(rng, ways)(data, rng)
    return data


def _pick(rng: np.random.Generator, values: Any) -> Any:
    return values[rng.integers(len(values))]


def _bytes(data: bytes, rng: np.random.Generator) -> bytes:
    out, n = bytearray(data), max(len(data), 1)
    at = int(n * rng.random() ** (3 if rng.random() < 0.5 else 1))          # headers are hit more often
    size = int(min(n - at, 2 ** (rng.random() * np.log2(n + 1))))
    way = rng.integers(7)
    if way == 0:
        for place in rng.integers(0, n, rng.integers(1, 9)):
            if place < len(out):
                out[place] ^= 1 << rng.integers(8)
    elif way == 1:
        del out[at:]
    elif way == 2:
        out[at:at] = rng.bytes(size)
    elif way == 3:
        del out[at:at + size]
    elif way == 4:
        out[at:at] = out[at:at + size] * int(rng.integers(1, 4))
    elif way == 5:
        pattern = _pick(rng, PATTERNS)[:_pick(rng, (1, 2, 4, 8))]
        out[at:at + len(pattern)] = pattern
    else:
        out[at:at + size] = bytes(size)
    return bytes(out)


def _numbers(data: bytes, rng: np.random.Generator) -> bytes:
    found = list(re.finditer(rb"[-+]?\d+(\.\d*)?([eE][-+]?\d+)?", data[:200_000]))
    if not found:
        return data
    hit = found[int(len(found) * rng.random() ** 2)]
    return data[:hit.start()] + _pick(rng, WORDS).encode() + data[hit.end():]


def _packed(data: bytes, rng: np.random.Generator) -> bytes:
    inner = gzip.decompress(data)
    if rng.random() < 0.1:
        inner += bytes(10**7)
    return gzip.compress(_pick(rng, (_bytes, _numbers))(inner, rng), 1, mtime=0)


def _json(data: bytes, rng: np.random.Generator) -> bytes:
    tree = json.loads(data)
    for _ in range(rng.integers(1, 3)):
        tree = _changed(tree, rng)
    return json.dumps(tree).encode()


def _nested(data: bytes, rng: np.random.Generator) -> bytes:
    deep = b"[" * 10**5 + b"]" * 10**5 if rng.random() < 0.5 else b'{"a":' * 2000 + b"1" + b"}" * 2000
    return data.replace(_pick(rng, (b"1", b"2", b"0")), deep, 1)


def _changed(tree: Any, rng: np.random.Generator) -> Any:
    """A tree in which one entry is another one, gone, or there twice."""
    if isinstance(tree, dict | list) and tree and rng.random() < 0.9:
        key = _pick(rng, list(tree) if isinstance(tree, dict) else range(len(tree)))
        way = rng.random()
        if way < 0.7:
            tree[key] = _changed(tree[key], rng)
        elif way < 0.8:
            del tree[key]
        elif isinstance(tree, dict):
            tree[str(_pick(rng, VALUES))] = tree.pop(key) if way < 0.9 else tree[key]
        else:
            tree.insert(key, tree[key])
        return tree
    if isinstance(tree, int | float) and rng.random() < 0.3:
        return tree + _pick(rng, (1, -1, 0.5, 1e9))
    return _pick(rng, VALUES)


def _glb(data: bytes, rng: np.random.Generator) -> bytes:
    (size,) = struct.unpack_from("<I", data, 12)
    text, rest = data[20:20 + size], data[20 + size:]
    text = _pick(rng, (_json, _json, _numbers))(text.rstrip(b" "), rng)
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + rest
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def _archive(data: bytes, rng: np.random.Generator) -> bytes:
    """An archive in which one array is another one; the header is an array too."""
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    name = "header" if "header" in arrays and rng.random() < 0.2 else _pick(rng, list(arrays))
    if name == "header":
        arrays[name] = np.array(_json(str(arrays[name]).encode(), rng).decode())
    elif rng.random() < 0.1:
        del arrays[name]
    else:
        arrays[name] = _array(arrays[name], rng)
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)                # objects among them are pickled, as in a hostile file
    return out.getvalue()


def _array(a: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    way = rng.integers(9)
    if way == 0:
        return _pick(rng, (a.T, a[None], a.ravel(), a[..., None], a[:0] if a.ndim else a))
    if way == 1 and a.ndim and len(a):
        return _pick(rng, (a[:-1], a[1:], np.concatenate([a, a[:1]])))
    if way == 2:
        return np.zeros(_pick(rng, ((), (0,), (3,), (2, 3), (10**6,), (1000, 1000, 3), (0, 5, 3))))
    if way == 3:
        return a.astype(_pick(rng, (object, "U8", "S4", "i1", "u8", "f2", "f8", "c8", bool)))
    if way == 4:
        return np.array(_pick(rng, ("text", None, {"a": 1}, b"\0", 10**30, np.datetime64("2020"))))
    if way == 5 and a.size:
        return np.asfortranarray(rng.permutation(a.ravel()).reshape(a.shape))
    out = a.copy()
    if a.size and a.dtype.kind in "biuf":
        with np.errstate(all="ignore"):
            out.ravel()[rng.integers(a.size)] = np.array(_pick(rng, (
                np.nan, np.inf, -1, 1e300, 1e30, 1e9, 2**31, 0, len(a) if a.ndim else 1))).astype(a.dtype)
            return out if rng.random() < 0.8 else out * a.dtype.type(1)
    return out


def _members(data: bytes, rng: np.random.Generator) -> bytes:
    """An archive with the bytes of one member changed, its checksum right."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        infos = old.infolist()
        hit = rng.integers(len(infos))
        for i, info in enumerate(infos):
            content = old.read(info)
            new.writestr(info.filename, _npy_header(content, rng) if i == hit else content)
    return out.getvalue()


def _npy_header(data: bytes, rng: np.random.Generator) -> bytes:
    """Another shape or type in the text before an array."""
    start, end = 10, 10 + struct.unpack_from("<H", data, 8)[0]
    text = data[start:end]
    if rng.random() < 0.3:
        text = re.sub(rb"'descr': '[^']*'", b"'descr': '" + _pick(rng, (
            b"|O", b"<U99999999", b"<f8", b"|V0", b"<U0", b"|S0", b">i4", b"(9999999,)f8")) + b"'", text)
    elif rng.random() < 0.3:
        text = _pick(rng, (b"(" * 500, b"-" * 9000, b"{'a':", b"\xff", b"1" * 5000)) + text
    else:
        text = _numbers(text, rng)
    return data[:8] + struct.pack("<H", min(len(text), 65535)) + text + data[end:]
