r"""How good an experiment is: Kiefer's criteria of the covariance of a quantity.

$$\varphi_p = \tfrac{1}{2}\log\bigl(\tfrac{1}{n}\operatorname{tr} C^p\bigr)^{1/p}$$

of the covariance $C = G M^{-1} G^T$ of n numbers with a Jacobian $G$ in the free leaves, of which
$M$ is the information: the logarithm of a standard error. With p = 1 it is the A-criterion, the
mean of the variances; with p to 0 the D-criterion, the volume; with p to infinity the E-criterion,
the largest variance of any direction: J. Kiefer, "General equivalence theory for optimum designs
(approximate theory)", Ann. Stat. 2 (1974), doi:10.1214/aos/1176342810.
"""

from typing import Literal, get_args

import numpy as np

Criterion = Literal["D", "A", "E"]
POWERS = {"D": 0, "A": 1, "E": 16}  # smooth where two variances are the largest
NOTHING = 1e-60  # square root of an information that is none
ROUNDING = 1e-10  # of variances, relative to the largest
RIDGE = 1e-14  # relative information, at least, so that every experiment has a finite value


def require_criterion(criterion: str) -> None:
    """Check the name of a criterion."""
    if not isinstance(criterion, str) or criterion not in get_args(Criterion):
        raise ValueError(f'Argument `criterion` must be "D", "A" or "E", but is {criterion!r}.')


def assess(
    criterion: Criterion, information: np.ndarray, jacobian: np.ndarray
) -> tuple[float, np.ndarray]:
    """The logarithm of a standard error, and its derivative by the information (p, p)."""
    scale = np.maximum(np.sqrt(np.diagonal(information)), NOTHING)
    values, directions = np.linalg.eigh(information / np.outer(scale, scale))
    along = (jacobian / scale) @ directions / np.maximum(values, RIDGE)
    root = directions @ along.T / scale[:, None]  # M^-1 G^T
    covariance, power = jacobian @ root, POWERS[criterion]
    variances, axes = np.linalg.eigh((covariance + covariance.T) / 2)
    # Numbers that depend on each other have fewer variances than numbers.
    differ = variances > ROUNDING * variances[-1]
    variances, axes = variances[differ], axes[:, differ]
    if power == 0:
        value, weights = np.mean(np.log(variances)) / 2, 1 / variances / len(variances) / 2
    else:
        largest = variances[-1]
        powers = (variances / largest) ** power
        value = (np.log(largest) + np.log(np.mean(powers)) / power) / 2
        weights = powers / variances / np.sum(powers) / 2
    by_covariance = (axes * weights) @ axes.T
    return float(value), -root @ by_covariance @ root.T
