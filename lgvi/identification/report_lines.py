"""What a report says under its table: of what kind the errors are, and how well the model fits."""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.special import stdtrit

from .abstract_estimate import AbstractEstimate
from .contradictions import IMPLAUSIBLE, Halves, contradiction_of, distance_from
from .diagnosis.doubts import Suspect, describe_suspects, describe_trajectories
from .diagnosis.unknown_torque import describe_residual_torque
from .model.free import inertias_and_derivatives
from .model.model import Model
from .model.prior import Prior
from .uncertainty.posterior import Spread

NORMAL = 1e4  # degrees of freedom with which Student's t is normal


def describe_errors(estimate: AbstractEstimate) -> str:
    """What the standard errors of the report take as independent."""
    number = estimate.trajectories
    of_all = "1 trajectory" if number == 1 else f"{number} trajectories"
    if estimate.errors == "independent":
        return "independent (the noise of each reading independent of all others)"
    if estimate.errors == "clustered":
        return f"clustered (from the scatter of {of_all})"
    if estimate.errors == "correlated":
        blocks = len(estimate.correlated.influence)
        return f"correlated (from the scatter of {blocks} blocks of time in {of_all})"
    draws, converged = len(estimate.bootstrap.draws), len(estimate.converged_draws)
    failed = "" if converged == draws else f", {draws - converged} of which did not converge"
    return f"bootstrap (from {draws} draws of {of_all}{failed})"


def describe_width(spread: Spread) -> Iterator[str]:
    """How wide the intervals of some numbers are, where Student's t makes them wider."""
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


def describe_estimate(
    estimate: AbstractEstimate, suspects: Sequence[Suspect], halves: Halves
) -> Iterator[str]:
    """How well the model fits, what was known beforehand, and what the user should know."""
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
    of_process = sum(len(part.recordings) for part in estimate.parts.values())
    if estimate.trajectories > of_process:
        yield (
            f"this process has {of_process} of the trajectories: what is said of channels and of "
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
    if where := estimate.score_tests.not_tried:
        yield f"what the model may leave out is not tried where {where}"
    else:
        yield from describe_suspects(suspects)
    for prior in estimate.prior:
        yield from _about_prior(estimate, prior)
    yield (
        f"{'converged' if estimate.converged else 'NOT CONVERGED'} after {estimate.iterations} "
        f"iterations; the step of the integrator moves the estimate by {estimate.step_bias:.1g} "
        "standard errors"
    )
    yield from (f"not observable: {words}" for words in estimate.unobservable)
    yield from (f"note: {message}" for message in estimate.messages)


def _about_prior(estimate: AbstractEstimate, prior: Prior) -> Iterator[str]:
    """Each number with its mean and standard deviation, and the estimate of it."""
    for name, mean, deviation, by, against in zip(
        prior.names,
        prior.mean,
        prior.deviation,
        distance_from(prior, estimate),
        contradiction_of(prior, estimate),
        strict=True,
    ):
        words = ""
        if abs(against) > IMPLAUSIBLE:
            words = f", IMPLAUSIBLE: without it {against:+.1f} standard errors"
        yield (
            f"{name}: {mean:.6g} +- {deviation:.2g}; the estimate is "
            f"{mean + by * deviation:.6g}, {by:+.1f} standard deviations from the mean{words}"
        )
