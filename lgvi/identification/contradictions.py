"""What contradicts an estimate: halves that differ, signs, and what was known beforehand."""

from typing import NamedTuple

import numpy as np
from scipy.special import stdtr

from .abstract_estimate import AbstractEstimate
from .model.free import inertias_and_derivatives
from .model.prior import Prior
from .report import Numbers
from .uncertainty.sandwich import Sandwich

IMPLAUSIBLE = 3.0  # standard errors from the mean of a prior, or below zero


class Halves(NamedTuple):
    """The number in which halves of the data differ most."""

    name: str  # empty if there are no halves
    apart: float  # in standard errors of the difference
    probability: float  # that any number differs so by chance


def find_halves(estimate: AbstractEstimate, numbers: Numbers) -> Halves:
    """How far halves of the data are apart, in the numbers of the report."""
    apart, chance = compare_halves(estimate.correlated, numbers.jacobian)
    known = ~estimate.information.unknown(numbers.jacobian) & (apart != 0)
    if not known.any():
        return Halves("", 0.0, 1.0)
    i = int(np.argmin(np.where(known, chance, np.inf)))
    probability = float(chance[i]) * len(estimate.free.theta)
    return Halves(numbers.names[i], float(apart[i]), probability)


def compare_halves(sandwich: Sandwich, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far numbers (n,) from two halves of the data are apart, in standard errors of that.

    From the first half of the clusters, and from the second; the error is that of the scatter
    within each half. With the probabilities that they are as far apart by chance.
    """
    gradients = sandwich.information.whiten(jacobian)
    influence, pull = (each @ gradients.T for each in (sandwich.influence, sandwich.pull))
    count = len(pull)
    halves = slice(None, count // 2), slice(count // 2, None)
    if count < 4 or not np.isfinite(sandwich.variance):
        return np.zeros(len(jacobian)), np.ones(len(jacobian))
    squares = np.zeros(len(jacobian))
    for half in halves:
        of_half = influence[half]
        squares += np.var(of_half, axis=0, ddof=1) * len(of_half)
    apart = np.sum(pull[halves[1]], axis=0) - np.sum(pull[halves[0]], axis=0)
    ratio = np.divide(apart, np.sqrt(squares), out=np.zeros_like(apart), where=squares > 0)
    # The scatter within halves has one mean more than that of the whole.
    freedom = np.maximum(sandwich.freedom_of(jacobian) - 1, 1)
    return ratio, 2 * stdtr(freedom, -abs(ratio))


def distance_from(prior: Prior, estimate: AbstractEstimate) -> np.ndarray:
    """How far the estimate is from the mean of a prior, in standard deviations."""
    return prior.rows(estimate.parameters, estimate.free, estimate.free.theta)[:, -1]


def contradiction_of(prior: Prior, estimate: AbstractEstimate) -> np.ndarray:
    """How far the mean of a prior is from what the recordings tell without it.

    In standard errors of the difference, which is larger than that of the estimate, as the
    prior has drawn the estimate to its mean.
    """
    rows = prior.rows(estimate.parameters, estimate.free, estimate.free.theta)
    after = np.diag(estimate.independent.covariance_of(rows[:, :-1]))
    left = 1 - np.where(np.isfinite(after), after, 0)
    return rows[:, -1] / np.sqrt(np.maximum(left, 1e-6))


def below_zero(estimate: AbstractEstimate) -> list[str]:
    """Numbers that cannot be below zero and are so by more than chance, with the usual cause.

    Where the scale of an inertia is not observable, nor is that of torques; but their signs are, by
    the ratios to the trace of the inertia.
    """
    free = estimate.free
    negative = [i for i, cause in enumerate(free.below_zero) if cause and free.theta[i] < 0]
    if not negative:
        return []
    inertias, derivatives = inertias_and_derivatives(estimate.parameters, free)
    traces, derivatives = (np.trace(each, axis1=1, axis2=2) for each in (inertias, derivatives))
    one = np.eye(len(free.theta))[negative]
    relative = derivatives / traces[:, None]  # of the logarithm of each trace
    rows = [one, *(one - free.theta[negative, None] * gradient for gradient in relative)]
    values, together = np.tile(free.theta[negative], len(rows)), np.concatenate(rows)
    spread = estimate.spread_of(values, together, lambda draws: draws @ together.T)
    below = np.nan_to_num(-values / spread.error, nan=0.0).reshape(len(rows), -1).max(axis=0)
    return [
        f"`{free.names[i]}` is below zero by {by:.3g} standard errors: {free.below_zero[i]}"
        for i, by in zip(negative, below, strict=True)
        if by > IMPLAUSIBLE
    ]


def implausible(estimate: AbstractEstimate) -> list[str]:
    """Names of priors that the recordings contradict."""
    return [
        name
        for prior in estimate.prior
        for name, by in zip(prior.names, contradiction_of(prior, estimate), strict=True)
        if abs(by) > IMPLAUSIBLE
    ]
