"""Central differences: what derivatives of ours are compared with."""
import numpy as np


def differences(function, x, h=1e-6):
    """Derivatives (..., n) of a function by each of the n entries of x.

    Of a function of a step, `differences(lambda step: f(move(x, step)), np.zeros(n))`, those by each entry of the step;
    where `x` is a batch of rows, of all rows at once.
    """
    steps = np.eye(np.size(x)).reshape(-1, *np.shape(x))
    return np.stack([slope(lambda s, step=step: function(x + s * step), h) for step in steps], axis=-1)


def slope(function, h=1e-6):
    """The derivative of a function of one number at 0."""
    return (function(h) - function(-h)) / (2 * h)
