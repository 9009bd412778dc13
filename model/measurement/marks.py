"""The landmarks that measurements use, and the axes of the body."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from scanprep.geometry.landmark_names import translate_landmarks
from scanprep.geometry.mesh import Mesh

FEET = tuple(f"{side} {name}" for side in ("left", "right") for name in ("toe", "heel"))
# landmarks of measurements. The waist is left out: without its landmarks it is the narrowest section of the trunk.
MEASURED = (*FEET, "top of head", "neck front", "neck back", "navel", "back", "crotch",
            *(f"{side} {name}" for side in ("left", "right") for name in (
                "ear", "shoulder", "armpit", "nipple", "hip", "knee", "knee inside", "elbow outside", "elbow inside",
                "middle finger")))


@dataclass(frozen=True, eq=False)
class BodyLandmarks:
    """Named vertices of a template, and its directions up, left and ahead: the rows of `axes` (3, 3)."""

    mesh: Mesh
    of: Mapping[str, int]
    axes: np.ndarray

    @property
    def up(self) -> np.ndarray:
        return self.axes[0]

    def at(self, *names: str) -> np.ndarray:
        """Compute the mean (3,), metres, of some landmarks; KeyError where none of them is known."""
        known = [self.of[name] for name in names if name in self.of]
        if not known:
            raise KeyError(" and ".join(names))
        return self.mesh.vertices[known].mean(axis=0)

    def height(self, *names: str) -> float:
        """Compute the height of the mean of some landmarks along `up`, metres."""
        return float(self.at(*names) @ self.up)


def body_landmarks(mesh: Mesh, landmarks: Mapping[str, int]) -> BodyLandmarks:
    """Collect the landmarks of a template, by our names, and its axes.

    Up is the coordinate axis along which head or neck are above the feet, or else their direction.

    Raises
    ------
    ValueError
        No toes and heels, or nothing above: then nothing tells which way is up, and where the front is.
    """
    known = translate_landmarks(landmarks)
    lacking = [name for name in FEET if name not in known]
    above = ("top of head", "neck front", "neck back", "left ear", "right ear")
    if lacking or not set(above) & set(known):
        raise ValueError(f"landmarks: expected at least {', '.join(FEET)}, and one of {', '.join(above)}; there is no "
                         f"{', '.join(lacking) or 'landmark of head or neck'}")
    at = {name: mesh.vertices[known[name]] for name in (*FEET, *above) if name in known}
    feet, head = (np.mean([at[name] for name in names if name in at], axis=0) for names in (FEET, above))
    up = (head - feet) / np.linalg.norm(head - feet)
    axis = int(np.abs(up).argmax())
    # within 14 degrees of a coordinate axis the body stands along it
    if np.abs(up[axis]) > 0.97:
        up = np.sign(up[axis]) * np.eye(3)[axis]
    ahead = at["left toe"] - at["left heel"] + at["right toe"] - at["right heel"]
    ahead -= (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    return BodyLandmarks(mesh, known, np.stack([up, np.cross(up, ahead), ahead]))
