"""From recordings to an estimate, by maximum likelihood."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from numbers import Integral, Real
from typing import Any, TypeVar, get_args

import jax
import numpy as np

from ..modules.integrator import MoserVeselovIntegrator
from .abstract_estimate import AbstractEstimate
from .arguments import (
    in_one_precision,
    require_model,
    require_noise,
    require_parts,
    require_rotations,
    require_scalar_step,
    require_starts,
    require_states,
)
from .bootstrap import Bootstrap
from .data.recordings import Recordings
from .error_kinds import Errors, Noise, choose_errors, require_errors
from .estimate import Estimate, JointEstimate
from .fit import Experiment, Fitted, fit
from .fitted_part import FittedPart
from .messages import find_messages, say_what_was_reached
from .model.configuration import Configuration
from .model.model import Model
from .model.prior import PriorGiven, as_priors
from .model.selection import Bound, Where, body_of, select_free_leaves, select_own_leaves
from .model.states import InitialStates
from .problem import FitProblem
from .progress import Progress, show_progress
from .uncertainty.posterior import Independent
from .uncertainty.roughly_known import Knowledge
from .uncertainty.sandwich import compute_sandwich
from .uncertainty.unobservable import describe

Parts = Mapping[str, tuple[Callable[[Any], Model], Recordings]]


def identify(
    model: Model,
    recordings: Recordings,
    integrator: MoserVeselovIntegrator | None = None,
    *,
    free: Where = body_of,
    bounds: Sequence[Bound] = (),
    prior: Sequence[PriorGiven] = (),
    own: Where | None = None,
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
    prior
        What is known beforehand: triples of a function of the model, a mean and a standard
        deviation, in the shape of the function or one for all, such as
        `(lambda model: model.sensors["angular_velocity"].bias, 0.0, 0.02)`. The errors are normal
        and independent of each other. They count in the estimate and in its covariance.
    own
        Takes nodes out of the model, beside those that are free, which each trajectory has of its
        own, such as `lambda model: model.sensors["angular_velocity"].bias` for a bias that changes
        from one time that the gyroscope is switched on to the next. They are eliminated with the
        initial state, and found in `estimate.own`.
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
    model = in_one_precision(model)
    require_model(model, recordings)
    require_noise(model)
    selected = select_free_leaves(model, free, bounds)
    if start is not None:
        require_states("start", start, recordings)
        require_rotations("start", start)
    each = None if own is None else select_own_leaves(own, model, selected.selected)
    configuration = Configuration("", recordings, model, None, selected.selected, each)
    priors = as_priors(prior, model, selected)
    experiment = Experiment(
        model, selected, [configuration], [start], priors, noise_is_given=noise == "given"
    )
    options = integrator, segment, noise, errors, iterations, progress
    return _identify(Estimate, experiment, *options)


def identify_jointly(
    parameters: Any,
    parts: Parts,
    integrator: MoserVeselovIntegrator | None = None,
    *,
    free: Where = lambda parameters: parameters,
    bounds: Sequence[Bound] = (),
    prior: Sequence[PriorGiven] = (),
    own: Where | None = None,
    starts: Mapping[str, InitialStates] | None = None,
    segment: float | None = None,
    noise: Noise = "residuals",
    errors: Errors | None = None,
    iterations: int = 100,
    progress: bool | None = None,
) -> JointEstimate:
    r"""Estimate parameters that several configurations share, from recordings of each.

    A configuration is a body as it flew: a device alone, with a proof body, with an object. The
    model of each is a function of the parameters, and all are fitted at once, so that the errors
    of what is shared, such as the inertia of a flywheel, are in the errors of all that follows. One
    configuration will do where the leaves of a model are tied, or follow from fewer parameters.

    Parameters
    ----------
    parameters
        What the estimate is about, and where it starts: any pytree, such as a dictionary of bodies
        and numbers, or an Equinox module. Best a
        [`PhysicalRigidBody`][lgvi.PhysicalRigidBody] for each inertia.
    parts
        For each configuration by its name a function of the parameters that gives its
        [`Model`][lgvi.identification.Model], and its
        [`Recordings`][lgvi.identification.Recordings], such as
        `{"bare": (lambda p: Model(p["device"], gyroscope), recordings)}`. A function must be one
        that JAX can trace, and everything in it that does not depend on the parameters is known.
    free
        Takes the nodes to estimate out of the parameters; by default all.
    starts
        Initial states of some configurations, by name. By default they are computed from the
        recordings.
    own
        As for [`identify`][lgvi.identification.identify], a function of each model.
    integrator, bounds, prior, segment, noise, errors, iterations, progress
        As for [`identify`][lgvi.identification.identify], with functions of the parameters instead
        of the model.

    Returns
    -------
    JointEstimate
        The estimate. Whether the fit converged is in it, and what else went wrong in `messages`.

    Raises
    ------
    ValueError, TypeError
        For arguments that do not go together, and functions that do not give a model.
    RuntimeError
        If the start cannot be simulated.
    KeyboardInterrupt
        If the user stops the fit, with the values that it had reached.
    """
    parameters = in_one_precision(parameters)
    require_parts(parts)
    selected = select_free_leaves(parameters, free, bounds)
    states = require_starts(starts, {name: recordings for name, (_, recordings) in parts.items()})
    configurations = []
    for name, (function, recordings) in parts.items():
        given = name, recordings, function, parameters, selected
        configuration = Configuration.of_function(*given)
        try:
            require_model(configuration.model, recordings)
            require_noise(configuration.model)
        except ValueError as error:
            raise ValueError(f"In the part {name!r}: {error}") from None
        if own is not None:
            chosen = select_own_leaves(own, configuration.model, configuration.selected)
            configuration = configuration._replace(own=chosen)
        configurations.append(configuration)
    priors = as_priors(prior, parameters, selected)
    experiment = Experiment(
        parameters, selected, configurations, states, priors, noise_is_given=noise == "given"
    )
    options = integrator, segment, noise, errors, iterations, progress
    return _identify(JointEstimate, experiment, *options)


Kind = TypeVar("Kind", bound=AbstractEstimate)


def _identify(
    kind: type[Kind],
    experiment: Experiment,
    integrator: MoserVeselovIntegrator | None,
    segment: float | None,
    noise: Noise,
    errors: Errors | None,
    iterations: int,
    progress: bool | None,
) -> Kind:
    """An estimate of such a kind."""
    _require_options(experiment, integrator, segment, noise, errors, iterations)
    with show_progress(progress) as report:
        try:
            fitted = fit(experiment, integrator, segment, iterations, report)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(say_what_was_reached(experiment, report)) from None

    theta, variance = fitted.theta, 1.0 if noise == "given" else fitted.variance
    free = experiment.free._replace(theta=theta)
    known = Knowledge(free, fitted.information, variance)
    described = describe(free.put(experiment.parameters, theta), known, fitted.as_good)
    information = described.information
    problem = replace(
        fitted.problem,
        parameters=described.parameters,
        free=described.free,
        report=Progress(),
    )
    parts = _fitted_parts(problem, fitted)
    trajectories = sum(len(part.recordings) for part in parts.values())
    chosen, reason = choose_errors(trajectories, fitted.freedom, noise)
    prior_rows = problem.prior_rows(described.free.theta)
    estimate = kind(
        **described._asdict(),
        parts=parts,
        converged=fitted.converged,
        iterations=fitted.iterations,
        chi_square=fitted.cost,
        degrees_of_freedom=fitted.freedom,
        step_bias=fitted.step_bias,
        messages=(),
        errors=errors or chosen,
        reason=reason if errors is None else "as asked for",
        variance=variance,
        prior=tuple(experiment.prior),
        independent=Independent(
            information, variance, np.inf if noise == "given" else fitted.freedom
        ),
        clustered=compute_sandwich(fitted.by_trajectory, information, variance, prior_rows),
        correlated=compute_sandwich(fitted.by_time, information, variance, prior_rows),
        bootstrap=Bootstrap(
            problem,
            [part.longest_step for part in fitted.parts],
            jax.tree.map(lambda *each: np.concatenate(each), *(p.states for p in fitted.parts)),
            information,
            fitted.variance,
        ),
    )
    return replace(estimate, messages=tuple(find_messages(fitted, estimate, noise)))


def _fitted_parts(problem: FitProblem, fitted: Fitted) -> dict[str, FittedPart]:
    residuals = sum(r.size for part in fitted.parts for r in part.residuals.values())
    return {
        configuration.name: FittedPart(
            model=configuration.model_at(problem.parameters, problem.free, problem.free.theta),
            recordings=configuration.recordings,
            states=jax.device_put(part.states),
            residuals=part.residuals,
            predicted=part.predicted,
            left=fitted.freedom / residuals,
            own=configuration.own_of(part.states),
        )
        for configuration, part in zip(problem.configurations, fitted.parts, strict=True)
    }


def _require_options(
    experiment: Experiment,
    integrator: MoserVeselovIntegrator | None,
    segment: float | None,
    noise: Noise,
    errors: Errors | None,
    iterations: int,
) -> None:
    """Check what the two functions have in common."""
    if not isinstance(noise, str) or noise not in get_args(Noise):
        raise ValueError(f'Argument `noise` must be "residuals" or "given", but is {noise!r}.')
    models = [configuration.model for configuration in experiment.configurations]
    if noise == "given" and any(model.is_robust for model in models):
        raise ValueError(
            'Argument `noise` must be "residuals" with a robust loss, as that does not treat '
            "`sigma` as exact."
        )
    if errors is not None:
        require_errors(errors, [len(each.recordings) for each in experiment.configurations])
    if integrator is not None:
        require_scalar_step(integrator)
    if segment is not None and not (isinstance(segment, Real) and 0 < segment < np.inf):
        raise ValueError(f"Argument `segment` must be a time above 0 s, but is {segment!r}.")
    if not isinstance(iterations, Integral) or iterations < 1:
        raise ValueError(
            f"Argument `iterations` must be a whole number above 0, but is {iterations!r}."
        )
