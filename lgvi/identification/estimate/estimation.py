"""From a checked experiment to its estimate: the fit, its errors, and what to say of it."""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from numbers import Integral, Real
from os import PathLike
from typing import Any, TypeVar, get_args

import jax
import numpy as np
from jax.sharding import Mesh

from ...modules.integrator import MoserVeselovIntegrator
from ..diagnosis.suspects import ScoreTests
from ..fit.bootstrap import Bootstrap
from ..fit.fit import Experiment, Fitted, fit
from ..fit.part import FittedPart, count_state
from ..fit.problem import FitProblem
from ..model.configuration import Configuration
from ..model.model import Model
from ..running.compilation import as_mesh
from ..running.processes import Together
from ..running.progress import Progress, show_progress
from ..segments.levels import scalar_step
from ..solver.checkpoint import Checkpoint, name_fit, name_given
from ..uncertainty.observability import Knowledge, describe, describe_unseen_turns
from ..uncertainty.posterior import Errors, Independent, Noise, choose_errors, require_errors
from ..uncertainty.sandwich import compute_sandwich
from .abstract_estimate import AbstractEstimate
from .wording import (
    find_messages,
    find_mistakes,
    find_reasons,
    find_unknown_torques,
    say_what_was_reached,
)

Kind = TypeVar("Kind", bound=AbstractEstimate)


def estimate_from(
    kind: type[Kind],
    door: str,
    experiment: Experiment,
    integrator: MoserVeselovIntegrator | None,
    segment: float | None,
    noise: Noise,
    errors: Errors | None,
    iterations: int,
    progress: bool | None,
    checkpoint: str | PathLike[str] | None,
    mesh: Mesh | None,
) -> Kind:
    """The estimate of an experiment, of such a kind, for a function of that name.

    Usual mistakes of a log are told before the fit, which may take long with one of them.

    Raises
    ------
    ValueError, TypeError
        For options that do not go together.
    RuntimeError
        If the start cannot be simulated.
    KeyboardInterrupt, ConnectionError
        If the user stops the fit, or another process of it has ended.
    """
    kept, devices, together = None, as_mesh(mesh), Together.of(mesh)
    configurations = experiment.configurations
    with together.checked():
        _require_options(experiment, integrator, segment, noise, iterations)
    given = {
        "free": experiment.free._asdict(),
        "prior": experiment.prior,
        "integrator": integrator,
        "segment": segment,
        "noise": noise,
        "iterations": iterations,
    }
    _require_agreement(
        together, configurations, **given, errors=errors, checkpoint=checkpoint is not None
    )
    counts = [len(each.recordings) for each in configurations]
    trajectories = int(together.sum(sum(counts)))
    if errors is not None:
        require_errors(errors, counts, trajectories)
    if checkpoint is not None:
        fit_name = name_fit(configurations, given, experiment.starts, together)
        with together.checked():
            kept = Checkpoint(checkpoint, fit_name, together)
    parts = {each.name: each for each in configurations}
    with together.checked():
        mistakes, unknown = _look_at(parts)
    for words in mistakes:
        warnings.warn(f"The log has a usual mistake, it seems: {words}.", stacklevel=3)
    may_mend = any(map(_may_mend, configurations))
    is_in_vain = together.any(bool(mistakes or unknown) and not may_mend)
    experiment = experiment._replace(is_in_vain=is_in_vain, mistakes=mistakes)
    with show_progress(door, show=progress) as report:
        try:
            options = integrator, segment, iterations, report, kept, devices, together
            fitted = fit(experiment, *options)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(say_what_was_reached(experiment, report, checkpoint)) from None
        except ConnectionError as error:
            reached = say_what_was_reached(experiment, report, checkpoint)
            raise ConnectionError(f"{error} {reached}") from error
        if together.any(any(map(_may_change_what_is_seen, configurations))):
            mistakes = unknown = None  # what is fitted by now may have mended them
        told = mistakes, unknown
        return _estimate_of(kind, experiment, fitted, *told, noise, errors, trajectories, together)


def _look_at(parts: Mapping[str, Configuration | FittedPart]) -> tuple[list[str], list[str]]:
    """Mistakes of the log, and where there are none, unknown torques, in words."""
    mistakes = list(find_mistakes(parts))
    return mistakes, [] if mistakes else list(find_unknown_torques(parts))


def _may_mend(configuration: Configuration) -> bool:
    """Whether a leaf is fitted with which a mistake of the log may mend itself."""
    selected = configuration.selected
    leaves = [selected.sensors, selected.time_scale, selected.rotor_inertia, selected.rotor_delay]
    if (rotors := selected.rotors) is not None:
        leaves += [rotors.arms, rotors.axes, rotors.thrust]
    return any(jax.tree.leaves(leaves)) or bool(np.any(~configuration.is_state))


def _may_change_what_is_seen(configuration: Configuration) -> bool:
    """Whether a leaf is fitted on which it depends what mistakes a log seems to have."""
    of = {field.name: getattr(configuration.selected, field.name) for field in fields(Model)}
    del of["body"], of["torque"]
    return any(jax.tree.leaves(of)) or bool(np.any(~configuration.is_state))


def _estimate_of(
    kind: type[Kind],
    experiment: Experiment,
    fitted: Fitted,
    mistakes: Sequence[str] | None,
    unknown: Sequence[str] | None,
    noise: Noise,
    errors: Errors | None,
    trajectories: int,
    together: Together,
) -> Kind:
    """What a fit tells; mistakes and unknown torques are as before the fit, or looked for again."""
    theta, variance = fitted.theta, 1.0 if noise == "given" else fitted.variance
    free = experiment.free._replace(theta=theta)
    known = Knowledge(free, fitted.information, variance)
    has_own = any(np.any(~each.is_state) for each in experiment.configurations)
    described = describe(free.put(experiment.parameters, theta), known, fitted.as_good, has_own)
    information = described.information
    problem = replace(
        fitted.problem,
        parameters=described.parameters,
        free=described.free,
        report=Progress(),
        checkpoint=None,
    )
    parts = _fitted_parts(problem, fitted)
    chosen, reason = choose_errors(trajectories, fitted.freedom, noise)
    states = jax.tree.map(lambda *each: np.concatenate(each), *(p.states for p in fitted.parts))
    turns = together.names(describe_unseen_turns(information.turns, states.R))
    described = described._replace(unobservable=(*described.unobservable, *dict.fromkeys(turns)))
    minimum = problem, [part.longest_step for part in fitted.parts], states
    prior_rows = problem.prior_rows(described.free.theta)
    if mistakes is None or unknown is None:
        mistakes, unknown = _look_at(parts)
    mistakes, unknown = together.names(mistakes), together.names(unknown)
    reasons = dict.fromkeys([*unknown, *find_reasons(fitted, noise)])
    estimate = kind(
        **described._asdict(),
        parts=parts,
        converged=fitted.converged,
        iterations=fitted.iterations,
        chi_square=fitted.cost,
        degrees_of_freedom=fitted.freedom,
        step_bias=fitted.step_bias,
        messages=(),
        mistakes=tuple(dict.fromkeys(mistakes)),
        reasons=tuple(reasons),
        errors=errors or chosen,
        reason=reason if errors is None else "as asked for",
        variance=variance,
        prior=tuple(experiment.prior),
        independent=Independent(
            information,
            variance,
            np.inf if noise == "given" else fitted.freedom,
            information.whiten(prior_rows[:, :-1]),
        ),
        clustered=compute_sandwich(fitted.by_trajectory, information, variance, prior_rows),
        correlated=compute_sandwich(fitted.by_time, information, variance, prior_rows),
        bootstrap=Bootstrap(*minimum, information, fitted.variance),
        score_tests=ScoreTests(
            *minimum,
            information,
            variance,
        ),
    )
    return replace(estimate, messages=tuple(find_messages(fitted, estimate, noise)))


def _fitted_parts(problem: FitProblem, fitted: Fitted) -> dict[str, FittedPart]:
    sizes = np.array([_count_residuals(each) for each in problem.configurations])
    unknowns = [
        (count_state(each.model) + len(each.own_start)) * len(each.recordings)
        for each in problem.configurations
    ]
    by_states = np.maximum(sizes - unknowns, 0)  # residuals that the initial states leave
    total = int(problem.together.sum(np.sum(by_states)))
    left = by_states * (fitted.freedom / max(1, total)) / sizes
    return {
        configuration.name: FittedPart(
            model=configuration.model_at(problem.parameters, problem.free, problem.free.theta),
            recordings=configuration.recordings,
            states=jax.device_put(configuration.initial_states(part.states)),
            summary=part.residuals,
            simulate=part.simulate,
            left=float(of_part),
            own=configuration.own_of(part.states),
        )
        for configuration, part, of_part in zip(
            problem.configurations, fitted.parts, left, strict=True
        )
    }


def _count_residuals(configuration: Configuration) -> int:
    channels = configuration.recordings.channels
    return sum(
        len(sensor.axes) * int(np.sum(channels[channel].count))
        for channel, sensor in configuration.model.sensors.items()
    )


def _require_agreement(
    together: Together, configurations: Sequence[Configuration], **options: Any
) -> None:
    """Check that all processes are given the same, but for recordings and initial states."""
    own = {"the model or the channels": name_given(configurations)}
    own |= {f"`{name}`": name_given((), option) for name, option in options.items()}
    given = Counter(together.names(map("=".join, own.items())))
    differ = [name for name, digest in own.items() if given[f"{name}={digest}"] < together.number]
    if differ:
        raise ValueError(
            "All processes of a fit must pass the same model and options, but they differ in "
            f"{', '.join(differ)}."
        )


def _require_options(
    experiment: Experiment,
    integrator: MoserVeselovIntegrator | None,
    segment: float | None,
    noise: Noise,
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
    if integrator is not None:
        scalar_step(integrator)
    if segment is not None and any(model.rotor_delay is not None for model in models):
        raise ValueError(
            "Argument `segment` must be None with a `rotor_delay`, as a segment does not know the "
            "rotor before it begins."
        )
    if segment is not None and not (isinstance(segment, Real) and 0 < segment < np.inf):
        raise ValueError(f"Argument `segment` must be a time above 0 s, but is {segment!r}.")
    if not isinstance(iterations, Integral) or iterations < 1:
        raise ValueError(
            f"Argument `iterations` must be a whole number above 0, but is {iterations!r}."
        )
