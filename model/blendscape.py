"""BlendSCAPE: SCAPE with rotations that are blended across the borders of parts."""
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from scanprep.geometry import storage

from .scape import ScapeModel


@dataclass(frozen=True, eq=False, repr=False)
class BlendScapeModel(ScapeModel):
    """A SCAPE model in which triangles near a border are carried by a mixture of rotations.

    An edge is `Σ_p w_kp R_p S_k Q_k v̂`; all else is as in SCAPE.

    Parameters
    ----------
    blend : (F, J) float
        Weights of the rotations, rows sum to 1; each triangle has a share of its own part.

    [BlendSCAPE]
    """

    blend: np.ndarray = field(kw_only=True)

    kind: ClassVar[str] = "blendscape"

    def __post_init__(self) -> None:
        shape = (len(self.template.faces), len(self.skeleton.parents))
        if self.blend.shape != shape or not np.allclose(self.blend.sum(axis=1), 1, atol=1e-6):
            raise ValueError(f"blend: expected shape {shape} with rows that sum to 1, got {self.blend.shape}")

    @property
    def rotation_weights(self) -> np.ndarray:
        return self.blend

    def _arrays(self) -> dict[str, np.ndarray]:
        return {**super()._arrays(), "blend": self.blend}

    @classmethod
    def _extra(cls, a: dict[str, np.ndarray]) -> dict[str, Any]:
        return {"blend": storage.numbers(a, "blend", None, None)}
