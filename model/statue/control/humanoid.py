"""The generic humanoid: 17 parts on H-Anim joints, about a thousand vertices, made from the synthetic people."""
from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path

from .files import read_control
from .model import ControlModel

STORED = Path(__file__).with_name("humanoid.npz")           # made by tests/humanoid_maker.py


@lru_cache(maxsize=1)
def humanoid() -> ControlModel:
    """The generic humanoid, the average of a man and a woman of 1.69 m, arms and legs a little apart.

    z is up, it faces -y and stands on z = 0, its left side is at +x. Its joints turn and its segments stretch as in the
    paper: with the place of the root 38 parameters of pose, and 9 lengths.

    [Statues] Section 3.1
    """
    return read_control(STORED)


@lru_cache(maxsize=1)
def humanoid_markers() -> dict[str, int]:
    """Label -> vertex of 41 motion-capture markers, labelled as in the CMU recordings."""
    return dict(json.loads(STORED.with_name("humanoid_markers.json").read_text(encoding="utf-8")))
