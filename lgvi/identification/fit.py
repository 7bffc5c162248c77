"""The fit of all windows, from short ones to whole trajectories, with a step small enough."""

from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..modules.integrator import MoserVeselovIntegrator
from .data.recordings import Recordings
from .least_squares.block_arrow import solve
from .least_squares.levenberg_marquardt import Minimum, at_bounds
from .least_squares.multiple_shooting import first_width
from .model.free import Free
from .model.model import Model
from .model.states import InitialStates
from .problem import FitProblem
from .progress import Progress
from .starts import first_estimate, first_states, other_estimates
from .uncertainty.clusters import Clusters, cluster_blocks, cluster_trajectories
from .uncertainty.information import Information, compute_information
from .uncertainty.noise import NO_NOISE, degrees_of_freedom, number_of_residuals, variance_factor
from .uncertainty.roughly_known import Knowledge, describe_roughly_known
from .windows.grid import Window
from .windows.initial_guess import largest_rates
from .windows.layout import Layout, lay_out, refine
from .windows.schedule import cut_into_levels, first_of_trajectories, starts_within
from .windows.step_size import choose_method, mean_intervals

TURN_OF_STEP = 0.2  # rad, at most at the first trial
LARGEST_BIAS = 0.1  # of the step, in standard errors
MOST_REFINEMENTS, MOST_FINER = 3, 30
LEAST_ORDER = 0.5  # with which the bias falls in the step, as assumed
LEAST_CLUSTERS = 16  # blocks of time, in all trajectories
AS_GOOD = 20.5  # of chi-square: exceeded by chance in one of a thousand for five numbers
WORSE = 2.0  # chi-square for each degree of freedom, of whole trajectories than of short windows
COARSE = 1e-2  # gain of a next step at most, in variances of a residual


class Fitted(NamedTuple):
    """The minimum of whole trajectories."""

    theta: np.ndarray
    states: InitialStates
    residuals: dict[str, np.ndarray]  # of all readings, by channel
    predicted: dict[str, np.ndarray]
    cost: float
    freedom: int
    converged: bool
    iterations: int
    at_bound: np.ndarray  # (p,)
    information: Information
    variance: float
    by_trajectory: Clusters
    by_time: Clusters
    method: MoserVeselovIntegrator
    longest_step: np.ndarray  # (trajectories,), s
    step_bias: float
    worse: float  # variance of the residuals over that in the shortest windows
    starts: int  # from which it was fitted
    starts_that_agree: int  # from which the fit ends in this minimum
    as_good: Knowledge | None  # about the inertia of the start, if that fits as well


class _Assessed(NamedTuple):
    """The minimum of whole trajectories, assessed."""

    at_bound: np.ndarray  # (p,)
    information: Information
    freedom: int
    variance: float
    moved: float  # shift of the estimate by steps of half the size, in standard errors


def _assess(
    problem: FitProblem,
    layout: Layout,
    found: Minimum,
    width: np.ndarray | None,
    noise_is_given: bool,
) -> _Assessed:
    system = found.problem.system
    at_bound = at_bounds(system, found.theta, problem.free.lower, problem.free.upper)
    known = compute_information(system, at_bound)
    count = number_of_residuals(problem.model, layout)
    freedom = degrees_of_freedom(count, known)
    variance = variance_factor(np.asarray(found.problem.factors.spread), count, freedom)
    fine = problem.linearise(refine(layout), found.theta, found.states, width).system
    shift = solve(fine, 0, at_bound).theta - solve(system, 0, at_bound).theta
    unit = 1.0 if noise_is_given else np.fmax(variance, NO_NOISE)
    return _Assessed(at_bound, known, freedom, variance, known.length(shift) / np.sqrt(unit))


def fit(
    model: Model,
    free: Free,
    recordings: Recordings,
    integrator: MoserVeselovIntegrator | None,
    start: InitialStates | None,
    segment: float | None,
    noise_is_given: bool,
    iterations: int,
    report: Progress,
) -> Fitted:
    """Fit a model. With an integrator its `dt` is the longest step; else the step is found.

    Raises
    ------
    RuntimeError
        If the start cannot be simulated.
    """
    speeds = largest_rates(model, recordings, start)
    method, longest_step = choose_method(model, recordings, integrator, speeds, TURN_OF_STEP)
    levels = cut_into_levels(recordings, speeds, segment)
    # One of two numbers, so that one compiled program serves any few trajectories.
    blocks = LEAST_CLUSTERS if len(levels[-1]) < LEAST_CLUSTERS else 1
    problem = FitProblem(model, free, recordings, method, iterations, report, blocks)
    layouts = lay_out(recordings, levels, longest_step)
    states = first_states(problem, layouts[0], levels[0], speeds, start)
    theta = first_estimate(problem, layouts[0], states)
    ends = [_fit_levels(problem, layouts, levels, theta, states)]
    if ends[0].worse > WORSE:
        states = first_states(problem, layouts[0], levels[0], speeds, None)
        for other in other_estimates(model, free, ends[0].found.theta):
            with suppress(RuntimeError):  # it cannot be simulated
                ends.append(_fit_levels(problem, layouts, levels, other, states))
    best = min(ends, key=lambda end: end.found.problem.cost)
    done = sum(end.iterations for end in ends)

    last, found, width = layouts[-1], best.found, best.width
    refinements, before, finer = 0, np.inf, 2.0
    while True:
        assessed = _assess(problem, last, found, width, noise_is_given)
        moved = assessed.moved
        # Half the step divides the bias by 2^p for order p; where a torque law jumps, p is lower.
        order = np.log(before / max(moved, 1e-300)) / np.log(finer)
        order = np.clip(order, LEAST_ORDER, method.order)
        bias = moved / (1 - 0.5**order)
        enough = not bias > LARGEST_BIAS or moved >= before
        if enough or integrator is not None or refinements == MOST_REFINEMENTS:
            break
        refinements += 1
        before, finer = moved, min(np.ceil((2 * bias / LARGEST_BIAS) ** (1 / order)), MOST_FINER)
        longest_step = np.minimum(longest_step, mean_intervals(recordings)) / finer
        (last,) = lay_out(recordings, levels[-1:], longest_step)
        found, width = problem.minimise_whole(last, levels[-1], found.theta, found.states, width)
        done += found.iterations

    system, known = found.problem.system, assessed.information
    of_time = found.problem.factors.blocks
    of_time = None if of_time is None else np.asarray(of_time)

    def in_order(of_readings: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {channel: of_readings[channel] for channel in model.sensors}  # `jax.jit` sorts

    return Fitted(
        theta=found.theta,
        states=found.states.at(first_of_trajectories(levels[-1])),
        residuals=in_order(found.problem.residuals()),
        predicted=in_order(found.problem.predicted()),
        cost=found.problem.cost,
        freedom=assessed.freedom,
        converged=found.converged,
        iterations=done,
        at_bound=assessed.at_bound,
        information=known,
        variance=assessed.variance,
        by_trajectory=cluster_trajectories(system, known),
        by_time=cluster_blocks(system, of_time, known, LEAST_CLUSTERS),
        method=method,
        longest_step=longest_step,
        step_bias=bias,
        worse=best.worse,
        starts=len(ends),
        starts_that_agree=sum(end.agrees_with(best) for end in ends),
        as_good=_start_if_as_good(problem, last, levels[-1], found, assessed, width),
    )


class _End(NamedTuple):
    """Where a fit from a start ends, in the whole trajectories."""

    found: Minimum
    width: np.ndarray | None  # of gaps between segments
    variance: float  # of the residuals
    worse: float  # that, over the variance in the shortest windows
    iterations: int  # at all levels

    def agrees_with(self, other: "_End") -> bool:
        """Whether they are one minimum: chi-square differs by less than one residual's."""
        return abs(self.found.problem.cost - other.found.problem.cost) < other.variance


def _fit_levels(
    problem: FitProblem,
    layouts: list[Layout],
    levels: list[list[Window]],
    theta: np.ndarray,
    states: InitialStates,
) -> _End:
    """Fit all levels, each from where the one before ended."""
    variances, done = [], 0
    for i, layout in enumerate(layouts[:-1]):
        found = problem.minimise(layout, levels[i], COARSE, theta, states)
        theta, done = found.theta, done + found.iterations
        variances.append(_variance(problem, layout, found))
        states = found.states.at(starts_within(levels[i], levels[i + 1]))
    last, width = layouts[-1], None
    if last.position is not None:
        width = first_width(problem.linearise(last, theta, states), last)
    found, width = problem.minimise_whole(last, levels[-1], theta, states, width)
    variances.append(_variance(problem, last, found))
    worse = variances[-1] / max(variances[0], NO_NOISE)
    return _End(found, width, variances[-1], worse, done + found.iterations)


def _variance(problem: FitProblem, layout: Layout, found: Minimum) -> float:
    known = compute_information(found.problem.system, np.zeros(len(found.theta), bool))
    count = number_of_residuals(problem.model, layout)
    return found.problem.cost / max(1, degrees_of_freedom(count, known))


def _start_if_as_good(
    problem: FitProblem,
    layout: Layout,
    windows: list[Window],
    found: Minimum,
    assessed: _Assessed,
    width: np.ndarray | None,
) -> Knowledge | None:
    """What is known about the inertia of the start, if that fits as well as the estimate does.

    Noise alone moves an inertia that the recordings do not tell, and often to where a moment
    vanishes. What is not known is seen better at the start, as it is nowhere near a limit.
    """
    free, variance = problem.free, assessed.variance
    unit = max(variance, NO_NOISE) if np.isfinite(variance) else 1.0
    here = Knowledge(free._replace(theta=found.theta), assessed.information, unit)
    if found.converged and not any(describe_roughly_known(problem.model, here)):
        return None
    theta = np.where(free.of_body, free.theta, found.theta)
    lower, upper = (np.where(free.of_body, theta, each) for each in (free.lower, free.upper))
    pinned = replace(problem, free=free._replace(lower=lower, upper=upper))
    try:
        start = pinned.minimise(layout, windows, COARSE, theta, found.states, width)
    except RuntimeError:  # it cannot be simulated
        return None
    if start.problem.cost - found.problem.cost > AS_GOOD * unit:
        return None
    known = compute_information(start.problem.system, assessed.at_bound)
    return Knowledge(free._replace(theta=start.theta), known, variance)
