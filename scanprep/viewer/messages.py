"""One message between Python and the page: a kind, fields in JSON, and bytes behind them.

    0  4 bytes   length n of the header, unsigned, little-endian
    4  n bytes   header: JSON in UTF-8 with `kind`, `latest`, `number`, `fields`; blanks up to a multiple of 8
    4 + n        data, aligned so that arrays of any type can be read in place
"""
from __future__ import annotations

import inspect
import json
import struct
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import NoneType, UnionType
from typing import Any

from ..geometry import storage
from ..geometry.format_common import FARTHEST

LONGEST = 4096                       # characters of a text: paths have as many
# keys of a header and their types
KEYS = {"kind": str, "latest": str, "number": int, "fields": dict}


@dataclass(frozen=True)
class Message:
    """What one side sends to the other.

    Parameters
    ----------
    kind : str
        What it is about, such as "pose".
    fields : mapping
        Values for JSON; arrays become lists, numbers that are not finite become null.
    data : bytes
        Anything else, such as packed geometry.
    latest : str
        A newer message with this key replaces a waiting older one, unless one without a key came between.
    number : int
        Number among the messages of its tab, set by the tab's connection; 0 for none.
    """

    # length of the header: 4 bytes
    LENGTH = struct.Struct("<I")

    kind: str
    fields: Mapping[str, Any] = field(default_factory=dict)
    data: bytes = b""
    latest: str = ""
    number: int = 0

    def pack(self) -> bytes:
        """Pack the message into one binary frame; TypeError for fields that JSON cannot hold."""
        header = {"kind": self.kind, "latest": self.latest, "number": self.number,
                  "fields": storage.as_json(dict(self.fields))}
        text = json.dumps(header, allow_nan=False, separators=(",", ":")).encode("utf-8")
        # data begin at a multiple of 8 bytes, which the largest number type needs
        text += b" " * (-(len(text) + self.LENGTH.size) % 8)
        return self.LENGTH.pack(len(text)) + text + self.data

    @classmethod
    def unpack(cls, raw: bytes | str) -> Message:
        """Unpack the message of a frame; ValueError for anything else."""
        if isinstance(raw, str):
            raise ValueError(f"message: expected a binary frame, got text of {len(raw)} characters")
        if len(raw) < cls.LENGTH.size:
            raise ValueError(f"message: expected at least {cls.LENGTH.size} bytes, got {len(raw)}")
        end = cls.LENGTH.size + cls.LENGTH.unpack_from(raw)[0]
        if end > len(raw):
            start = cls.LENGTH.size
            raise ValueError(f"message: expected a header of {end - start} bytes, got {len(raw) - start}")
        header = storage.parse_json("message", bytes(raw[cls.LENGTH.size:end]), "a header")
        _check(header)
        return cls(data=bytes(raw[end:]), **header)


def _check(header: Any) -> None:
    """Raise ValueError where a header does not have the keys of a message, each of its type."""
    if not isinstance(header, dict) or set(header) != set(KEYS):
        received = ", ".join(sorted(map(str, header))) if isinstance(header, dict) else type(header).__name__
        raise ValueError(f"message: expected a header with {', '.join(KEYS)}, got {received[:200]}")
    for key, kind in KEYS.items():
        if type(header[key]) is not kind:
            raise ValueError(f"message: {key}: expected {kind.__name__}, got {type(header[key]).__name__}")
    if not header["kind"] or header["number"] < 0:
        raise ValueError("message: expected a kind and a number that is not negative")


def find_action(app: object, kind: str) -> Callable[..., Any]:
    """Return the method of an app that answers messages of a kind; ValueError where there is none."""
    action = getattr(app, f"on_{kind}", None)
    if not inspect.ismethod(action) or next(iter(inspect.signature(action).parameters), "") != "send":
        raise ValueError(f"a message of kind '{kind[:80]}', which nothing here answers")
    return action


def call_action(action: Callable[..., Any], fields: Mapping[str, Any], *given: object) -> Any:
    """Call a function with what is given first, then with the fields of a message as arguments.

    ValueError for fields that the function does not take, or that are not of the type in its signature.
    """
    fields, hints = storage.as_json(dict(fields)), typing.get_type_hints(action)
    parameters = list(inspect.signature(action).parameters.values())[len(given):]
    needed = {each.name for each in parameters if each.default is each.empty}
    if not needed <= set(fields) <= {each.name for each in parameters}:
        raise ValueError(f"message: expected fields among {', '.join(each.name for each in parameters) or 'none'}, "
                         f"got {', '.join(fields)[:200] or 'none'}")
    for name, value in fields.items():
        if not _fits(value, hints[name]):
            wanted = getattr(hints[name], "__name__", str(hints[name]))
            raise ValueError(f"message: {name}: expected {wanted}, got {json.dumps(value)[:80]}")
    return action(*given, **fields)


def _fits(value: Any, hint: Any) -> bool:
    """Test whether a value from JSON has a type: a text, a flag, a number, None, a list of these, or one of several."""
    inner = typing.get_args(hint)
    if isinstance(hint, UnionType):
        return any(_fits(value, each) for each in inner)
    if typing.get_origin(hint) is list:
        return type(value) is list and all(_fits(each, inner[0]) for each in value)
    if hint is float:
        return type(value) in (int, float) and abs(value) <= FARTHEST
    if hint is int:
        return type(value) is int and abs(value) < 2**53             # what JavaScript counts exactly
    return type(value) is hint and (hint is not str or len(value) <= LONGEST) and hint in (str, bool, NoneType)
