"""Whether the errors of a navigation solution are as large as its covariance says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napf_mpc.jit import compiled

__all__ = ["normalised_errors"]

Array = NDArray[np.float64]


@compiled
def normalised_errors(error: Array, covariance: Array, position: Array, whole: Array) -> None:
    """Write normalised estimation errors squared, e^T P^-1 e over the number of entries of e.

    The mean over many independent errors is 1 if they are as the covariance says, above 1 if they are
    larger. One Cholesky decomposition gives both, as the position's covariance is its leading block.

    Parameters
    ----------
    error : array, shape (run, uav, 6)
        Of position and velocity [m, m/s].
    covariance : array, shape (run, uav, 6, 6)
        As reported.
    position, whole : array, shape (run, uav)
        Out: of the position alone, and of position and velocity. NaN where a covariance is not positive
        definite: it says nothing then.
    """
    lower = np.empty((6, 6))
    y = np.empty(6)
    for r in range(error.shape[0]):
        for i in range(error.shape[1]):
            total = 0.0
            for n in range(6):
                for m in range(n + 1):
                    rest = covariance[r, i, n, m]
                    for k in range(m):
                        rest -= lower[n, k] * lower[m, k]
                    if m < n:
                        lower[n, m] = rest / lower[m, m]
                    else:
                        lower[n, n] = np.sqrt(rest) if rest > 0.0 else np.nan
                left = error[r, i, n]
                for m in range(n):
                    left -= lower[n, m] * y[m]
                y[n] = left / lower[n, n]
                total += y[n] * y[n]
                if n == 2:
                    position[r, i] = total / 3.0
            whole[r, i] = total / 6.0
