"""What the user should know of a fit, in words."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy.special import chdtrc

from .abstract_estimate import AbstractEstimate
from .diagnosis.doubts import CHANCE
from .diagnosis.inputs import find_other_input
from .diagnosis.mistakes import find_mistake
from .diagnosis.unknown_torque import why_no_body_moves_so
from .error_kinds import Noise
from .fit import Experiment, Fitted
from .fitted_part import FittedPart
from .least_squares.block_arrow import OWN
from .model.configuration import Configuration
from .model.free import inertias_and_derivatives
from .model.selection import names_of
from .progress import Progress
from .refinement import LARGEST_BIAS, WORSE
from .verdict import MUCH_LARGER
from .windows.schedule import SHORTEST_TURN

LARGER = 1.2  # variance than that given, at least, that matters


def say_what_was_reached(experiment: Experiment, report: Progress, checkpoint: Any) -> str:
    """What a fit that is stopped had reached, and that it goes on from a file, if there is one."""
    if report.theta is None:
        return "The fit was stopped before its first iteration."
    free = experiment.free._replace(theta=report.theta)
    inertias, _ = inertias_and_derivatives(experiment.parameters, free)
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


def find_messages(fitted: Fitted, estimate: AbstractEstimate, noise: Noise) -> Iterator[str]:
    """What the user should know."""
    if not fitted.converged:
        words = f"The fit did not converge: it stopped after {fitted.iterations} iterations in all"
        single = fitted.parts[0].states.omega.dtype == np.float32
        if fitted.stopped_early:
            words += ", as no fit can be good before what the verdict names first is mended"
        elif single:
            words += ", in single precision; try float64"
        yield f"{words}."
    if fitted.as_good is not None:
        yield (
            "The inertia of the start fits as well as the estimate: in the directions that are not "
            "observable the estimate is noise."
        )
    agree, others = fitted.starts_that_agree, fitted.starts - fitted.starts_that_agree
    if others:
        yield (
            f"Of {fitted.starts} starts {agree} ended in this minimum, and {others} in a minimum "
            "with a larger chi-square."
        )
    trusted = agree > 1 and not fitted.tried
    if fitted.worse > WORSE and not fitted.stopped_early:
        if trusted:
            reason = (
                f"fits from {agree} different starts end in this minimum, so that it is hardly a "
                "wrong one, and the model leaves something out, such as a torque, a bias or a time "
                "scale"
            )
        elif fitted.tried:
            reason = (
                "the minimum may be a wrong one, as no sensor tells the initial states and some "
                "were tried: give better initial states and a body that is close"
            )
        else:
            reason = (
                "the minimum may be a wrong one, as no other start ends there: give a better start"
            )
        yield (
            f"Whole trajectories fit {fitted.worse:.3g} times worse than windows in which the body "
            f"turns {SHORTEST_TURN} rad (chi-square for each degree of freedom): {reason}."
        )
    times = np.sqrt(fitted.variance)
    wrong = "" if trusted or fitted.stopped_early else ", or the minimum is a wrong one"
    if fitted.freedom == 0:
        if noise == "residuals":
            yield (
                "As many numbers are fitted as were read, so that nothing tells the size of the "
                'noise, and standard errors are infinite: record more, or take `noise="given"`.'
            )
    elif noise == "given" and _is_larger(fitted):
        yield (
            f"The residuals are {times:.3g} times as large as the given noise: standard errors are "
            f"too small by that, or the model leaves something out{wrong}."
        )
    elif times > MUCH_LARGER:
        yield (
            f"The residuals are {times:.3g} times as large as the `sigma` of the sensors: it is "
            f"far too small, or the model leaves something out{wrong}."
        )
    if fitted.step_bias > LARGEST_BIAS and not fitted.stopped_early:
        yield (
            "The step of the integrator moves the estimate by "
            f"{fitted.step_bias:.2g} standard errors: take a smaller `dt` or a higher `order`."
        )
    yield from _about_correlation(estimate)
    yield from _about_own(fitted)
    for name, at_bound in zip(estimate.free.names, fitted.at_bound, strict=True):
        if at_bound:
            yield f"`{name}` is at its bound, and treated as known."


def find_reasons(fitted: Fitted, noise: Noise) -> Iterator[str]:
    """Why the model cannot hold, in short words."""
    if not fitted.converged:
        yield "the fit did not converge"
    if fitted.stopped_early:
        return
    if fitted.worse > WORSE:
        yield f"whole trajectories fit {fitted.worse:.3g} times worse than short windows"
    if noise == "given" and _is_larger(fitted):
        times = np.sqrt(fitted.variance)
        yield f"the residuals are {times:.3g} times as large as the given noise"
    if fitted.step_bias > LARGEST_BIAS:
        yield "the step of the integrator is too long"


def find_mistakes(parts: Mapping[str, Configuration | FittedPart]) -> Iterator[str]:
    """Usual mistakes of a log, where another reading fits much better."""
    for name, part in parts.items():
        where = f" of `{name}`" if len(parts) > 1 else ""
        for reading, better in _other_readings(part):
            yield f"reading {reading}{where} fits {better:.3g} times better"


def find_unknown_torques(parts: Mapping[str, Configuration | FittedPart]) -> Iterator[str]:
    """Why no rigid body moves as recorded, even in short windows."""
    for name, part in parts.items():
        where = f"in `{name}` " if len(parts) > 1 else ""
        if words := why_no_body_moves_so(part.model, part.recordings):
            yield where + words


def _other_readings(part: Configuration | FittedPart) -> Iterator[tuple[str, float]]:
    """Readings of the log that fit better, and how many times."""
    if (mistake := find_mistake(part.model, part.recordings)) is not None:
        yield mistake
    for channel, sensor in part.model.sensors.items():
        if (of_sensor := sensor.find_mistake(iter(part.recordings.channels[channel]))) is not None:
            yield of_sensor
    if (mistake := find_other_input(part.model, part.recordings)) is not None:
        yield mistake


def _is_larger(fitted: Fitted) -> bool:
    """Whether the residuals are larger than the noise that is given, and not by chance."""
    by_chance = chdtrc(fitted.freedom, fitted.freedom * fitted.variance) if fitted.freedom else 1.0
    return bool(by_chance < CHANCE and fitted.variance > LARGER)


def _about_own(fitted: Fitted) -> Iterator[str]:
    """Leaves of trajectories of their own that are not observable."""
    unseen, first = fitted.information.own_unseen[:, OWN:], 0
    for configuration in fitted.problem.configurations:
        number = len(configuration.recordings)
        of_part, first = unseen[first : first + number], first + number
        where = f" of `{configuration.name}`" if configuration.name else ""
        own = configuration.own
        if own is None:
            continue
        names = names_of(configuration.model, own)
        counts = [number, *np.sum(of_part[:, : len(names)], axis=0)]
        number, *counts = fitted.problem.together.sum(counts).tolist()
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
