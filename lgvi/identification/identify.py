"""From recordings of a body to an estimate of its model, by maximum likelihood."""

from __future__ import annotations  # so that `help` shows the short names of types

from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from typing import Any

import jax
from jax.sharding import Mesh

from ..modules.integrator import MoserVeselovIntegrator
from .checks import (
    as_arrays,
    in_one_precision,
    require_model,
    require_noise,
    require_parts,
    require_rotations,
    require_starts,
    require_states,
)
from .data.recordings import Recordings
from .estimate.estimate import Estimate, JointEstimate
from .estimate.estimation import estimate_from
from .fit.problem import Problem
from .model.configuration import Configuration
from .model.model import Model
from .model.prior import Priors, as_priors
from .model.selection import (
    Bound,
    Where,
    add_state_leaves,
    body_of,
    select_free_leaves,
    select_own_leaves,
)
from .model.states import InitialStates
from .uncertainty.posterior import Errors, Noise

# For each configuration by its name: the function that gives the model, and the recordings.
Parts = Mapping[str, tuple[Callable[[Any], Model], Recordings]]


def identify(
    model: Model,
    recordings: Recordings,
    integrator: MoserVeselovIntegrator | None = None,
    *,
    free: Where = body_of,
    bounds: Sequence[Bound] = (),
    prior: Priors = (),
    own: Where | None = None,
    start: InitialStates | None = None,
    segment: float | None = None,
    noise: Noise = "residuals",
    errors: Errors | None = None,
    iterations: int = 100,
    progress: bool | None = None,
    checkpoint: str | PathLike[str] | None = None,
    mesh: Mesh | None = None,
    check: bool = True,
) -> Estimate:
    r"""Estimate parameters of a body, what acts on it, and its sensors, from recordings.

    Maximum likelihood of the free leaves and of the initial state of each trajectory: the sum of
    the squared whitened residuals (or of their robust losses) is minimised by Levenberg and
    Marquardt's method with derivatives through the simulation. Initial states are eliminated
    trajectory by trajectory, so that thousands are no burden; of so many some are fitted first.
    Long trajectories are fitted in windows that grow from a radian to the whole. Where whole
    trajectories fit worse than short windows, the fit begins again from two other inertias, which
    tells a wrong minimum from a model that leaves something out; the best minimum is taken.

    Parameters
    ----------
    model
        The body from which the fit starts, a sensor for each channel of the recordings, and what
        acts on the body beside recorded torques: a [`Model`][lgvi.identification.Model]. Of the
        body nothing has to be known: `PhysicalRigidBody.from_principal_moments([1, 1, 1])` will
        do. If its inertia is free it must be a [`PhysicalRigidBody`][lgvi.PhysicalRigidBody], a
        [`KnownAxesRigidBody`][lgvi.KnownAxesRigidBody], or a module of your own whose every leaf
        gives a possible inertia.
    recordings
        The recordings. Torques, and momenta and speeds of rotors, are treated as exact.
    integrator
        Its `order`, and in `dt`, s, the longest step: intervals between samples are divided into
        equal steps. By default the order is the best for what acts, and the step is
        made so small that it moves the estimate by less than a tenth of the standard error; where
        that fails, a message says so.
    free
        Takes the nodes to estimate out of the model, such as
        `lambda model: (model.body, model.sensors["angular_velocity"].bias)`. By default the body's.
        `print(model)` lists all of them.
    bounds
        Triples of a function like `free`, a lower and an upper bound for its leaves: a number, or
        one for each number of the leaves, of which equal ones hold a number where it starts, such
        as `(lambda model: model.sensors["angular_velocity"].bias, [-1, 0, 0], [1, 0, 0])`. Those of
        a body are coordinates of its inertia and not moments. A leaf that ends at a bound is
        treated as known: its standard error is NaN, and those of the others hold for that value.
    prior
        What is known beforehand: triples of a function of the model, a mean and a standard
        deviation, in the shape of the function or one for all, such as
        `(lambda model: model.sensors["angular_velocity"].bias, 0.0, 0.02)`; or a mapping of names,
        which the report then has, to such triples. The errors are normal and independent of each
        other, so that a function of an inertia must give each product once. They count in the
        estimate and in its covariance.
    own
        Takes nodes out of the model, beside those that are free, which each trajectory has of its
        own, such as `lambda model: model.sensors["angular_velocity"].bias` for a bias that changes
        from one time that the gyroscope is switched on to the next. They are eliminated with the
        initial state, and found in `estimate.own`; `estimate.model` keeps the start of each.
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
        At most, of each minimisation: for each length of the windows, and again where a prior is
        weighed, gaps between segments close or the step gets shorter.
    progress
        Whether to show a progress bar (needs `tqdm`). By default it appears in a terminal or a
        notebook if the fit takes more than two seconds.
    checkpoint
        A file, such as `"fit.npz"`, in which the fit keeps where each iteration begins. Called
        again with the same arguments after it was stopped or killed, the function goes on from
        there. By default nothing is kept.
    mesh
        Devices, such as `jax.make_mesh((jax.device_count(),), ("windows",))`. Each simulates and
        differentiates a part of the trajectories. By default one device does. Devices of all
        processes of `jax.distributed` let these fit together: each process passes its own
        recordings, and all get the same estimate.
    check
        Whether a log with a usual mistake is refused: where another reading of it, such as another
        unit, fits more than a hundred times better, in squares. `False` fits it as it is, to the
        end.

    Returns
    -------
    Estimate
        The estimate. It says in `converged` whether the fit converged, and in `messages` and
        `mistakes` what else went wrong.

    Warns
    -----
    UserWarning
        Before the fit, if the log seems to have a usual mistake. Unless a leaf of a sensor is free,
        or `check=False`, the fit then stops after 10 iterations for each length of the windows. It
        does so too where no rigid body moves as recorded, which the verdict says.

    Raises
    ------
    ValueError, TypeError
        For arguments that do not go together, and, unless `check=False`, for a log that has a usual
        mistake, with the reading that fits better. So that a fit always ends: if a body turns by
        more than 20 rad from sample to sample and no `integrator` is given; or if the `dt` of one
        makes more than 1e8 steps of a trajectory.
    RuntimeError
        If the start cannot be simulated.
    KeyboardInterrupt
        If the user stops the fit, with the values that it had reached.
    ConnectionError
        If another process that fits together with this one has ended, with the values that the
        fit had reached.
    """
    model = in_one_precision(model)
    require_model(model, recordings)
    require_noise(model)
    selected = select_free_leaves(model, free, bounds)
    if start is not None:
        require_states("start", start, model, recordings)
        require_rotations("start", start)
    own_leaves = None if own is None else select_own_leaves(own, model, selected.selected)
    if own_leaves is not None and not any(jax.tree.leaves(own_leaves)):
        raise ValueError("Argument `own` must choose a floating-point leaf, but chooses none.")
    own_leaves = add_state_leaves(own_leaves, model, selected.selected)
    configuration = Configuration("", recordings, model, None, selected.selected, own_leaves)
    priors = as_priors(prior, model, selected)
    problem = Problem(
        model, selected, [configuration], [start], priors, noise_is_given=noise == "given"
    )
    options = integrator, segment, noise, errors, iterations, progress, checkpoint, mesh, check
    return estimate_from(Estimate, "identify", problem, *options)


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
    check: bool = True,
) -> JointEstimate:
    r"""Estimate parameters that several configurations share, from recordings of each.

    A configuration is a body as it flew: a device alone, with a proof body, with an object. The
    model of each is a function of the parameters, and all are fitted at once, so that the errors
    of a shared quantity, such as the inertia of a flywheel, are in the errors of all results. One
    configuration will do where the leaves of a model are tied, or follow from fewer parameters.

    Parameters
    ----------
    parameters
        The parameters, from which the fit starts: any pytree, such as a dictionary of bodies and
        numbers, or an Equinox module. Best a
        [`PhysicalRigidBody`][lgvi.PhysicalRigidBody] for each inertia. Numbers must be floats, or
        arrays of floats; in a module of your own, arrays. All other leaves are known.
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
    integrator, bounds, prior, segment, noise, errors, iterations, progress, checkpoint, mesh, check
        As for [`identify`][lgvi.identification.identify], with functions of the parameters instead
        of the model.

    Returns
    -------
    JointEstimate
        The estimate. It says in `converged` whether the fit converged, and in `messages` and
        `mistakes` what else went wrong.

    Warns
    -----
    UserWarning
        Before the fit, if the log seems to have a usual mistake.

    Raises
    ------
    ValueError, TypeError
        For arguments that do not go together, functions that do not give a model, and, unless
        `check=False`, for a log that has a usual mistake.
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
        configuration = Configuration.of_function(name, recordings, function, parameters, selected)
        try:
            require_model(configuration.model, recordings)
            require_noise(configuration.model)
        except ValueError as error:
            raise ValueError(f"In the part {name!r}: {error}") from None
        arguments = configuration.model, configuration.selected
        try:
            chosen = None if own is None else select_own_leaves(own, *arguments)
            with_states = add_state_leaves(chosen, *arguments)
        except ValueError as error:
            raise ValueError(f"In the part {name!r}: {error}") from error
        own_leaves += jax.tree.leaves(chosen)
        configurations.append(configuration._replace(own=with_states))
    if any(part.own is not None for part in configurations):  # then each has `own`
        no_leaves = [jax.tree.map(lambda _: False, part.model) for part in configurations]
        configurations = [
            part._replace(own=empty) if part.own is None else part
            for part, empty in zip(configurations, no_leaves, strict=True)
        ]
    if own is not None and not any(own_leaves):
        raise ValueError("Argument `own` must choose a leaf in one part at least.")
    pairs = {part.name: (part.model, part.recordings) for part in configurations}
    states = require_starts(starts, pairs)
    priors = as_priors(prior, parameters, selected)
    problem = Problem(
        parameters, selected, configurations, states, priors, noise_is_given=noise == "given"
    )
    options = integrator, segment, noise, errors, iterations, progress, checkpoint, mesh, check
    return estimate_from(JointEstimate, "identify_jointly", problem, *options)
