"""Settings of learning."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from scanprep.ranges import Positive, Settings


@dataclass(frozen=True)
class LearnConfig(Settings):
    """Settings of `learn_scape`.

    Attributes
    ----------
    features : {"linear", "quadratic"}
        What Q is linear in: the twists, or also their products.
    regressor : {"ridge", "svr"}
        Least squares with a penalty, or support-vector regression.
    prunings : floats, square radians
        Twist directions of smaller variance are not regressed on; the best is chosen by leaving poses out.
    ridges : floats, square radians
        Strengths of the penalty; the best is chosen by leaving poses out.
    smoothness : float
        The paper's 0.001: times the mean edge length it is w_s of Eq. 5 and 8.
    refinements : int
        How often part rotations are fitted anew to the learned model and the regression is corrected by what the
        stitched surface leaves; of a mix, the largest number of rounds.
    detail : float
        Features are joined to fewer ones as long as that changes the edges of a part by less, as a share of the mean
        edge length; 0 joins none.
    components : int
        Shape components to keep, fewer where there are fewer people.
    """

    features: Literal["linear", "quadratic"] = "linear"
    regressor: Literal["ridge", "svr"] = "ridge"
    prunings: tuple[float, ...] = (0.003, 0.01, 0.03)
    ridges: tuple[Positive, ...] = (1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1)
    smoothness: float = 0.001
    refinements: int = 4
    detail: float = 0.03
    components: int = 40

    @classmethod
    def from_paper(cls) -> LearnConfig:
        """The paper's own way: joints pruned at 0.1, linear least squares, w_s = 0.001 ρ, nothing refined.

        The 0.1 has no unit in the paper. It is read as a standard deviation in radians, a variance of 0.01; the paper's
        own poses lost a third of the parameters by it, others lose another share. Not as in the paper: 40 shape
        components, of which it tells no number; twists by a logarithm that holds at every angle.

        [SCAPE] Eq. 3, Eq. 4, Eq. 5, Eq. 7, Eq. 8
        """
        return cls(prunings=(0.01,), ridges=(1e-9,), smoothness=0.001, refinements=0, detail=0.0)
