"""The fit from one start, through windows of all lengths, with priors weighed."""

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from .least_squares.levenberg_marquardt import FIRST, Minimum
from .least_squares.multiple_shooting import first_width
from .model.states import InitialStates
from .problem import COARSE, FitProblem
from .uncertainty.noise import NO_NOISE
from .windows.level import Level

WEIGHED = 1e-3  # relative change of the variance at most after which a prior is weighed right
MOST_WEIGHINGS = 20


class End(NamedTuple):
    """Where a fit from a start ends, in the whole trajectories."""

    problem: FitProblem  # with the prior weighed
    found: Minimum
    width: np.ndarray | None  # of gaps between segments
    variance: float  # of the residuals
    worse: float  # that, over the variance in the shortest windows, which may have longer steps
    iterations: int  # at all levels

    def agrees_with(self, other: "End") -> bool:
        """Whether they are one minimum: chi-square differs by less than one residual's."""
        return abs(self.found.problem.cost - other.found.problem.cost) < other.variance

    def cost(self, unit: float) -> float:
        """The cost, with a prior weighed by a variance of the noise."""
        prior = self.found.problem.prior_cost
        return self.found.problem.cost + prior * (unit / self.problem.unit - 1)


def choose_best(ends: list[End]) -> End:
    """The end with the least cost; priors are weighed alike, by the least noise."""
    unit = min(end.problem.unit for end in ends)
    return min(ends, key=lambda end: end.cost(unit))


def fit_levels(
    problem: FitProblem, levels: list[Level], theta: np.ndarray, states: InitialStates
) -> End:
    """Fit all levels, each from where the one before ended.

    Raises
    ------
    RuntimeError
        If the start cannot be simulated.
    """
    variances, done, damping = [], 0, FIRST
    for level, following in pairwise(levels):
        start = theta, states, None, damping
        problem, found, _ = minimise_weighed(problem, level, *start, whole=False)
        theta, damping, done = found.theta, found.damping, done + found.iterations
        variances.append(problem.residual_variance(found))
        states = found.states.at(following.starts_within(level))
    last, width = levels[-1], None
    if problem.together.any(last.is_joined):
        width = first_width(problem.linearise(last, theta, states))
    start = theta, states, width, damping
    problem, found, width = minimise_weighed(problem, last, *start, whole=True)
    variances.append(problem.residual_variance(found))
    worse = variances[-1] / max(variances[0], NO_NOISE)
    return End(problem, found, width, variances[-1], worse, done + found.iterations)


def minimise_weighed(
    problem: FitProblem,
    level: Level,
    theta: np.ndarray,
    states: InitialStates,
    width: np.ndarray | None,
    damping: float,
    *,
    whole: bool,
) -> tuple[FitProblem, Minimum, np.ndarray | None]:
    """The minimum, of `whole` trajectories or a coarse one, with the width of gaps.

    A prior is weighed by the variance of the noise, which the residuals tell. The variance and the
    estimate are found in turn; both together are most likely then.
    """
    done, weighings = 0, 0
    # A gain of one for each unknown moves it by about a standard error.
    unknowns = len(theta) + problem.together.sum(states.unknowns * level.number).item()
    while True:
        if whole:
            found, width = problem.minimise_whole(level, theta, states, width, damping)
        else:
            least = COARSE * unknowns
            found = problem.minimise(level, least, theta, states, None, damping)
        theta, states, damping = found.theta, found.states, found.damping
        done += found.iterations
        found, unit = found._replace(iterations=done), problem.find_unit(found)
        agrees = bool(abs(unit / problem.unit - 1) <= WEIGHED)
        if agrees or weighings == MOST_WEIGHINGS:
            return problem, found._replace(converged=found.converged and agrees), width
        problem, weighings = replace(problem, unit=unit), weighings + 1
