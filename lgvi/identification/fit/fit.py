"""The fit of all windows, from short ones to whole trajectories, from one start or several."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ...modules.integrator import MoserVeselovIntegrator
from ..model.configuration import Configuration
from ..model.states import InitialStates
from ..running.progress import show_progress
from ..segments.levels import (
    Level,
    choose_method,
    first_steps,
    make_levels,
    order_of_motion,
    scalar_step,
)
from ..solver.elimination import solve
from ..solver.levenberg_marquardt import LeastGain, NotSimulatedError, Point
from ..start.measured import largest_rates, require_turns
from ..uncertainty.information import NO_NOISE, compute_information
from ..uncertainty.observability import LinearPosterior, find_roughly_known
from .problem import COARSE, FitResult, Problem, first_gap_sigma
from .starts import first_estimate, first_states, other_estimates

MOST_STEPS = 1e8  # of a trajectory, with a given step: an iteration takes minutes
MOST_IN_VAIN = 10  # iterations for each length of the windows, where no fit can be good
MAX_MISFIT_RATIO = 2.0  # chi-square for each degree of freedom, over that of short windows
AS_GOOD = 20.5  # of chi-square: exceeded by chance in one of a thousand for five numbers
WEIGHED = 1e-3  # relative change of the variance at most after which a prior is weighed right
MOST_WEIGHINGS = 20
LARGEST_BIAS = 0.1  # of the step, in standard errors
MOST_REFINEMENTS = 3
LEAST_FINER, MOST_FINER = 3, 30  # parts of a step that take its place
LEAST_ORDER = 0.5  # with which the bias falls in the step, as assumed


@show_progress("fitting")
def fit(
    problem: Problem, integrator: MoserVeselovIntegrator | None, segment: float | None
) -> FitResult:
    """Fit configurations. With an integrator its `dt` is the longest step; else it is found.

    Raises
    ------
    ValueError
        If a trajectory turns too far between samples, or a given step is far too short.
    RuntimeError
        If the start cannot be simulated.
    ConnectionError
        If another process of the fit has ended.
    """
    problem, levels, speeds = _prepare(problem, integrator, segment)
    trajectories = levels[-1].sampled()
    some = [level.only(level.of_trajectories(trajectories)) for level in levels]
    result, is_refined = _fit_from_starts(problem, some, speeds, integrator)
    if problem.processes.any(some[-1].number < levels[-1].number):
        of_starts = [level.only(levels[-1].starts_within(level)) for level in levels]
        of_all = _fit_all(result, of_starts, speeds)
        if of_all is not None:
            result, is_refined, levels = of_all, False, of_starts
        else:  # the sample did not tell enough
            result, is_refined = _fit_from_starts(problem, levels, speeds, integrator)
    if not is_refined:
        result = refine(result, levels, integrator)
    result.start_as_good = _start_if_as_good(result)
    return result


def _fit_from_starts(
    problem: Problem,
    levels: list[Level],
    speeds: list[np.ndarray],
    integrator: MoserVeselovIntegrator | None,
) -> tuple[FitResult, bool]:
    """The best minimum, from one start or several, and whether its step is made short enough."""
    free, processes = problem.free, problem.processes
    states, tried = first_states(problem, levels[0], speeds, free.theta)
    tried = processes.any(tried)
    first = fit_levels(problem, levels, first_estimate(problem, levels[0], states), states)
    refined = None
    if first.misfit_ratio > MAX_MISFIT_RATIO and first.converged:  # perhaps as steps are too long
        refined = refine(first, levels, integrator)
    results = [first]
    if (refined or first).misfit_ratio > MAX_MISFIT_RATIO and not problem.is_in_vain:
        results += _fit_from_other_starts(problem, levels, speeds, first, tried)
    best = _choose_best(results)  # all have the same steps
    agree = sum(result.agrees_with(best) for result in results)
    if refined is not None and first.agrees_with(best):
        best, result = first, refined
    else:
        result, refined = best, None
    result.iterations += sum(other.iterations for other in results if other is not best)
    result.starts, result.starts_that_agree, result.tried_states = len(results), agree, tried
    return result, refined is not None


def _fit_all(of_some: FitResult, levels: list[Level], speeds: list[np.ndarray]) -> FitResult | None:
    """The fit of all trajectories, from the leaves that a sample of the trajectories tells.

    None if that fit is not as good as the fit of the sample.
    """
    problem, theta = of_some.problem, of_some.theta
    states, _ = first_states(problem, levels[0], speeds, theta)
    try:
        result = fit_levels(problem, levels, theta, states, states_alone=True)
    except NotSimulatedError:
        return None
    if of_some.converged and not result.converged:
        return None
    if of_some.misfit_ratio <= MAX_MISFIT_RATIO < result.misfit_ratio:
        return None
    result.continue_from(of_some)
    return result


def _prepare(
    problem: Problem, integrator: MoserVeselovIntegrator | None, segment: float | None
) -> tuple[Problem, list[Level], list[np.ndarray]]:
    """The problem with its methods, the levels of windows, and the largest rates.

    Rates (trajectories,) of each configuration are in rad for each recorded second.
    """
    configurations, processes = problem.configurations, problem.processes
    with processes.checked():
        speeds = [
            largest_rates(configuration.model, configuration.recordings, start)
            for configuration, start in zip(configurations, problem.starts, strict=True)
        ]
        for configuration, speed in zip(configurations, speeds, strict=True):
            if integrator is None:
                require_turns(configuration.recordings, speed)
    methods = [choose_method(each.model, each.recordings, integrator) for each in configurations]
    longest_steps = [first_steps(integrator, speed, problem.turn_of_step) for speed in speeds]
    with processes.checked():
        _require_end(integrator, configurations)
    levels = make_levels(configurations, speeds, segment, longest_steps, processes)
    problem = replace(problem, methods=methods)
    if problem.is_in_vain:
        problem.iterations = min(problem.iterations, MOST_IN_VAIN)
    return problem, levels, speeds


def _fit_from_other_starts(
    problem: Problem,
    levels: list[Level],
    speeds: list[np.ndarray],
    first: FitResult,
    tried: bool,
) -> list[FitResult]:
    """Fits from inertias far from those of a result, and, if states were tried, from others."""
    starts = other_estimates(problem.parameters, problem.free, first.theta)
    # With better leaves, other states may be the best of those that are tried.
    if tried and not any(np.array_equal(start, first.theta) for start in starts):
        starts.append(first.theta)
    results, states = [], None
    for theta in starts:
        if tried or states is None:
            at = theta if tried else problem.free.theta
            states, _ = first_states(problem, levels[0], speeds, at, from_readings=True)
        with suppress(NotSimulatedError):
            results.append(fit_levels(problem, levels, theta, states))
    return results


def _require_end(
    integrator: MoserVeselovIntegrator | None, configurations: Sequence[Configuration]
) -> None:
    """Check that a given step is not so short that a fit would not end."""
    if integrator is None:
        return
    dt = scalar_step(integrator)
    recorded = [configuration.recordings for configuration in configurations]
    durations = [np.ptp(t) for recordings in recorded for t in map(recordings.times_of, recordings)]
    if (steps := max(durations) / dt) > MOST_STEPS:
        raise ValueError(
            f"Argument `integrator` must have a `dt` with at most {MOST_STEPS:.0e} steps in each "
            f"trajectory, but with {dt:.3g} s there are {steps:.1e}."
        )


def _choose_best(results: list[FitResult]) -> FitResult:
    """The result with the least cost; priors are weighed alike, by the least noise."""
    variance = min(result.problem.prior_noise_variance for result in results)
    return min(results, key=lambda result: result.cost_with(variance))


def fit_levels(
    problem: Problem,
    levels: list[Level],
    theta: np.ndarray,
    states: InitialStates,
    *,
    states_alone: bool = False,
) -> FitResult:
    """Fit all levels, each from where the one before ended; `states_alone` before the last level.

    Raises
    ------
    RuntimeError
        If the start cannot be simulated.
    """
    start, iterations, shortest, gap_sigma = Point(theta, states), 0, None, None
    free = problem.free
    if states_alone:
        problem = replace(problem, free=free._replace(lower=theta, upper=theta))
    for level, following in pairwise(levels):
        result = minimise_weighed(problem, level, start, whole=False)
        problem, iterations = result.problem, iterations + result.iterations
        shortest = result.residual_variance if shortest is None else shortest
        following_states = result.states.at(following.starts_within(level))
        start = result.start_nearby._replace(states=following_states)
    last, problem = levels[-1], replace(problem, free=free)
    if problem.processes.any(last.is_joined):
        gap_sigma = first_gap_sigma(problem.linearise(last, start.theta, start.states))
    result = minimise_weighed(problem, last, start, gap_sigma, whole=True)
    result.iterations, result.shortest_states = result.iterations + iterations, states
    if shortest is not None:
        result.misfit_ratio = result.residual_variance / max(shortest, NO_NOISE)
    return result


def minimise_weighed(
    problem: Problem,
    level: Level,
    start: Point,
    gap_sigma: np.ndarray | None = None,
    *,
    whole: bool,
) -> FitResult:
    """The minimum, of `whole` trajectories or a coarse one.

    A prior is weighed by the variance of the noise, which the residuals tell. The variance and the
    estimate are found in turn; both together are most likely then.
    """
    iterations, weighings = 0, 0
    while True:
        if whole:
            result = problem.minimise_whole(level, start, gap_sigma)
        else:
            coarse = LeastGain(COARSE * problem.count_unknowns(level, start))
            result = problem.minimise(level, coarse, start)
        iterations += result.iterations
        variance = result.prior_noise_variance
        agrees = bool(abs(variance / problem.prior_noise_variance - 1) <= WEIGHED)
        if agrees or weighings == MOST_WEIGHINGS:
            result.converged, result.iterations = result.converged and agrees, iterations
            return result
        start = Point(result.theta, result.states, start.damping)
        gap_sigma, weighings = result.gap_sigma, weighings + 1
        problem = replace(problem, prior_noise_variance=variance)


def refine(
    result: FitResult,
    levels: Sequence[Level],
    integrator: MoserVeselovIntegrator | None,
) -> FitResult:
    """Fit whole trajectories again with shorter steps, until their bias is small.

    A step that the user gave, in an integrator, stays. It stays too where the fit did not converge:
    shorter steps would not mend that. Where whole trajectories fit much worse than the shortest
    windows, these are fitted with the shorter steps too, so that both are judged alike.
    """
    refinements, before, finer, is_known = 0, np.inf, 2.0, False
    did_not_fit = result.misfit_ratio > MAX_MISFIT_RATIO
    problem = result.problem
    pairs = zip(problem.methods, problem.configurations, strict=True)
    order_of_method = min(order_of_motion(method, c.model) for method, c in pairs)
    while not is_known:
        leaves, states = _shift_by_half_steps(result)
        shift = result.length(leaves)
        # Half the step divides the bias by 2^p for order p; where a torque law jumps, p is lower.
        order = np.log(before / max(shift, 1e-300)) / np.log(finer)
        order = np.clip(order, LEAST_ORDER, order_of_method)
        bias = shift / (1 - 0.5**order)
        result.step_bias = bias / result.noise_deviation
        enough = not result.step_bias > LARGEST_BIAS or shift >= before
        stays = integrator is not None or not result.converged
        if enough or stays or refinements == MOST_REFINEMENTS:
            break
        refinements += 1
        before, finer = shift, np.ceil((2 * result.step_bias / LARGEST_BIAS) ** (1 / order))
        finer = np.clip(finer, LEAST_FINER, MOST_FINER)
        leaves, states = leaves / (1 - 0.5**order), states / (1 - 0.5**order)
        again = _fit_again(result, _without_bias(result, leaves, states), finer)
        # What is left of the bias, and how far the estimate did not move as this tells.
        left = again.power_of_steps(order) / result.power_of_steps(order)
        unexplained = again.length(again.theta - result.theta - (1 - left) * leaves)
        again.step_bias = (left * bias + unexplained) / again.noise_deviation
        is_known = again.step_bias <= LARGEST_BIAS
        result = again
    if refinements and did_not_fit:
        problem, longest_steps = result.problem, result.level.longest_steps
        shortest = levels[0].laid_out_again(problem.configurations, longest_steps)
        start = Point(result.theta, result.shortest_states)
        of_shortest = minimise_weighed(problem, shortest, start, whole=False)
        result.misfit_ratio = result.residual_variance / max(
            of_shortest.residual_variance, NO_NOISE
        )
    return result


def _without_bias(result: FitResult, leaves: np.ndarray, states: np.ndarray) -> Point:
    """Where the minimum without a bias is, about, but no farther than a linear model is good."""
    start, free = result.start_nearby, result.problem.free
    part = np.min(free.max_step / np.maximum(abs(leaves), 1e-300), initial=1.0)
    theta = np.clip(start.theta + part * leaves, free.lower, free.upper)
    return start._replace(theta=theta, states=start.states.moved(part * states))


def _fit_again(result: FitResult, start: Point, finer: float) -> FitResult:
    """The minimum of the same windows, with shorter steps."""
    longest_steps = [
        np.minimum(longest_step, chains.mean_steps) / finer
        for longest_step, chains in zip(
            result.level.longest_steps, result.level.chains, strict=True
        )
    ]
    problem = result.problem
    level = result.level.laid_out_again(problem.configurations, longest_steps)
    options = {"gap_sigma": result.gap_sigma, "whole": True}
    try:
        again = minimise_weighed(problem, level, start, **options)
    except NotSimulatedError:
        again = minimise_weighed(problem, level, result.start_nearby, **options)
    ratio = again.residual_variance / max(result.residual_variance, NO_NOISE)
    again.misfit_ratio = result.misfit_ratio * ratio
    again.continue_from(result)
    again.shortest_states = result.shortest_states
    return again


def _shift_by_half_steps(result: FitResult) -> tuple[np.ndarray, np.ndarray]:
    """The shift of the leaves (p,), and of the states (windows, m), by steps of half the size.

    Of a part of the trajectories if there are many; others have no shift of their states.
    """
    problem, level, at_bound = result.problem, result.level, result.information.at_bound
    numbers = level.of_trajectories(level.sampled())
    point = result.theta, result.states.at(numbers), result.gap_sigma
    fine = solve(problem.linearise(level.only(numbers).refined(), *point).system, 0, at_bound)
    coarse = solve(result.linearised.system.of_windows(numbers), 0, at_bound)
    own = np.zeros((level.number, result.states.unknowns))
    own[numbers] = fine.own - coarse.own
    return fine.theta - coarse.theta, own


def _start_if_as_good(result: FitResult) -> LinearPosterior | None:
    """What is known about the inertia of the start, if that fits as well as the estimate does.

    Noise alone moves an inertia that the recordings do not tell, and often to where a moment
    vanishes. What is not known is seen better at the start, as it is nowhere near a limit.
    """
    problem, theta, variance = result.problem, result.theta, result.noise_variance
    free = problem.free
    noise = max(variance, NO_NOISE) if np.isfinite(variance) else 1.0
    here = LinearPosterior(free._replace(theta=theta), result.information, noise)
    if result.converged and not find_roughly_known(problem.parameters, here):
        return None
    theta = np.where(free.of_body, free.theta, theta)
    lower, upper = (np.where(free.of_body, theta, bound) for bound in (free.lower, free.upper))
    pinned = replace(problem, free=free._replace(lower=lower, upper=upper))
    point = Point(theta, result.states)
    try:
        # In all, as costs are compared.
        start = pinned.minimise(result.level, LeastGain(COARSE), point, result.gap_sigma)
    except NotSimulatedError:
        return None
    linearised = start.linearise_undamped()
    if linearised.cost - result.linearised.cost > AS_GOOD * noise:
        return None
    known = compute_information(linearised.system, result.information.at_bound)
    return LinearPosterior(free._replace(theta=start.theta), known, variance)
