"""From recordings of several configurations to one estimate, by maximum likelihood."""

from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from typing import Any

import jax
from jax.sharding import Mesh

from ..modules.integrator import MoserVeselovIntegrator
from .arguments import as_arrays, in_one_precision, require_parts, require_starts
from .data.recordings import Recordings
from .error_kinds import Errors, Noise
from .estimate import JointEstimate
from .estimation import estimate_from
from .fit import Experiment
from .model.configuration import Configuration
from .model.model import Model
from .model.prior import Priors, as_priors
from .model.selection import Bound, Where, add_state_leaves, select_free_leaves, select_own_leaves
from .model.states import InitialStates
from .model_checks import require_model, require_noise

Parts = Mapping[str, tuple[Callable[[Any], Model], Recordings]]


def identify_jointly(
    parameters: Any,
    parts: Parts,
    integrator: MoserVeselovIntegrator | None = None,
    *,
    free: Where = lambda parameters: parameters,
    bounds: Sequence[Bound] = (),
    prior: Priors = (),
    own: Where | None = None,
    starts: Mapping[str, InitialStates] | None = None,
    segment: float | None = None,
    noise: Noise = "residuals",
    errors: Errors | None = None,
    iterations: int = 100,
    progress: bool | None = None,
    checkpoint: str | PathLike[str] | None = None,
    mesh: Mesh | None = None,
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
        [`PhysicalRigidBody`][lgvi.PhysicalRigidBody] for each inertia. Numbers must be floats, or
        arrays of floats; in a module of your own, arrays. All else is known.
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
        As for [`identify`][lgvi.identification.identify], a function of each model; it gives `()`
        where a model has no such leaves.
    integrator, bounds, prior, segment, noise, errors, iterations, progress, checkpoint, mesh
        As for [`identify`][lgvi.identification.identify], with functions of the parameters instead
        of the model.

    Returns
    -------
    JointEstimate
        The estimate. Whether the fit converged is in it, and what else went wrong in `messages` and
        `mistakes`.

    Warns
    -----
    UserWarning
        Before the fit, if the log seems to have a usual mistake.

    Raises
    ------
    ValueError, TypeError
        For arguments that do not go together, and functions that do not give a model.
    RuntimeError
        If the start cannot be simulated.
    KeyboardInterrupt
        If the user stops the fit, with the values that it had reached.
    ConnectionError
        If another process that fits together with this one has ended, with the values that the
        fit had reached.
    """
    parameters = in_one_precision(as_arrays(parameters))
    require_parts(parts)
    selected = select_free_leaves(parameters, free, bounds)
    configurations, own_leaves = [], []
    for name, (function, recordings) in parts.items():
        given = name, recordings, function, parameters, selected
        configuration = Configuration.of_function(*given)
        try:
            require_model(configuration.model, recordings)
            require_noise(configuration.model)
        except ValueError as error:
            raise ValueError(f"In the part {name!r}: {error}") from None
        given = configuration.model, configuration.selected
        try:
            chosen = None if own is None else select_own_leaves(own, *given)
            each = add_state_leaves(chosen, *given)
        except ValueError as error:
            raise ValueError(f"In the part {name!r}: {error}") from error
        own_leaves += jax.tree.leaves(chosen)
        configurations.append(configuration._replace(own=each))
    if any(each.own is not None for each in configurations):  # all have own leaves, or none
        nothing = [jax.tree.map(lambda _: False, each.model) for each in configurations]
        configurations = [
            each._replace(own=none) if each.own is None else each
            for each, none in zip(configurations, nothing, strict=True)
        ]
    if own is not None and not any(own_leaves):
        raise ValueError("Argument `own` must choose a leaf in one part at least.")
    states = require_starts(starts, {of.name: (of.model, of.recordings) for of in configurations})
    priors = as_priors(prior, parameters, selected)
    experiment = Experiment(
        parameters, selected, configurations, states, priors, noise_is_given=noise == "given"
    )
    options = integrator, segment, noise, errors, iterations, progress, checkpoint, mesh
    return estimate_from(JointEstimate, "identify_jointly", experiment, *options)
