"""The fit of all windows, from short ones to whole trajectories, with a step small enough."""

from typing import NamedTuple

import numpy as np

from ..modules.integrator import MoserVeselovIntegrator
from .data.recordings import Recordings
from .least_squares.block_arrow import solve
from .least_squares.levenberg_marquardt import Minimum, at_bounds
from .least_squares.linearise import unobservable_scale_direction
from .least_squares.multiple_shooting import first_width
from .model.free import Free
from .model.model import Model
from .model.states import InitialStates
from .problem import FitProblem
from .progress import Progress
from .uncertainty.information import Information, compute_information
from .uncertainty.noise import NO_NOISE, degrees_of_freedom, number_of_residuals, variance_factor
from .windows.grid import Window
from .windows.initial_guess import (
    choose_attitudes,
    find_unknown_attitudes,
    guess_states,
    largest_rates,
)
from .windows.layout import Layout, lay_out, refine
from .windows.schedule import cut_into_levels, first_of_trajectories, starts_within
from .windows.step_size import choose_method, mean_intervals

TURN_OF_STEP = 0.2  # rad, at most at the first trial
LARGEST_BIAS = 0.1  # of the step, in standard errors
MOST_REFINEMENTS, MOST_FINER = 3, 30
LEAST_ORDER = 0.5  # with which the bias falls in the step, as assumed
MOST_POWERS = 9  # powers of ten that are tried on the inertia of the start
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
    step_bias: float
    worse: float  # variance of the residuals over that in the shortest windows


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
    problem = FitProblem(model, free, recordings, method, iterations, report)
    levels = cut_into_levels(recordings, speeds, segment)
    layouts = lay_out(recordings, levels, longest_step)
    states = _first_states(problem, layouts[0], levels[0], speeds, start)
    theta = _first_estimate(problem, layouts[0], states)
    theta, states, variances, done = _fit_short(problem, layouts[:-1], levels, theta, states)

    last, width = layouts[-1], None
    if last.position is not None:
        width = first_width(problem.linearise(last, theta, states), last)
    refinements, before, finer = 0, np.inf, 2.0
    while True:
        found, width = problem.minimise_whole(last, levels[-1], theta, states, width)
        theta, states, done = found.theta, found.states, done + found.iterations
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
    variances.append(found.problem.cost / max(1, assessed.freedom))

    def in_order(of_readings: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {channel: of_readings[channel] for channel in model.sensors}  # `jax.jit` sorts

    return Fitted(
        theta=theta,
        states=states.at(first_of_trajectories(levels[-1])),
        residuals=in_order(found.problem.residuals()),
        predicted=in_order(found.problem.predicted()),
        cost=found.problem.cost,
        freedom=assessed.freedom,
        converged=found.converged,
        iterations=done,
        at_bound=assessed.at_bound,
        information=assessed.information,
        variance=assessed.variance,
        step_bias=bias,
        worse=variances[-1] / max(variances[0], NO_NOISE),
    )


def _first_states(
    problem: FitProblem,
    layout: Layout,
    windows: list[Window],
    speeds: np.ndarray,
    start: InitialStates | None,
) -> InitialStates:
    """States at the start of the shortest windows: from `start` if given, else from readings."""
    model, recordings = problem.model, problem.recordings
    states = guess_states(model, recordings, windows, speeds)
    unknown = find_unknown_attitudes(model, recordings, windows)
    if unknown.any():

        def costs(states: InitialStates) -> np.ndarray:
            return np.asarray(problem.linearise(layout, problem.free.theta, states).factors.cost)

        states = choose_attitudes(costs, states, unknown)
    if start is None:
        return states
    first = first_of_trajectories(windows)
    R, omega = states.R.copy(), states.omega.copy()
    R[first], omega[first] = np.asarray(start.R), np.asarray(start.omega)
    return InitialStates(R, omega)


def _first_estimate(problem: FitProblem, layout: Layout, states: InitialStates) -> np.ndarray:
    """The start; if something acts, with the inertia times the power of ten that fits best."""
    free = problem.free
    if (
        not free.scale_direction.any()
        or unobservable_scale_direction(problem.model, free, problem.recordings).any()
    ):
        return free.theta
    found = {}
    for power in sorted(range(-MOST_POWERS, MOST_POWERS + 1), key=abs):
        theta = free.theta + power * np.log(10) * free.scale_direction
        if np.all((free.lower <= theta) & (theta <= free.upper)):
            found[power] = problem.linearise(layout, theta, states).cost, theta
    least = min(found, key=lambda power: found[power][0])
    return found[least if found[least][0] < 0.9 * found[0][0] else 0][1]


def _fit_short(
    problem: FitProblem,
    layouts: list[Layout],
    levels: list[list[Window]],
    theta: np.ndarray,
    states: InitialStates,
) -> tuple[np.ndarray, InitialStates, list[float], int]:
    """Fit all levels but the last, each from where the one before ended.

    Returns the estimate, the states with which the last level begins, the variance of the
    residuals of each level, and the number of iterations.
    """
    variances, done = [], 0
    for i, layout in enumerate(layouts):
        found = problem.minimise(layout, levels[i], COARSE, theta, states)
        theta, done = found.theta, done + found.iterations
        known = compute_information(found.problem.system, np.zeros(len(theta), bool))
        count = number_of_residuals(problem.model, layout)
        variances.append(found.problem.cost / max(1, degrees_of_freedom(count, known)))
        states = found.states.at(starts_within(levels[i], levels[i + 1]))
    return theta, states, variances, done
