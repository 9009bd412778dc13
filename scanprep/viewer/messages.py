"""One message between Python and the page: a kind, fields in JSON, and bytes behind them.

    0  4 bytes   length n of the header, unsigned, little-endian
    4  n bytes   header: JSON in UTF-8 with `kind`, `latest`, `number`, `fields`; blanks up to a multiple of 8
    4 + n        data, so that arrays of any type can be read where they lie
"""
from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ..geometry import storage

LENGTH = struct.Struct("<I")
KEYS = {"kind": str, "latest": str, "number": int, "fields": dict}


@dataclass(frozen=True)
class Message:
    """What one side tells the other.

    Parameters
    ----------
    kind : str
        What it is about, such as "pose".
    fields : Mapping
        What JSON can hold; arrays become lists, numbers that are not finite null.
    data : bytes
        Anything else, such as packed geometry.
    latest : str
        A newer message with this key takes the place of one that still waits, unless one without a key came between.
    number : int
        Where it stands among all messages of its tab; set by the connection of the tab, 0 for no number.
    """

    kind: str
    fields: Mapping[str, Any] = field(default_factory=dict)
    data: bytes = b""
    latest: str = ""
    number: int = 0

    def pack(self) -> bytes:
        """The message as one binary frame; TypeError for fields that JSON cannot hold."""
        header = {"kind": self.kind, "latest": self.latest, "number": self.number,
                  "fields": storage.as_json(dict(self.fields))}
        text = json.dumps(header, allow_nan=False, separators=(",", ":")).encode("utf-8")
        # bytes: data begin at a multiple of this
        text += b" " * (-(len(text) + LENGTH.size) % 8)
        return LENGTH.pack(len(text)) + text + self.data

    @classmethod
    def unpack(cls, raw: bytes | str) -> Message:
        """The message of a frame; ValueError with what was expected for anything else."""
        if isinstance(raw, str):
            raise ValueError(f"message: expected a binary frame, got text of {len(raw)} characters")
        if len(raw) < LENGTH.size:
            raise ValueError(f"message: expected at least {LENGTH.size} bytes, got {len(raw)}")
        end = LENGTH.size + LENGTH.unpack_from(raw)[0]
        if end > len(raw):
            raise ValueError(f"message: expected a header of {end - LENGTH.size} bytes, got {len(raw) - LENGTH.size}")
        header = storage.parse_json("message", bytes(raw[LENGTH.size:end]), "a header")
        _check(header)
        return cls(data=bytes(raw[end:]), **header)


def _check(header: Any) -> None:
    """ValueError where a header has not the keys of a message, each of its type."""
    if not isinstance(header, dict) or set(header) != set(KEYS):
        found = ", ".join(sorted(map(str, header))) if isinstance(header, dict) else type(header).__name__
        raise ValueError(f"message: expected a header with {', '.join(KEYS)}, got {found[:200]}")
    for key, kind in KEYS.items():
        if type(header[key]) is not kind:
            raise ValueError(f"message: {key}: expected {kind.__name__}, got {type(header[key]).__name__}")
    if not header["kind"] or header["number"] < 0:
        raise ValueError("message: expected a kind and a number that is not negative")
