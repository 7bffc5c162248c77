"""The fit of all windows, from short ones to whole trajectories, from one start or several."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jax.sharding import Mesh

from ..modules.integrator import MoserVeselovIntegrator
from .arguments import scalar_step
from .checkpoint import Checkpoint
from .from_start import choose_best, fit_levels
from .least_squares.levenberg_marquardt import Minimum, NotSimulatedError
from .model.configuration import Configuration
from .model.free import Free
from .model.prior import Prior
from .model.states import InitialStates
from .problem import COARSE, FitProblem
from .progress import Progress, show_progress
from .refinement import WORSE, Assessed, refine
from .segments.chain import OfReadings, Which
from .simulated import Simulated
from .starts import first_estimate, first_states, other_estimates
from .together import Together
from .uncertainty.clusters import LEAST_CLUSTERS, Clusters, cluster_blocks, cluster_trajectories
from .uncertainty.information import Information, compute_information
from .uncertainty.noise import NO_NOISE
from .uncertainty.roughly_known import Knowledge, find_roughly_known
from .uncertainty.summary import OfChannel, summarise
from .windows.level import Level, make_levels
from .windows.measured import largest_rates, require_turns
from .windows.step_size import choose_method, first_steps

TURN_OF_STEP = 0.2  # rad, at most at the first trial
MOST_STEPS = 1e8  # of a trajectory, with a given step: an iteration takes minutes
MOST_IN_VAIN = 10  # iterations for each length of the windows, where no fit can be good
AS_GOOD = 20.5  # of chi-square: exceeded by chance in one of a thousand for five numbers


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
