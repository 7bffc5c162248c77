"""The likelihood of recordings as a differentiable function, for any optimiser."""

from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..modules.arguments import require_instance
from ..modules.integrator import MoserVeselovIntegrator
from .checks import require_sensors, require_states
from .data.recordings import Recordings
from .model.model import Model
from .model.states import InitialStates, state_leaves
from .segments.levels import scalar_step
from .segments.segment import lay_out, whole_trajectories
from .segments.whole import Trajectories, simulate_costs


def negative_log_likelihood(
    recordings: Recordings, integrator: MoserVeselovIntegrator
) -> Callable[[Model, InitialStates], Array]:
    r"""The negative logarithm of the likelihood, as a function of a model and initial states.

    The value is $\sum \tfrac12\rho(|r|^2) + \sum\log\sigma + \text{const}$ over all readings,
    without constants, so that `sigma` can be learned too.

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
    method, windows = replace(integrator, throw=False), whole_trajectories(recordings)

    def value(model: Model, states: InitialStates) -> Array:
        require_sensors(model, recordings)
        require_states("states", states, model, recordings)
        (chains,) = lay_out(recordings, [windows], longest_step, model)
        trajectories = Trajectories.of(chains)
        own = state_leaves(model)
        total = jnp.sum(simulate_costs(model, own, states, trajectories, method)) / 2
        for channel, sensor in model.sensors.items():
            noise = jnp.sum(jnp.broadcast_to(jnp.log(sensor.sigma), (len(sensor.axes),)))
            total += int(np.sum(trajectories.segments.mask[channel])) * noise
        return total

    return value
