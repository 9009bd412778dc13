"""Loopy belief propagation (sum-product) on a pairwise Markov random field, over all edges at once."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class PairField:
    """A pairwise Markov random field; every variable has K states, whose meaning may differ between variables."""

    unary: np.ndarray            # (n, K) energy of every state of every variable; infinite for a missing state
    edges: np.ndarray            # (E, 2) pairs of variables, each once
    pairwise: np.ndarray         # (E, K, K) energy of a state of the first (rows) with one of the second (columns)

    def energy(self, states: np.ndarray) -> float:
        """Return the energy of one assignment of states (n,)."""
        i, j = self.edges.T
        return float(self.unary[np.arange(len(states)), states].sum()
                     + self.pairwise[np.arange(len(i)), states[i], states[j]].sum())


@dataclass(frozen=True, eq=False)
class Beliefs:
    """Probabilities (n, K) of the states of all variables, and the likeliest states (n,)."""

    probabilities: np.ndarray
    states: np.ndarray
    iterations: int
    converged: bool


def propagate(field: PairField, iterations: int, tolerance: float = 1e-3) -> Beliefs:
    """Compute beliefs by loopy belief propagation with parallel updates; exact on a tree.

    It has converged when the mean message changes by less than the tolerance.

    [CC] loopy belief propagation
    """
    i, j = field.edges.T
    forth, back = np.zeros((2, len(i), field.unary.shape[1]))
    # compatibility tables exp(-energy), one per direction, with the receiver's states as rows; float32 halves the time
    onward = np.exp(-np.ascontiguousarray(field.pairwise.transpose(0, 2, 1), dtype=np.float32))
    return_ = np.exp(-np.ascontiguousarray(field.pairwise, dtype=np.float32))
    done, change = 0, np.inf
    damping = 0.3                    # share of the old message that is kept, or messages on loops would swing
    while done < iterations and change > tolerance:
        # each variable sends its belief, without what the receiver itself has sent
        belief = _gather(field, forth, back)
        new_forth = _send(onward, _normalise(belief[i] - back))
        new_back = _send(return_, _normalise(belief[j] - forth))
        change = max(float(np.abs(new_forth - forth).mean()), float(np.abs(new_back - back).mean())) if len(i) else 0.0
        forth = damping * forth + (1 - damping) * new_forth
        back = damping * back + (1 - damping) * new_back
        done += 1
    # beliefs from the last messages
    p = np.exp(_normalise(_gather(field, forth, back)))
    return Beliefs(p / p.sum(axis=1, keepdims=True), p.argmax(axis=1), done, change <= tolerance)


def _gather(field: PairField, forth: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Sum log-messages at the receivers, plus the unary terms: unnormalised log-beliefs (n, K)."""
    belief = -np.asarray(field.unary, dtype=np.float64)
    np.add.at(belief, field.edges[:, 1], forth)
    np.add.at(belief, field.edges[:, 0], back)
    return belief


def _send(weights: np.ndarray, log_belief: np.ndarray) -> np.ndarray:
    """Compute log-messages (E, K): sums over the sender's states, floored so that the logarithm is finite."""
    sums = np.matmul(weights, np.exp(log_belief).astype(np.float32)[..., None])[..., 0]
    return _normalise(np.log(np.maximum(sums.astype(np.float64), 1e-37)))


def _normalise(messages: np.ndarray) -> np.ndarray:
    """Shift log-messages to a largest entry of zero, and clip at -60: less than e^-60 makes no difference."""
    if not messages.size:
        return messages
    return np.maximum(messages - messages.max(axis=1, keepdims=True), -60.0)
