"""The words about an estimate: its verdict, the lines below the table, and messages."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc, stdtr, stdtrit

from ..diagnosis.log_mistakes import Mistake, find_mistake, find_other_force, find_other_input
from ..diagnosis.momentum import describe_residual_torque, why_no_body_moves_so
from ..diagnosis.suspects import (
    CHANCE,
    Suspect,
    describe_suspects,
    describe_trajectories,
    differ_in_size,
)
from ..fit.fit import LARGEST_BIAS, MAX_MISFIT_RATIO
from ..fit.part import FittedPart
from ..fit.problem import FitResult, Problem
from ..model.configuration import Configuration
from ..model.free_leaves import inertias_and_derivatives
from ..model.model import Model
from ..model.prior import Prior
from ..model.selection import names_of
from ..running.progress import Progress
from ..segments.levels import SHORTEST_TURN
from ..solver.elimination import STATE_SIZE
from ..uncertainty.information import NO_NOISE
from ..uncertainty.posterior import Noise, Spread
from ..uncertainty.report_table import ReportRows
from ..uncertainty.sandwich import Sandwich
from .abstract_estimate import AbstractEstimate

TIGHT = 1e-6  # part of the variance of a prior, up to which recordings cannot contradict it
IMPLAUSIBLE = 3.0  # standard errors from the mean of a prior, or below zero
MOST_NAMED = 3  # trajectories in a verdict
MUCH_LARGER = 10.0  # ratio of residuals to `sigma` that is reported
NORMAL = 1e4  # degrees of freedom with which Student's t is normal
LARGER = 1.2  # ratio of the variance to the given variance that is reported


class Halves(NamedTuple):
    """The number in which halves of the data differ most."""

    name: str  # empty if there are no halves
    apart: float  # in standard errors of the difference
    probability: float  # that any number differs so by chance


def judge(estimate: AbstractEstimate, suspects: Sequence[Suspect], halves: Halves) -> str:
    """Whether the model holds; see `verdict` of the estimate."""
    if not estimate.degrees_of_freedom:
        return "nothing tells whether the model holds, as no more was read than is fitted"
    against, allowed = [*estimate.mistakes], []
    # With a mistake suspects mean nothing, and all but the first are often effects of the first.
    suspects = () if estimate.mistakes else suspects
    certain = [suspect for suspect in suspects if suspect.is_certain]
    matters = [suspect for suspect in certain if suspect.matters]
    against += map(str, matters[:1])
    allowed += map(str, certain[:1])
    against += estimate.reasons
    if estimate.converged:
        against += below_zero(estimate)
    against += [f"{words} is implausible" for words in implausible(estimate)]
    scatter = []  # deviations that independent errors do not allow for
    for name, part in estimate.parts.items():
        where = f" of `{name}`" if len(estimate.parts) > 1 else ""
        if outliers := part.outliers:
            words = f"{_count(outliers)} not fit"
            words = f"in `{name}` {words}" if where else words
            (allowed if part.model.is_robust else against).append(words)
        correlated = [channel for channel, r in part.correlations.items() if r.is_certain]
        for channel, times in part.usual_residuals.items():
            if estimate.errors != "independent" and times > MUCH_LARGER:
                words = f"residuals of {channel}{where} are {times:.3g} times as large as `sigma`"
                (against if channel in correlated else allowed).append(words)
        if correlated and estimate.variance > NO_NOISE:
            scatter.append(f"residuals of {' and '.join(correlated)}{where} are correlated")
        if differ_in_size(part) and estimate.variance > NO_NOISE:
            scatter.append(f"residuals differ in size from trajectory to trajectory{where}")
    if halves.probability < CHANCE:
        against.append(
            f"halves of the data are {abs(halves.apart):.2g} standard errors apart ({halves.name})"
        )
    if against:
        return f"the model does not hold: {'; '.join(against)}"
    if scatter and estimate.errors == "independent":
        return f"the model may hold, but independent errors do not: {'; '.join(scatter)}"
    holds = "the model holds"
    if allowed or scatter:
        holds += f" with the intervals given: {'; '.join([*allowed, *scatter])}"
    if estimate.score_tests.not_tried:
        holds += " (what it may leave out was not tried)"
    return holds


def describe_fit(estimate: AbstractEstimate, halves: Halves) -> Iterator[str]:
    """How well the model fits, and the priors."""
    chi_square, freedom = estimate.chi_square, estimate.degrees_of_freedom
    line = f"trajectories: {estimate.trajectories}, degrees of freedom: {freedom}"
    if freedom:
        robust = any(part.model.is_robust for part in estimate.parts.values())
        kind = "robust loss" if robust else "chi-square"
        line += f", {kind} for each degree of freedom: {chi_square / freedom:.4g}"
    yield line
    J = None
    if isinstance(estimate.parameters, Model) and estimate.free.bodies:
        ((J,), _) = inertias_and_derivatives(estimate.parameters, estimate.free)
    count = sum(len(part.recordings) for part in estimate.parts.values())
    if estimate.trajectories > count:
        yield (
            f"this process has {count} of the trajectories: what is said of channels and of "
            "single trajectories, and so the verdict, is about these"
        )
    for name, part in estimate.parts.items():
        where = f"{name}: " if len(estimate.parts) > 1 else ""
        torque = describe_residual_torque(part.model, part.recordings, J)
        for words in (*part.statements(), *describe_trajectories(part), torque):
            if words:
                yield where + words
    if halves.name:
        yield (
            f"halves of the data against each other: at most {abs(halves.apart):.2g} standard "
            f"errors apart ({halves.name})"
        )
    for prior in estimate.prior:
        yield from _about_prior(estimate, prior)
    yield (
        f"{'converged' if estimate.converged else 'NOT CONVERGED'} after {estimate.iterations} "
        f"iterations; the step of the integrator moves the estimate by {estimate.step_bias:.1g} "
        "standard errors"
    )


def describe_left_out(estimate: AbstractEstimate, suspects: Sequence[Suspect]) -> Iterator[str]:
    """What the model may leave out."""
    if where := estimate.score_tests.not_tried:
        yield f"what the model may leave out is not tried where {where}"
        return
    tried, trajectories = estimate.score_tests.number_tried, estimate.trajectories
    if 0 < tried < trajectories:
        yield f"tried on {tried} of the {trajectories} trajectories, chosen at random"
    yield from describe_suspects(suspects)


def describe_errors(estimate: AbstractEstimate) -> str:
    """The kind of the standard errors of the report, what is independent for it, and why."""
    return f"standard errors: {_describe_kind(estimate)}; {estimate.reason}"


def _describe_kind(estimate: AbstractEstimate) -> str:
    number = estimate.trajectories
    trajectories = "1 trajectory" if number == 1 else f"{number} trajectories"
    if estimate.errors == "independent":
        return "independent (the noise of each reading independent of all others)"
    if estimate.errors == "clustered":
        return f"clustered (from the scatter of {trajectories})"
    if estimate.errors == "correlated":
        blocks = len(estimate.correlated.influence)
        return f"correlated (from the scatter of {blocks} blocks of time in {trajectories})"
    draws, converged = len(estimate.bootstrap.draws), len(estimate.converged_draws)
    failed = "" if converged == draws else f", {draws - converged} of which did not converge"
    return f"bootstrap (from {draws} draws of {trajectories}{failed})"


def describe_width(spread: Spread) -> Iterator[str]:
    """The widths of the intervals of numbers, where Student's t makes intervals wider."""
    freedom = spread.freedom[np.isfinite(spread.error) & np.isfinite(spread.freedom)]
    if not len(freedom):
        return
    ends = np.minimum([np.max(freedom), np.min(freedom)], NORMAL)
    width, degrees = (
        " to ".join(dict.fromkeys(f"{end:.{digits if end < 100 else 0}f}" for end in pair))
        for pair, digits in ((stdtrit(ends, 0.975), 2), (ends, 1))
    )
    yield (
        f"intervals: {width} standard errors to each side (Student's t, {degrees} degrees of "
        "freedom)"
    )


def find_messages(result: FitResult, estimate: AbstractEstimate, noise: Noise) -> Iterator[str]:
    """Notes for the user: what went wrong in the fit, and how to mend it."""
    if not result.converged:
        words = f"The fit did not converge: it stopped after {result.iterations} iterations in all"
        single = result.states.omega.dtype == np.float32
        if result.stopped_early:
            words += ", as no fit can be good before what the verdict names first is mended"
        elif single:
            words += ", in single precision; try float64"
        yield f"{words}."
    if result.start_as_good is not None:
        yield (
            "The inertia of the start fits as well as the estimate: in the directions that are not "
            "observable the estimate is noise."
        )
    agree, others = result.starts_that_agree, result.starts - result.starts_that_agree
    if others:
        yield (
            f"Of {result.starts} starts {agree} ended in this minimum, and {others} in a minimum "
            "with a larger chi-square."
        )
    trusted = agree > 1 and not result.tried_states
    if result.misfit_ratio > MAX_MISFIT_RATIO and not result.stopped_early:
        if trusted:
            reason = (
                f"fits from {agree} different starts end in this minimum, so that it is hardly a "
                "wrong one, and the model leaves something out, such as a torque, a bias or a time "
                "scale"
            )
        elif result.tried_states:
            reason = (
                "the minimum may be a wrong one, as no sensor tells the initial states and some "
                "were tried: give better initial states and a body that is close"
            )
        else:
            reason = (
                "the minimum may be a wrong one, as no other start ends there: give a better start"
            )
        yield (
            f"Whole trajectories fit {result.misfit_ratio:.3g} times worse than windows in which "
            f"the body turns {SHORTEST_TURN} rad (chi-square for each degree of freedom): {reason}."
        )
    times = np.sqrt(result.variance)
    wrong = "" if trusted or result.stopped_early else ", or the minimum is a wrong one"
    if result.freedom == 0:
        if noise == "residuals":
            yield (
                "As many numbers are fitted as were read, so that nothing tells the size of the "
                'noise, and standard errors are infinite: record more, or take `noise="given"`.'
            )
    elif noise == "given" and _is_larger(result):
        yield (
            f"The residuals are {times:.3g} times as large as the given noise: standard errors are "
            f"too small by that, or the model leaves something out{wrong}."
        )
    elif times > MUCH_LARGER:
        yield (
            f"The residuals are {times:.3g} times as large as the `sigma` of the sensors: it is "
            f"far too small, or the model leaves something out{wrong}."
        )
    if result.step_bias > LARGEST_BIAS and not result.stopped_early:
        yield (
            "The step of the integrator moves the estimate by "
            f"{result.step_bias:.2g} standard errors: take a smaller `dt` or a higher `order`."
        )
    yield from _about_correlation(estimate)
    yield from _about_own(result)
    free = estimate.free
    for i in np.flatnonzero(result.information.at_bound & (free.lower < free.upper)):
        yield f"`{free.names[i]}` is at its bound, and treated as known."


def find_reasons(result: FitResult, noise: Noise) -> Iterator[str]:
    """Why the model cannot hold, in short words."""
    if not result.converged:
        yield "the fit did not converge"
    if result.stopped_early:
        return
    if result.misfit_ratio > MAX_MISFIT_RATIO:
        yield f"whole trajectories fit {result.misfit_ratio:.3g} times worse than short windows"
    if noise == "given" and _is_larger(result):
        times = np.sqrt(result.variance)
        yield f"the residuals are {times:.3g} times as large as the given noise"
    if result.step_bias > LARGEST_BIAS:
        yield "the step of the integrator is too long"


def find_mistakes(parts: Mapping[str, Configuration | FittedPart]) -> Iterator[Mistake]:
    """Usual mistakes of a log, where another reading fits much better."""
    for name, part in parts.items():
        where = f" of `{name}`" if len(parts) > 1 else ""
        for reading, better in _other_readings(part):
            yield Mistake(f"{reading}{where}", better)


def find_unknown_torques(parts: Mapping[str, Configuration | FittedPart]) -> Iterator[str]:
    """Why no rigid body moves as recorded, even in short windows."""
    for name, part in parts.items():
        where = f"in `{name}` " if len(parts) > 1 else ""
        if words := why_no_body_moves_so(part.model, part.recordings):
            yield where + words


def say_what_was_reached(problem: Problem, report: Progress, checkpoint: Any) -> str:
    """The values that a stopped fit had reached, and the file from which it can go on, if any."""
    if report.theta is None:
        return "The fit was stopped before its first iteration."
    free = problem.free._replace(theta=report.theta)
    inertias, _ = inertias_and_derivatives(problem.parameters, free)
    total, unit = 1, " kg m²"
    if np.any(free.scale_direction):  # the size means nothing
        total, unit = np.trace(inertias, axis1=1, axis2=2).sum(), " of the trace"
    values = [
        f"{body.label('inertia')} = {(J / total).tolist()}{unit}"
        for body, J in zip(free.bodies, inertias, strict=True)
    ]
    values += [
        f"{name} = {value:.9g}"
        for name, value, of_body in zip(free.names, free.theta, free.of_body, strict=True)
        if not of_body
    ]
    goes_on = "" if checkpoint is None else f" The same call goes on from there, by {checkpoint}."
    return (
        f"The fit was stopped after {report.iterations} iterations, at {report.cost} with "
        f"{', '.join(values)}.{goes_on}"
    )


def find_halves(estimate: AbstractEstimate, numbers: ReportRows) -> Halves:
    """How far halves of the data are apart, in the numbers of the report."""
    apart, chance = compare_halves(estimate.correlated, numbers.jacobian)
    known = ~estimate.information.unknown(numbers.jacobian) & (apart != 0)
    if not known.any():
        return Halves("", 0.0, 1.0)
    i = int(np.argmin(np.where(known, chance, np.inf)))
    probability = float(chance[i]) * len(estimate.free.theta)
    return Halves(numbers.names[i], float(apart[i]), probability)


def compare_halves(sandwich: Sandwich, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Differences of numbers (n,) from two halves of the data, in standard errors.

    The halves are the first and the second half of the clusters; the error is from the scatter
    within each half. With the probabilities that differences are as large by chance.
    """
    gradients = sandwich.information.whiten(jacobian)
    influence, pull = (quantity @ gradients.T for quantity in (sandwich.influence, sandwich.pull))
    count = len(pull)
    halves = slice(None, count // 2), slice(count // 2, None)
    if count < 4 or not np.isfinite(sandwich.variance):
        return np.zeros(len(jacobian)), np.ones(len(jacobian))
    squares = np.zeros(len(jacobian))
    for half in halves:
        half_influence = influence[half]
        squares += np.var(half_influence, axis=0, ddof=1) * len(half_influence)
    apart = np.sum(pull[halves[1]], axis=0) - np.sum(pull[halves[0]], axis=0)
    ratio = np.divide(apart, np.sqrt(squares), out=np.zeros_like(apart), where=squares > 0)
    # The scatter within halves has one mean more than the scatter of all clusters.
    freedom = np.maximum(sandwich.freedom_of(jacobian) - 1, 1)
    return ratio, 2 * stdtr(freedom, -abs(ratio))


def below_zero(estimate: AbstractEstimate) -> list[str]:
    """Numbers that are below zero by more than chance, though they cannot be, with the usual cause.

    Where the scale of an inertia is not observable, the scale of torques is not observable either;
    but the signs of torques are, by the ratios to the trace of the inertia.
    """
    free = estimate.free
    negative = [i for i, cause in enumerate(free.below_zero) if cause and free.theta[i] < 0]
    if not negative:
        return []
    inertias, derivatives = inertias_and_derivatives(estimate.parameters, free)
    traces, derivatives = (np.trace(J, axis1=1, axis2=2) for J in (inertias, derivatives))
    unit = np.eye(len(free.theta))[negative]
    relative = derivatives / traces[:, None]  # of the logarithm of each trace
    rows = [unit, *(unit - free.theta[negative, None] * gradient for gradient in relative)]
    values, jacobian = np.tile(free.theta[negative], len(rows)), np.concatenate(rows)
    spread = estimate.spread_of(values, jacobian, lambda draws: draws @ jacobian.T)
    below = np.nan_to_num(-values / spread.error, nan=0.0).reshape(len(rows), -1).max(axis=0)
    return [
        f"`{free.names[i]}` is below zero by {distance:.3g} standard errors: {free.below_zero[i]}"
        for i, distance in zip(negative, below, strict=True)
        if distance > IMPLAUSIBLE
    ]


def implausible(estimate: AbstractEstimate) -> list[str]:
    """Names of priors that the recordings contradict."""
    return [
        name
        for prior in estimate.prior
        for name, distance in zip(prior.names, contradiction_of(prior, estimate), strict=True)
        if abs(distance) > IMPLAUSIBLE
    ]


def contradiction_of(prior: Prior, estimate: AbstractEstimate) -> np.ndarray:
    """Distance of the mean of a prior from the estimate without the prior.

    In standard errors of the difference, which is larger than the difference to the estimate, as
    the prior has drawn the estimate to its mean.
    """
    return distance_from(prior, estimate) / np.sqrt(np.maximum(_told(prior, estimate), TIGHT))


def _told(prior: Prior, estimate: AbstractEstimate) -> np.ndarray:
    """How much of the variance of each number of a prior the recordings take away."""
    rows = prior.rows(estimate.parameters, estimate.free, estimate.free.theta)
    after = np.diag(estimate.independent.covariance_of(rows[:, :-1]))
    return 1 - np.where(np.isfinite(after), after, 0)


def distance_from(prior: Prior, estimate: AbstractEstimate) -> np.ndarray:
    """How far the estimate is from the mean of a prior, in standard deviations."""
    return prior.rows(estimate.parameters, estimate.free, estimate.free.theta)[:, -1]


def _count(outliers: tuple[str, ...]) -> str:
    """Such as `trajectory a does`, or `5 trajectories (a, b, c, ...) do`."""
    named = ", ".join(f"`{name}`" for name in outliers[:MOST_NAMED])
    if len(outliers) == 1:
        return f"trajectory {named} does"
    more = ", ..." if len(outliers) > MOST_NAMED else ""
    return f"{len(outliers)} trajectories ({named}{more}) do"


def _about_prior(estimate: AbstractEstimate, prior: Prior) -> Iterator[str]:
    """Each number of a prior with its mean and standard deviation, and the estimate."""
    for name, mean, deviation, off, against, told in zip(
        prior.names,
        prior.mean,
        prior.deviation,
        distance_from(prior, estimate),
        contradiction_of(prior, estimate),
        _told(prior, estimate),
        strict=True,
    ):
        words = ", which the recordings cannot contradict" if told < TIGHT else ""
        if abs(against) > IMPLAUSIBLE:
            words = f", IMPLAUSIBLE: without it {against:+.1f} standard errors"
        yield (
            f"{name}: {mean:.6g} +- {deviation:.2g}; the estimate is "
            f"{mean + off * deviation:.6g}, {off:+.1f} standard deviations from the mean{words}"
        )


def _other_readings(part: Configuration | FittedPart) -> Iterator[tuple[str, float]]:
    """Readings of the log that fit better, and the ratios of the squares."""
    if (mistake := find_mistake(part.model, part.recordings)) is not None:
        yield mistake
    for channel, sensor in part.model.sensors.items():
        if (reading := sensor.find_mistake(iter(part.recordings.channels[channel]))) is not None:
            yield reading
    for find in (find_other_input, find_other_force):
        if (mistake := find(part.model, part.recordings)) is not None:
            yield mistake


def _is_larger(result: FitResult) -> bool:
    """Whether the residuals are larger than the given noise, and not by chance."""
    by_chance = chdtrc(result.freedom, result.freedom * result.variance) if result.freedom else 1.0
    return bool(by_chance < CHANCE and result.variance > LARGER)


def _about_own(result: FitResult) -> Iterator[str]:
    """Local leaves of trajectories that are not observable."""
    unseen, first = result.information.unseen_local[:, STATE_SIZE:], 0
    for configuration in result.problem.configurations:
        number = len(configuration.recordings)
        unseen_of_part, first = unseen[first : first + number], first + number
        where = f" of `{configuration.name}`" if configuration.name else ""
        own_leaves = configuration.own
        if own_leaves is None:
            continue
        names = names_of(configuration.model, own_leaves)
        counts = [number, *np.sum(unseen_of_part[:, : len(names)], axis=0)]
        number, *counts = result.problem.processes.sum(counts).tolist()
        for name, count in zip(names, counts, strict=True):
            if count:
                yield (
                    f"`{name}`{where} is not observable in {count} of {number} trajectories, each "
                    "of which has its own: it is as at the start."
                )


def _about_correlation(estimate: AbstractEstimate) -> Iterator[str]:
    """Channels whose successive residuals are correlated."""
    for name, part in estimate.parts.items():
        where = f" of `{name}`" if len(estimate.parts) > 1 else ""
        for channel, correlation in part.correlations.items():
            if not correlation.is_certain:
                continue
            value = correlation.value
            factor = np.sqrt((1 + value) / max(1 - value, 0.01))
            words = (
                f"standard errors are too small, by a factor of about {factor:.2g}, or the model "
                'leaves something out; `errors="correlated"` allows for correlated noise'
                if estimate.errors == "independent"
                else "the noise is correlated, which the standard errors allow for, or the model "
                "leaves something out"
            )
            yield (
                f"Successive residuals of `{channel}`{where} are correlated by {value:.2f}: "
                f"{words}."
            )
