"""The size of the noise, from the residuals of a fit."""

import numpy as np

from .information import Information

NO_NOISE = 1e-12  # variance of whitened residuals below which they are rounding


def degrees_of_freedom(residuals: int, known: Information, prior: np.ndarray) -> int:
    """Number of residuals minus number of observable unknowns, as far as residuals tell them.

    `prior` (rows, p+1) are rows of what is known beforehand.
    """
    of_prior = np.sum(known.whiten(prior[:, :-1]) ** 2)
    return max(0, residuals - known.rank + round(float(of_prior)))


def variance_factor(spread: np.ndarray, count: int, freedom: int) -> float:
    r"""The factor on the covariance for unit noise, from the sums of `WindowFactors.spread` (3,).

    Without robust losses it is the variance of the whitened residuals. With them it is
    $\overline{|\psi|^2}/\overline{\psi'}^2$ for $\psi = \rho' r$ (Huber & Ronchetti, "Robust
    Statistics", 2nd ed., 2009, section 7.6), times the slope in the linearised problem.
    `count` is the number of residuals. Infinite without degrees of freedom.
    """
    if freedom == 0:
        return np.inf
    squares, slopes, in_problem = spread
    return squares / freedom * count * in_problem / slopes**2
