"""From recordings to an estimate, by maximum likelihood."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from numbers import Integral, Real
from typing import get_args

import jax
import numpy as np

from ..modules.integrator import MoserVeselovIntegrator
from .arguments import (
    in_one_precision,
    require_noise,
    require_rotations,
    require_scalar_step,
    require_states,
)
from .bootstrap import Bootstrap
from .data.recordings import Recordings
from .estimate import Errors, Estimate, Noise, choose_errors, require_errors
from .fit import LARGEST_BIAS, WORSE, Fitted, fit
from .model.free import Bound, Free, Where, body_of, select_free_leaves
from .model.model import Model
from .model.states import InitialStates
from .problem import FitProblem
from .progress import Progress, show_progress
from .uncertainty.noise import compute_correlations
from .uncertainty.posterior import Independent
from .uncertainty.roughly_known import Knowledge
from .uncertainty.sandwich import compute_sandwich
from .uncertainty.unobservable import describe
from .windows.schedule import SHORTEST_TURN

CORRELATED = 0.1  # of successive residuals
MUCH_LARGER = 10.0  # residuals than a guess of the noise


def identify(
    model: Model,
    recordings: Recordings,
    integrator: MoserVeselovIntegrator | None = None,
    *,
    free: Where = body_of,
    bounds: Sequence[Bound] = (),
    start: InitialStates | None = None,
    segment: float | None = None,
    noise: Noise = "residuals",
    errors: Errors | None = None,
    iterations: int = 100,
    progress: bool | None = None,
) -> Estimate:
    r"""Estimate parameters of a body, what acts on it, and its sensors, from recordings.

    Maximum likelihood of the free leaves and of the initial state of each trajectory: the sum of
    the squared whitened residuals (or of their robust losses) is minimised by Levenberg and
    Marquardt's method with derivatives through the simulation. Initial states are eliminated
    trajectory by trajectory, so that thousands are no burden. Long trajectories are fitted in
    windows that grow from a radian to the whole. Where whole trajectories fit worse than short
    windows, the fit begins again from two other inertias, which tells a wrong minimum from a model
    that leaves something out; the best minimum is taken.

    Parameters
    ----------
    model
        The body from which the fit starts, a sensor for each channel of the recordings, and what
        acts on the body beside recorded torques: a [`Model`][lgvi.identification.Model]. Of the
        body nothing has to be known: `PhysicalRigidBody.from_principal_moments([1, 1, 1])` will
        do. If its inertia is free it must be a [`PhysicalRigidBody`][lgvi.PhysicalRigidBody], or
        a module of your own whose every leaf gives a possible inertia.
    recordings
        What was recorded. Torques and rotor momenta are treated as exact.
    integrator
        Its `order`, and in `dt`, s, the longest step: intervals between samples are divided into
        equal steps. By default the order is the best for what acts, and the step is
        made so small that it moves the estimate by less than a tenth of the standard error; where
        that fails, a message says so.
    free
        Takes the nodes to estimate out of the model, such as
        `lambda model: (model.body, model.sensors["angular_velocity"].bias)`. By default the body's.
    bounds
        Triples of a function like `free`, a lower and an upper bound for its leaves; those of a
        body are coordinates of its inertia and not moments. A leaf that ends at a bound is treated
        as known: its standard error is NaN, and those of the others hold for that value.
    start
        Initial states from which to start. By default they are computed from the recordings.
    segment
        About the length, s, of segments for multiple shooting: trajectories are cut into segments
        with states of their own, and the gaps between them close as the fit goes on. The estimate
        is the same. For recordings that are long, or so sensitive that a simulation from one
        initial state gets lost. By default trajectories are not cut.
    noise
        `"residuals"`: standard errors are scaled by the variance of the residuals, so that only
        the ratios of the sensors' `sigma` matter. `"given"`: `sigma` is treated as exact. For
        standard errors of the kind `"independent"`.
    errors
        The kind of standard errors. `"independent"`: the noise of each reading is independent of
        all others. `"clustered"`: that of each trajectory is independent of other trajectories;
        within a trajectory it may be correlated, and larger than in others. `"correlated"`: that
        of each block of time is independent of other blocks, of which there are about 16 in all;
        for few trajectories. `"bootstrap"`: as `"clustered"`, from 200 fits to trajectories that
        are drawn again; without any linear approximation. By default `"clustered"` for ten
        trajectories and more and `"correlated"` for fewer; `"independent"` if the noise is
        `"given"`, or there is no more to be read than is fitted.
    iterations
        At most, for each length of the windows.
    progress
        Whether to show a progress bar (needs `tqdm`). By default it appears in a terminal or a
        notebook if the fit takes more than two seconds.

    Returns
    -------
    Estimate
        The estimate. Whether the fit converged is in it, and what else went wrong in `messages`.

    Raises
    ------
    ValueError, TypeError
        For arguments that do not go together.
    RuntimeError
        If the start cannot be simulated.
    KeyboardInterrupt
        If the user stops the fit, with the values that it had reached.
    """
    model = in_one_precision(model, recordings)
    selected = select_free_leaves(model, free, bounds)
    if not isinstance(noise, str) or noise not in get_args(Noise):
        raise ValueError(f'Argument `noise` must be "residuals" or "given", but is {noise!r}.')
    if noise == "given" and model.is_robust:
        raise ValueError(
            'Argument `noise` must be "residuals" with a robust loss, as that does not treat '
            "`sigma` as exact."
        )
    require_noise(model)
    if errors is not None:
        require_errors(errors, len(recordings))
    if integrator is not None:
        require_scalar_step(integrator)
    if start is not None:
        require_states("start", start, recordings)
        require_rotations("start", start)
    if segment is not None and not (isinstance(segment, Real) and 0 < segment < np.inf):
        raise ValueError(f"Argument `segment` must be a time above 0 s, but is {segment!r}.")
    if not isinstance(iterations, Integral) or iterations < 1:
        raise ValueError(
            f"Argument `iterations` must be a whole number above 0, but is {iterations!r}."
        )
    with show_progress(progress) as report:
        try:
            fitted = fit(
                model,
                selected,
                recordings,
                integrator,
                start,
                segment,
                noise == "given",
                iterations,
                report,
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt(_reached(model, selected, report)) from None

    variance = 1.0 if noise == "given" else fitted.variance
    known = Knowledge(selected._replace(theta=fitted.theta), fitted.information, variance)
    described = describe(selected.model(model, fitted.theta), known, fitted.as_good)
    model, information = described.model, described.information
    freedom = np.inf if noise == "given" else fitted.freedom
    problem = FitProblem(model, described.free, recordings, fitted.method, iterations, Progress())
    estimate = Estimate(
        **described._asdict(),
        states=jax.device_put(fitted.states),
        recordings=recordings,
        residuals=fitted.residuals,
        predicted=fitted.predicted,
        converged=fitted.converged,
        iterations=fitted.iterations,
        chi_square=fitted.cost,
        degrees_of_freedom=fitted.freedom,
        step_bias=fitted.step_bias,
        messages=(),
        errors=errors or choose_errors(len(recordings), fitted.freedom, noise),
        variance=variance,
        independent=Independent(information, variance, freedom),
        clustered=compute_sandwich(fitted.by_trajectory, information, variance),
        correlated=compute_sandwich(fitted.by_time, information, variance),
        bootstrap=Bootstrap(
            problem, fitted.longest_step, fitted.states, information, fitted.variance
        ),
    )
    return replace(estimate, messages=tuple(_messages(fitted, estimate, noise)))


def _reached(model: Model, selected: Free, report: Progress) -> str:
    """What a fit that is stopped had reached."""
    if report.theta is None:
        return "`identify` was stopped before its first iteration."
    values = [
        f"{name} = {value:.9g}"
        for name, value, of_body in zip(selected.names, report.theta, selected.of_body, strict=True)
        if not of_body
    ]
    if selected.of_body.any():
        J = np.asarray(selected.model(model, report.theta).body.inertia)
        values = [f"inertia = {J.tolist()} kg m²", *values]
    return (
        f"`identify` was stopped after {report.iterations} iterations, at {report.cost} with "
        f"{', '.join(values)}."
    )


def _messages(fitted: Fitted, estimate: Estimate, noise: Noise) -> Iterator[str]:
    """What the user should know."""
    if not fitted.converged:
        words = f"The fit did not converge: it stopped after {fitted.iterations} iterations in all"
        single = fitted.states.omega.dtype == np.float32
        yield f"{words}, in single precision; try float64." if single else f"{words}."
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
    if fitted.worse > WORSE:
        reason = (
            f"fits from {agree} different starts end in this minimum, so that it is no wrong one, "
            "and the model leaves something out, such as a torque, a bias or a time scale"
            if agree > 1
            else "the minimum may be a wrong one, as no other start ends there: give a better start"
        )
        yield (
            f"Whole trajectories fit {fitted.worse:.3g} times worse than windows in which the body "
            f"turns {SHORTEST_TURN} rad (chi-square for each degree of freedom): {reason}."
        )
    times = np.sqrt(fitted.variance)
    wrong = "" if agree > 1 else ", or the minimum is a wrong one"
    if fitted.freedom == 0:
        if noise == "residuals":
            yield (
                "As many numbers are fitted as were read, so that nothing tells the size of the "
                'noise, and standard errors are infinite: record more, or take `noise="given"`.'
            )
    elif noise == "given" and fitted.variance > WORSE:
        yield (
            f"The residuals are {times:.3g} times as large as the given noise: standard errors are "
            f"too small by that, or the model leaves something out{wrong}."
        )
    elif times > MUCH_LARGER:
        yield (
            f"The residuals are {times:.3g} times as large as the `sigma` of the sensors: it is "
            f"far too small, or the model leaves something out{wrong}."
        )
    if fitted.step_bias > LARGEST_BIAS:
        yield (
            "The step of the integrator moves the estimate by "
            f"{fitted.step_bias:.2g} standard errors: take a smaller `dt` or a higher `order`."
        )
    found = compute_correlations(estimate.model, estimate.residuals, estimate.recordings)
    for channel, correlation in found.items():
        if correlation.value > CORRELATED + 4 * correlation.error:
            factor = np.sqrt((1 + correlation.value) / max(1 - correlation.value, 0.01))
            words = (
                f"standard errors are too small, by a factor of about {factor:.2g}, or the model "
                'leaves something out; `errors="correlated"` allows for correlated noise'
                if estimate.errors == "independent"
                else "the noise is correlated, which the standard errors allow for, or the model "
                "leaves something out"
            )
            yield (
                f"Successive residuals of `{channel}` are correlated by {correlation.value:.2f}: "
                f"{words}."
            )
    for name, at_bound in zip(estimate.free.names, fitted.at_bound, strict=True):
        if at_bound:
            yield f"`{name}` is at its bound, and treated as known."
