"""Materials of binary glTF 2.0."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def skin_material(color: Sequence[float] = (0.60, 0.57, 0.53)) -> dict[str, Any]:
    """Make a matt glTF material of one colour (linear light)."""
    return {"name": "skin", "pbrMetallicRoughness": {
        "baseColorFactor": [*color, 1], "metallicFactor": 0, "roughnessFactor": 0.75}}
