"""The likelihood of recordings as a differentiable function, for any optimiser."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..modules.integrator import MoserVeselovIntegrator
from ..modules.sensors.base import loss_of
from .arguments import require_instance, require_states, scalar_step
from .data.recordings import Recordings
from .model.model import Model
from .model.states import InitialStates, state_leaves
from .model_checks import require_sensors
from .windows.grid import Windows, whole_trajectories
from .windows.layout import lay_out
from .windows.residuals import Residuals, SimulatedWindow, compute_residuals


def negative_log_likelihood(
    recordings: Recordings, integrator: MoserVeselovIntegrator
) -> Callable[[Model, InitialStates], Array]:
    r"""The negative logarithm of the likelihood, as a function of a model and initial states.

    It is $\sum \tfrac12\rho(|r|^2) + \sum\log\sigma + \text{const}$ over all readings, without
    constants; so that `sigma` can be learned too.

    Parameters
    ----------
    recordings
        What was recorded.
    integrator
        Its `order`, and in `dt`, s, the longest step, a scalar.

    Returns
    -------
    Callable
        A function of a [`Model`][lgvi.identification.Model] and
        [`InitialStates`][lgvi.identification.InitialStates], to be differentiated and compiled.
        Infinite where a step does not converge. Learn initial states by `states.moved(phi)`, where
        `phi` (trajectories, 6) begins as zeros, and has more columns where `states.own` has some.

    Raises
    ------
    ValueError
        For a `dt` that is not a scalar; and, when called, for sensors or states that do not fit the
        recordings.
    """
    require_instance("recordings", recordings, Recordings)
    longest_step = np.full(len(recordings), scalar_step(integrator))
    (layout,) = lay_out(recordings, [whole_trajectories(recordings)], longest_step)

    def value(model: Model, states: InitialStates) -> Array:
        require_sensors(model, recordings)
        require_states("states", states, model, recordings)
        total = jnp.zeros(())
        for group in layout.groups:
            windows = group.windows(np.arange(len(group)))
            total += _value(model, states.at(group.index), windows, integrator)
        return total

    return value


def _value(
    model: Model, states: InitialStates, windows: Windows, integrator: MoserVeselovIntegrator
) -> Array:
    total = jnp.zeros(())
    own = state_leaves(model)

    def compute(states: InitialStates, windows: Windows) -> tuple[Residuals, SimulatedWindow]:
        return compute_residuals(model, own, states, windows, integrator)

    residuals, motion = jax.vmap(compute)(states, windows)
    for channel, sensor in model.sensors.items():
        r = residuals[channel]
        s = jnp.sum(r * r, axis=-1)
        loss = loss_of(sensor)
        losses = s if loss is None else loss(s)
        noise = jnp.sum(jnp.broadcast_to(jnp.log(sensor.sigma), r.shape[-1:]))
        total += jnp.sum(jnp.where(windows.readings[channel].mask, losses / 2 + noise, 0))
    return jnp.where(jnp.all(motion.usable), total, jnp.inf)
