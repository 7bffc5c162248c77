"""The fit from one start, through windows of all lengths, with priors weighed."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jax.sharding import Mesh

from ...modules.integrator import MoserVeselovIntegrator
from ..model.configuration import Configuration
from ..model.free_leaves import Free
from ..model.prior import Prior
from ..model.states import InitialStates
from ..running.processes import Together
from ..running.progress import Progress, show_progress
from ..segments.chain import OfReadings, Which
from ..segments.levels import (
    Level,
    choose_method,
    first_steps,
    make_levels,
    mean_intervals,
    scalar_step,
)
from ..solver.checkpoint import Checkpoint
from ..solver.elimination import solve
from ..solver.levenberg_marquardt import FIRST, Minimum, NotSimulatedError, first_width
from ..start.measured import largest_rates, require_turns
from ..uncertainty.information import NO_NOISE, Information, compute_information
from ..uncertainty.observability import Knowledge, find_roughly_known
from ..uncertainty.sandwich import LEAST_CLUSTERS, Clusters, cluster_blocks, cluster_trajectories
from .part import OfChannel, summarise
from .problem import COARSE, FitProblem, Simulated
from .starts import first_estimate, first_states, other_estimates

WEIGHED = 1e-3  # relative change of the variance at most after which a prior is weighed right
MOST_WEIGHINGS = 20

ENOUGH_STEPS = 1_000_000  # of trajectories by which the error of the step is judged
LARGEST_BIAS = 0.1  # of the step, in standard errors
MOST_REFINEMENTS, MOST_FINER = 3, 30
WORSE = 2.0  # chi-square for each degree of freedom, of whole trajectories than of short windows
LEAST_ORDER = 0.5  # with which the bias falls in the step, as assumed

TURN_OF_STEP = 0.2  # rad, at most at the first trial
MOST_STEPS = 1e8  # of a trajectory, with a given step: an iteration takes minutes
MOST_IN_VAIN = 10  # iterations for each length of the windows, where no fit can be good
AS_GOOD = 20.5  # of chi-square: exceeded by chance in one of a thousand for five numbers


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


class Experiment(NamedTuple):
    """What is fitted, and how it was recorded."""

    parameters: Any
    free: Free
    configurations: Sequence[Configuration]
    starts: Sequence[InitialStates | None]  # initial states of each configuration
    prior: Sequence[Prior]
    noise_is_given: bool
    is_in_vain: bool = False  # whether the recordings tell beforehand that no fit is good
    mistakes: Sequence[str] = ()  # that the log seems to have, in words


class OfConfiguration(NamedTuple):
    """What the minimum is for one configuration."""

    states: InitialStates
    residuals: dict[str, OfChannel]  # in a few numbers
    simulate: Callable[[Which], OfReadings]  # of all readings
    longest_step: np.ndarray  # (trajectories,), s


class Fitted(NamedTuple):
    """The minimum of whole trajectories."""

    theta: np.ndarray
    problem: FitProblem
    parts: list[OfConfiguration]
    cost: float  # of the residuals, without that of a prior
    freedom: int
    converged: bool
    iterations: int
    at_bound: np.ndarray  # (p,)
    information: Information
    variance: float
    by_trajectory: Clusters
    by_time: Clusters
    step_bias: float
    worse: float  # variance of the residuals over that in the shortest windows
    starts: int  # from which it was fitted
    starts_that_agree: int  # from which the fit ends in this minimum
    tried: bool  # whether initial states were tried, as no sensor tells them
    as_good: Knowledge | None  # about the inertia of the start, if that fits as well
    stopped_early: bool


@show_progress("fitting")
def fit(
    experiment: Experiment,
    integrator: MoserVeselovIntegrator | None,
    segment: float | None,
    iterations: int,
    report: Progress,
    checkpoint: Checkpoint | None,
    mesh: Mesh | None,
    together: Together,
) -> Fitted:
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
    parameters, free, configurations, starts, prior, noise_is_given, is_in_vain, mistakes = (
        experiment
    )
    iterations = min(iterations, MOST_IN_VAIN) if is_in_vain else iterations
    with together.checked():
        speeds = [
            largest_rates(each.model, each.recordings, start)
            for each, start in zip(configurations, starts, strict=True)
        ]
        for each, speed in zip(configurations, speeds, strict=True):
            if integrator is None:
                require_turns(each.recordings, speed, mistakes)
    methods = [choose_method(each.model, each.recordings, integrator) for each in configurations]
    longest_steps = [first_steps(integrator, speed, TURN_OF_STEP) for speed in speeds]
    with together.checked():
        _require_end(integrator, configurations)
    levels = make_levels(configurations, speeds, segment, longest_steps, together)
    # One of two numbers, so that one compiled program serves any few trajectories.
    blocks = LEAST_CLUSTERS if together.sum(levels[-1].number) < LEAST_CLUSTERS else 1
    problem = FitProblem(
        parameters,
        free,
        configurations,
        methods,
        prior,
        noise_is_given,
        iterations=iterations,
        report=report,
        blocks=blocks,
        checkpoint=checkpoint,
        mesh=mesh,
        together=together,
    )
    states, tried = first_states(problem, levels[0], speeds, starts, free.theta)
    tried = together.any(tried)
    theta = first_estimate(problem, levels[0], states)
    end, refined, given = fit_levels(problem, levels, theta, states), None, (integrator, states)
    if end.worse > WORSE and end.found.converged:  # perhaps as the steps are too long
        refined = refine(end, levels, longest_steps, *given)
        end, longest_steps = refined.end, refined.longest_steps
        levels = [*levels[:-1], refined.level]
    ends, others = [end], []
    if end.worse > WORSE and not is_in_vain:
        others = other_estimates(parameters, free, end.found.theta)
        # With better leaves, other states may be the best of those that are tried.
        if tried and not any(np.array_equal(other, end.found.theta) for other in others):
            others.append(end.found.theta)
    for i, other in enumerate(others):
        if tried or i == 0:
            of_levels = problem, levels[0], speeds, [None] * len(starts)
            states, _ = first_states(*of_levels, other if tried else free.theta)
        with suppress(NotSimulatedError):
            ends.append(fit_levels(problem, levels, other, states))
    best = choose_best(ends)
    if refined is not None and end.agrees_with(best):
        best = end
    else:
        refined = refine(best, levels, longest_steps, *given)
    done = refined.end.iterations + sum(each.iterations for each in ends if each is not best)

    (problem, found, width, *_), last, longest_steps, assessed, bias = refined
    system, known = found.problem.system, assessed.information
    return Fitted(
        theta=found.theta,
        problem=problem,
        parts=_of_configurations(problem, last, found, longest_steps),
        cost=found.problem.cost - found.problem.prior_cost,
        freedom=assessed.freedom,
        converged=found.converged,
        iterations=done,
        at_bound=assessed.at_bound,
        information=known,
        variance=assessed.variance,
        by_trajectory=cluster_trajectories(system, known),
        by_time=cluster_blocks(system, found.problem.blocks, known, LEAST_CLUSTERS),
        step_bias=bias,
        worse=refined.end.worse,
        starts=len(ends),
        starts_that_agree=sum(end.agrees_with(best) for end in ends),
        tried=tried,
        as_good=_start_if_as_good(problem, last, found, assessed, width),
        stopped_early=is_in_vain and not found.converged,
    )


def _require_end(
    integrator: MoserVeselovIntegrator | None, configurations: Sequence[Configuration]
) -> None:
    """Check that a given step is not so short that a fit would not end."""
    if integrator is None:
        return
    dt = scalar_step(integrator)
    recorded = [each.recordings for each in configurations]
    durations = [np.ptp(some.times_of(each)) for some in recorded for each in some]
    if (steps := max(durations) / dt) > MOST_STEPS:
        raise ValueError(
            f"Argument `integrator` must have a `dt` with at most {MOST_STEPS:.0e} steps in each "
            f"trajectory, but with {dt:.3g} s there are {steps:.1e}."
        )


def _of_configurations(
    problem: FitProblem,
    level: Level,
    found: Minimum,
    longest_steps: Sequence[np.ndarray],
) -> list[OfConfiguration]:
    """What the minimum is for each configuration."""
    simulated, parts = Simulated(problem, level, found.theta, found.states), []
    for k, (configuration, windows) in enumerate(
        zip(problem.configurations, level.windows, strict=True)
    ):
        residuals = simulated.in_parts(k, "residuals")
        first = np.unique([window.trajectory for window in windows], return_index=True)[1]
        parts.append(
            OfConfiguration(
                found.states.at(level.parts[k]).at(first),
                summarise(configuration.model, configuration.recordings, residuals),
                partial(simulated.of_configuration, k),
                longest_steps[k],
            )
        )
    return parts


def _start_if_as_good(
    problem: FitProblem,
    level: Level,
    found: Minimum,
    assessed: Assessed,
    width: np.ndarray | None,
) -> Knowledge | None:
    """What is known about the inertia of the start, if that fits as well as the estimate does.

    Noise alone moves an inertia that the recordings do not tell, and often to where a moment
    vanishes. What is not known is seen better at the start, as it is nowhere near a limit.
    """
    free, variance = problem.free, assessed.variance
    unit = max(variance, NO_NOISE) if np.isfinite(variance) else 1.0
    here = Knowledge(free._replace(theta=found.theta), assessed.information, unit)
    if found.converged and not find_roughly_known(problem.parameters, here):
        return None
    theta = np.where(free.of_body, free.theta, found.theta)
    lower, upper = (np.where(free.of_body, theta, each) for each in (free.lower, free.upper))
    pinned = replace(problem, free=free._replace(lower=lower, upper=upper))
    try:
        start = pinned.minimise(level, COARSE, theta, found.states, width)
    except NotSimulatedError:
        return None
    if start.problem.cost - found.problem.cost > AS_GOOD * unit:
        return None
    known = compute_information(start.problem.system, assessed.at_bound)
    return Knowledge(free._replace(theta=start.theta), known, variance)
