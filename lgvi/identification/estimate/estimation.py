"""From a checked problem to its estimate: the fit, its errors, and the words about them."""

import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from numbers import Integral, Real
from os import PathLike
from typing import Any, TypeVar, get_args

import jax
import numpy as np
from jax.sharding import Mesh

from ...modules.integrator import MoserVeselovIntegrator
from ..diagnosis.log_mistakes import Mistake
from ..diagnosis.suspects import ScoreTests
from ..fit.bootstrap import Bootstrap
from ..fit.fit import fit
from ..fit.part import FittedPart, fitted_parts
from ..fit.problem import FitResult, Problem
from ..fit.profile import Profiles
from ..fit.sampler import Sampler
from ..model.configuration import Configuration
from ..model.model import Model
from ..running.compilation import as_mesh
from ..running.processes import ProcessGroup
from ..running.progress import Progress, show_progress
from ..segments.levels import scalar_step
from ..solver.checkpoint import Checkpoint, name_arguments, name_fit
from ..uncertainty.observability import LinearPosterior, describe, describe_unseen_turns
from ..uncertainty.posterior import Errors, Independent, Noise, choose_errors, require_errors
from ..uncertainty.sandwich import (
    LEAST_CLUSTERS,
    cluster_blocks,
    cluster_trajectories,
    compute_sandwich,
)
from .abstract_estimate import AbstractEstimate
from .wording import (
    find_messages,
    find_mistakes,
    find_reasons,
    find_unknown_torques,
    say_what_was_reached,
)

Kind = TypeVar("Kind", bound=AbstractEstimate)
CERTAIN = 100.0  # ratio of squares from which another reading of a log is the right one


def estimate_from(
    kind: type[Kind],
    door: str,
    problem: Problem,
    integrator: MoserVeselovIntegrator | None,
    segment: float | None,
    noise: Noise,
    errors: Errors | None,
    iterations: int,
    progress: bool | None,
    checkpoint: str | PathLike[str] | None,
    mesh: Mesh | None,
    check: bool,
) -> Kind:
    """The estimate of a problem; `door` is the name of the public function.

    Usual mistakes of a log are told before the fit, which a mistake may make long; all later errors
    begin with the mistakes.

    Raises
    ------
    ValueError, TypeError
        For options that do not go together, and for a log that is certainly mistaken.
    RuntimeError
        If the start cannot be simulated.
    KeyboardInterrupt, ConnectionError
        If the user stops the fit, or another process of the fit has ended.
    """
    saved, devices, processes = None, as_mesh(mesh), ProcessGroup.of(mesh)
    configurations = problem.configurations
    with processes.checked():
        _require_options(problem, integrator, segment, noise, iterations)
    arguments = {
        "free": problem.free._asdict(),
        "prior": problem.prior,
        "integrator": integrator,
        "segment": segment,
        "noise": noise,
        "iterations": iterations,
    }
    _require_agreement(
        processes, configurations, **arguments, errors=errors, checkpoint=checkpoint is not None
    )
    counts = [len(part.recordings) for part in configurations]
    trajectories = int(processes.sum(sum(counts)))
    if errors is not None:
        require_errors(errors, counts, trajectories)
    if checkpoint is not None:
        fit_name = name_fit(configurations, arguments, problem.starts, processes)
        with processes.checked():
            saved = Checkpoint(checkpoint, fit_name, processes)
    parts = {part.name: part for part in configurations}
    with processes.checked():
        mistakes, unknown = _look_at(parts)
        if check:
            _require_no_certain(mistakes)
    words = list(map(str, mistakes))
    for mistake in words:
        warnings.warn(f"The log has a usual mistake, it seems: {mistake}.", stacklevel=3)
    may_mend = any(map(_may_mend, configurations))
    is_in_vain = processes.any(check and bool(words or unknown) and not may_mend)
    with show_progress(door, show=progress) as report, _begins_with(words):
        problem = replace(
            problem,
            iterations=iterations,
            is_in_vain=is_in_vain,
            report=report,
            checkpoint=saved,
            mesh=devices,
            processes=processes,
        )
        try:
            result = fit(problem, integrator, segment)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(say_what_was_reached(problem, report, checkpoint)) from None
        except ConnectionError as error:
            reached = say_what_was_reached(problem, report, checkpoint)
            raise ConnectionError(f"{error} {reached}") from error
        if processes.any(any(map(_may_change_what_is_seen, configurations))):
            words = unknown = None  # the fitted leaves may have mended the mistakes
        return _estimate_of(kind, result, words, unknown, noise, errors, trajectories)


def _require_no_certain(mistakes: Sequence[Mistake]) -> None:
    """Check that no other reading of the log fits so much better that it is the right one."""
    if any(mistake.better >= CERTAIN for mistake in mistakes):
        raise ValueError(
            f"The log has a usual mistake: {'; '.join(map(str, mistakes))}. Read the log so; or "
            "`check=False` fits it as it is."
        )


@contextmanager
def _begins_with(mistakes: Sequence[str]) -> Iterator[None]:
    """Errors that begin with the mistakes that the log seems to have."""
    seems = f"The log has a usual mistake, it seems: {'; '.join(mistakes)}. "
    try:
        yield
    except (ValueError, RuntimeError, KeyboardInterrupt) as error:
        if not mistakes:
            raise
        kinds = ValueError, RuntimeError, KeyboardInterrupt
        kind = next(kind for kind in kinds if isinstance(error, kind))
        raise kind(f"{seems}{error}") from error


def _look_at(
    parts: Mapping[str, Configuration | FittedPart],
) -> tuple[list[Mistake], list[str]]:
    """Mistakes of the log, or unknown torques if there are no mistakes, in words."""
    mistakes = list(find_mistakes(parts))
    return mistakes, [] if mistakes else list(find_unknown_torques(parts))


def _may_mend(configuration: Configuration) -> bool:
    """Whether a leaf is fitted that may mend a mistake of the log."""
    selected = configuration.selected
    leaves = [selected.sensors, selected.time_scale, selected.rotor_inertia, selected.rotor_delay]
    if (rotors := selected.rotors) is not None:
        leaves += [rotors.arms, rotors.axes, rotors.thrust]
    return any(jax.tree.leaves(leaves)) or bool(np.any(~configuration.is_state))


def _may_change_what_is_seen(configuration: Configuration) -> bool:
    """Whether a leaf is fitted on which the mistakes of the log depend."""
    leaves = {field.name: getattr(configuration.selected, field.name) for field in fields(Model)}
    del leaves["body"], leaves["torque"]
    return any(jax.tree.leaves(leaves)) or bool(np.any(~configuration.is_state))


def _estimate_of(
    kind: type[Kind],
    result: FitResult,
    mistakes: Sequence[str] | None,
    unknown: Sequence[str] | None,
    noise: Noise,
    errors: Errors | None,
    trajectories: int,
) -> Kind:
    """The estimate of a fit; mistakes and unknown torques are searched again if they are None."""
    problem, processes = result.problem, result.problem.processes
    theta, variance = result.theta, result.noise_variance
    free = problem.free._replace(theta=theta)
    known = LinearPosterior(free, result.information, variance)
    has_own = any(np.any(~part.is_state) for part in problem.configurations)
    parameters = free.put(problem.parameters, theta)
    described = describe(parameters, known, result.start_as_good, has_own)
    information = described.information
    are_few = processes.sum(result.level.number) < LEAST_CLUSTERS
    problem = replace(
        problem,
        parameters=described.parameters,
        free=described.free,
        blocks=LEAST_CLUSTERS if are_few else 1,
        report=Progress(),
        checkpoint=None,
    )
    states = result.states.at(result.level.first_windows)
    parts = fitted_parts(problem, result)
    chosen, reason = choose_errors(trajectories, result.freedom, noise)
    axes, R = information.unseen_turn_axes, np.asarray(states.R)
    turns = processes.names(describe_unseen_turns(axes, R))
    described = described._replace(unobservable=(*described.unobservable, *dict.fromkeys(turns)))
    minimum = problem, result.level.longest_steps, states
    prior_rows = problem.prior_rows(described.free.theta)
    if mistakes is None or unknown is None:
        found, unknown = _look_at(parts)
        mistakes = list(map(str, found))
    mistakes, unknown = processes.names(mistakes), processes.names(unknown)
    reasons = dict.fromkeys([*unknown, *find_reasons(result, noise)])
    system, blocks = result.linearised.system, None
    if problem.blocks > 1:
        at = result.level, result.theta, result.states, result.gap_sigma
        blocks = replace(result.problem, blocks=problem.blocks).linearise(*at).blocks
    by_trajectory = cluster_trajectories(system, result.information)
    by_time = cluster_blocks(system, blocks, result.information, LEAST_CLUSTERS)
    estimate = kind(
        **described._asdict(),
        parts=parts,
        converged=result.converged,
        iterations=result.iterations,
        chi_square=result.linearised.residual_cost,
        degrees_of_freedom=result.freedom,
        step_bias=result.step_bias,
        messages=(),
        mistakes=tuple(dict.fromkeys(mistakes)),
        reasons=tuple(reasons),
        errors=errors or chosen,
        reason=reason if errors is None else "as asked for",
        variance=variance,
        prior=tuple(problem.prior),
        independent=Independent(
            information,
            variance,
            np.inf if noise == "given" else result.freedom,
            information.whiten(prior_rows[:, :-1]),
        ),
        clustered=compute_sandwich(by_trajectory, information, variance, prior_rows),
        correlated=compute_sandwich(by_time, information, variance, prior_rows),
        bootstrap=Bootstrap(*minimum, information, result.variance),
        score_tests=ScoreTests(*minimum, information, variance),
        sampler=Sampler(*minimum, information, variance),
        profiles=Profiles(*minimum, information, variance),
    )
    return replace(estimate, messages=tuple(find_messages(result, estimate, noise)))


def _require_agreement(
    processes: ProcessGroup, configurations: Sequence[Configuration], **options: Any
) -> None:
    """Check that all processes have one model and one set of options."""
    digests = {"the model or the channels": name_arguments(configurations)}
    digests |= {f"`{name}`": name_arguments((), option) for name, option in options.items()}
    counts = Counter(processes.names(map("=".join, digests.items())))
    differ = [name for name, code in digests.items() if counts[f"{name}={code}"] < processes.number]
    if differ:
        raise ValueError(
            "All processes of a fit must pass the same model and options, but they differ in "
            f"{', '.join(differ)}."
        )


def _require_options(
    problem: Problem,
    integrator: MoserVeselovIntegrator | None,
    segment: float | None,
    noise: Noise,
    iterations: int,
) -> None:
    """Check the options that both public functions have."""
    if not isinstance(noise, str) or noise not in get_args(Noise):
        raise ValueError(f'Argument `noise` must be "residuals" or "given", but is {noise!r}.')
    models = [configuration.model for configuration in problem.configurations]
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
