"""The step of a fit, made short enough for the estimate not to depend on it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..modules.integrator import MoserVeselovIntegrator
from .from_start import End, minimise_weighed
from .least_squares.elimination import solve
from .least_squares.levenberg_marquardt import FIRST
from .model.states import InitialStates
from .uncertainty.information import Information
from .uncertainty.noise import NO_NOISE
from .windows.level import Level
from .windows.step_size import mean_intervals

ENOUGH_STEPS = 1_000_000  # of trajectories by which the error of the step is judged
LARGEST_BIAS = 0.1  # of the step, in standard errors
MOST_REFINEMENTS, MOST_FINER = 3, 30
WORSE = 2.0  # chi-square for each degree of freedom, of whole trajectories than of short windows
LEAST_ORDER = 0.5  # with which the bias falls in the step, as assumed


class Assessed(NamedTuple):
    """The minimum of whole trajectories, assessed."""

    at_bound: np.ndarray  # (p,)
    information: Information
    freedom: int
    variance: float
    moved: float  # shift of the estimate by steps of half the size, in standard errors


class Refined(NamedTuple):
    """Where a fit ends with steps that are short enough."""

    end: End
    level: Level
    longest_steps: Sequence[np.ndarray]  # (trajectories,) of each configuration, s
    assessed: Assessed
    bias: float  # by the step that is left, in standard errors


def refine(
    end: End,
    levels: Sequence[Level],
    longest_steps: Sequence[np.ndarray],
    integrator: MoserVeselovIntegrator | None,
    states: InitialStates,
) -> Refined:
    """Fit whole trajectories again with shorter steps, until their bias is small.

    A step that the user gave, in an integrator, stays. It stays too where the fit did not converge:
    shorter steps would not mend that. Where whole trajectories fit much worse than the shortest
    windows, these are fitted with the shorter steps too, from `states`, so that both are judged
    alike.
    """
    refinements, before, finer, was_worse = 0, np.inf, 2.0, end.worse > WORSE
    level, configurations = levels[-1], end.problem.configurations
    order_of_method = min(method.order for method in end.problem.methods)
    while True:
        assessed = _assess(end, level)
        moved = assessed.moved
        # Half the step divides the bias by 2^p for order p; where a torque law jumps, p is lower.
        order = np.log(before / max(moved, 1e-300)) / np.log(finer)
        order = np.clip(order, LEAST_ORDER, order_of_method)
        bias = moved / (1 - 0.5**order)
        enough = not bias > LARGEST_BIAS or moved >= before
        stays = integrator is not None or not end.found.converged
        if enough or stays or refinements == MOST_REFINEMENTS:
            break
        refinements += 1
        before, finer = moved, min(np.ceil((2 * bias / LARGEST_BIAS) ** (1 / order)), MOST_FINER)
        longest_steps = [
            np.minimum(longest_step, mean_intervals(each.recordings)) / finer
            for each, longest_step in zip(configurations, longest_steps, strict=True)
        ]
        level = level.laid_out_again(configurations, longest_steps)
        point = end.found.theta, end.found.states, end.width, end.found.damping
        problem, found, width = minimise_weighed(end.problem, level, *point, whole=True)
        variance = problem.residual_variance(found)
        worse = end.worse * variance / max(end.variance, NO_NOISE)
        done = end.iterations + found.iterations
        end = End(problem, found, width, variance, worse, done)
    if refinements and was_worse:
        shortest = levels[0].laid_out_again(configurations, longest_steps)
        point = end.found.theta, states, None, FIRST
        problem, found, _ = minimise_weighed(end.problem, shortest, *point, whole=False)
        end = end._replace(worse=end.variance / max(problem.residual_variance(found), NO_NOISE))
    return Refined(end, level, longest_steps, assessed, bias)


def _assess(end: End, level: Level) -> Assessed:
    problem, found = end.problem, end.found
    system, known = found.problem.system, problem.information(found)
    at_bound = known.at_bound
    freedom = problem.freedom(found, known)
    variance = problem.variance(found, freedom)
    # The shift is one of all trajectories, about: some of many are enough.
    steps = int(problem.together.sum(level.steps))
    part, numbers = level.some(-(-steps // ENOUGH_STEPS))
    point = found.theta, found.states.at(numbers), end.width
    fine, coarse = problem.linearise(part.refined(), *point).system, system.of_windows(numbers)
    shift = solve(fine, 0, at_bound).theta - solve(coarse, 0, at_bound).theta
    unit = 1.0 if problem.noise_is_given else np.fmax(variance, NO_NOISE)
    return Assessed(at_bound, known, freedom, variance, known.length(shift) / np.sqrt(unit))
