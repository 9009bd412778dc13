"""Settings of learning."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from scanprep.ranges import Positive, Settings


@dataclass(frozen=True)
class LearnConfig(Settings):
    """Settings of `learn_scape` and `learn_blendscape`.

    Attributes
    ----------
    features : {"linear", "quadratic"}
        Q is linear in the twists, or in the twists and their products.
    regressor : {"ridge", "svr"}
        Ridge regression, or support-vector regression.
    prunings : tuple of float, square radians
        Twist directions of smaller variance are not regressed on; the best value is chosen by leaving poses out.
    ridges : tuple of float, square radians
        Strengths of the penalty; the best value is chosen by leaving poses out.
    refinements : int
        How often part rotations are fitted anew to the learned model and the regression is corrected by what the
        stitched surface leaves; of a mix, the largest number of rounds.
    detail : float
        Features are combined into fewer as long as that changes the edges of a part by less than this share of the mean
        edge length; 0 combines none.
    components : int
        Shape components to keep, fewer where there are fewer people.

    Examples
    --------
    >>> LearnConfig.from_paper().prunings
    (0.01,)

    [SCAPE] Eq. 4, Eq. 5, Eq. 8
    """

    features: Literal["linear", "quadratic"] = "linear"
    regressor: Literal["ridge", "svr"] = "ridge"
    prunings: tuple[float, ...] = (0.003, 0.01, 0.03)
    ridges: tuple[Positive, ...] = (1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1)
    refinements: int = 4
    detail: float = 0.03
    components: int = 40

    @classmethod
    def from_paper(cls) -> LearnConfig:
        """Return the paper's settings: joints pruned at 0.1, linear least squares, w_s = 0.001 ρ, no refinement.

        The paper's 0.1 has no unit. Here it is a standard deviation in radians, a variance of 0.01. Pruning removed a
        third of the parameters on the paper's poses; the share differs for others. Not as in the paper: 40 shape
        components, since it names no number, and twists by a logarithm that holds at every angle.

        [SCAPE] Eq. 3, Eq. 4, Eq. 5, Eq. 7, Eq. 8
        """
        return cls(prunings=(0.01,), ridges=(1e-9,), refinements=0, detail=0.0)
