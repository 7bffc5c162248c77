"""Recordings of motion that is simulated: to plan an experiment, and to try an identification."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PRNGKeyArray

from ..core import so3
from ..core.kernels.vectors import matmul
from ..modules.body import AbstractRigidBody
from ..modules.integrator import MoserVeselovIntegrator
from ..modules.sensor import AttitudeSensor
from ..modules.torques.base import Torque
from .arguments import (
    Sensor,
    model_of,
    require_instance,
    require_rotations,
    require_scalar_step,
    require_states,
)
from .compilation import compiled
from .data.recordings import Recordings, stacked
from .data.samples import SENSED
from .model.model import Model
from .model.states import InitialStates
from .windows.batching import batch_size, in_batches
from .windows.grid import Windows, whole
from .windows.initial_guess import largest_rates
from .windows.layout import lay_out
from .windows.residuals import motion_at_readings
from .windows.step_size import intervals, method_for

TURN_OF_STEP = 0.02  # rad, about
MOST_REFINEMENTS = 4


def simulate_recordings(
    body: AbstractRigidBody,
    layout: Recordings | ArrayLike,
    sensors: Sensor | Sequence[Sensor],
    states: InitialStates,
    integrator: MoserVeselovIntegrator | None = None,
    *,
    torque: Torque | None = None,
    rotor_inertia: ArrayLike = 1.0,
    time_scale: ArrayLike = 1.0,
    key: PRNGKeyArray | None = None,
) -> Recordings:
    """What the sensors would record of a body.

    Parameters
    ----------
    body
        The body.
    layout
        Recordings of which the times, the recorded torques and rotor momenta are taken, and what
        was measured is not. Or times (samples,), s, at which all sensors read all trajectories.
    sensors
        As for [`identify`][lgvi.identification.identify].
    states
        Initial states, at the first sample of each trajectory.
    integrator
        Its `order`, and in `dt`, s, the longest step. By default the body turns about 0.02 rad in
        a step.
    torque, rotor_inertia, time_scale
        As for [`identify`][lgvi.identification.identify].
    key
        A JAX random key for the noise of the sensors. `None` is no noise.

    Returns
    -------
    Recordings
        The recordings.

    Raises
    ------
    ValueError, TypeError
        For arguments that do not go together.
    RuntimeError
        If a step of the integrator does not converge.
    """
    require_instance("states", states, InitialStates)
    if states.omega.ndim != 2:
        raise ValueError(
            "Argument `states` must have shapes (trajectories, 3, 3) and (trajectories, 3), but "
            f"they are {states.R.shape} and {states.omega.shape}."
        )
    if not isinstance(layout, Recordings):
        layout = _planned(np.asarray(layout), sensors, len(states.omega))
    model = model_of(body, layout, sensors, torque, rotor_inertia, time_scale)
    require_states("states", states, layout)
    require_rotations("states", states)
    if integrator is not None:
        require_scalar_step(integrator)
    scale = float(model.time_scale)
    speeds = np.linalg.norm(np.asarray(states.omega, float), axis=1) * scale
    method, longest_step = method_for(model, layout, integrator, speeds, TURN_OF_STEP)
    recordings = _simulated(model, layout, states, method, longest_step, key)
    for _ in range(MOST_REFINEMENTS if integrator is None else 0):
        longest_step = np.minimum(longest_step, intervals(layout))
        finer = np.full(len(layout), 4.0)
        if recordings is not None:  # What acts may have made it faster than it was at the start.
            finer = np.maximum(longest_step * largest_rates(recordings, scale) / TURN_OF_STEP, 1)
            if np.all(finer < 2):
                break
        longest_step = longest_step / finer
        recordings = _simulated(model, layout, states, method, longest_step, key)
    if recordings is None:
        raise RuntimeError("A step did not converge: the step is too long or the rates are wrong.")
    return recordings


def _simulated(
    model: Model,
    layout: Recordings,
    states: InitialStates,
    integrator: MoserVeselovIntegrator,
    longest_step: np.ndarray,
    key: PRNGKeyArray | None,
) -> Recordings | None:
    """Recordings, unless a step does not converge."""
    (laid_out,) = lay_out(layout, [whole(layout)], longest_step)
    dtype = jax.dtypes.canonicalize_dtype(float)
    # One program with and without noise.
    noise, key = np.asarray(key is not None, dtype), jax.random.key(0) if key is None else key
    given = InitialStates(*(np.asarray(x, dtype) for x in (states.R, states.omega)))

    def of_batch(given):
        states, windows, number = given
        return _seen(model, states, windows, number, integrator, key, noise, few=laid_out.few)

    trajectories = list(layout)
    for index, part in laid_out.parts:
        given_part = given.at(index), part, index.astype(np.uint32)
        batch = batch_size(part, columns=0)
        seen, converged = in_batches(of_batch, given_part, len(index), batch)
        if not np.all(converged):
            return None
        for kind, values in zip(SENSED, seen, strict=True):
            for i, row in zip(index, [] if values is None else values, strict=False):
                if (of_kind := trajectories[i][kind]) is not None:
                    t, _ = of_kind
                    trajectories[i][kind] = t, row[: len(t)].astype(float)
    return stacked(trajectories, layout.names)


@compiled
def _seen(
    model: Model,
    states: InitialStates,
    windows: Windows,
    number: Array,
    integrator: MoserVeselovIntegrator,
    key: PRNGKeyArray,
    noise: Array | np.ndarray,
) -> tuple[list[Array | None], Array]:
    """What each sensor reads (windows, readings, ...), and whether the steps converged (windows,).

    `noise` is 1, or 0 for none.
    """

    def of_window(state, window, number):
        own_key = jax.random.fold_in(key, number)
        motion = motion_at_readings(model, state, window, integrator)
        seen = []
        for sensor, at in zip(model.sensors, motion.sensed, strict=True):
            if sensor is None or at is None:
                seen.append(None)
                continue
            value = jax.vmap(sensor.predicted)(at)
            own_key, own = jax.random.split(own_key)
            normal = noise * jax.random.normal(own, (len(at), 3), at.dtype)
            error = jnp.broadcast_to(sensor.sigma, (1, 3)) * normal
            if isinstance(sensor, AttitudeSensor):
                value = matmul(value, jax.vmap(so3.exp)(error))
            else:
                value += error
            seen.append(value)
        return seen, motion.usable

    return jax.vmap(of_window)(states, windows, number)


def _planned(t: np.ndarray, sensors: Any, count: int) -> Recordings:
    """Recordings at some times, with nothing in them."""
    given = sensors if isinstance(sensors, Sequence) else (sensors,)
    values = {}
    for sensor in given:
        if isinstance(sensor, AttitudeSensor):
            values["attitude"] = np.tile(np.eye(3), (len(t), 1, 1))
        else:
            values["angular_velocity"] = np.zeros((len(t), 3))
    return Recordings.concatenate(
        Recordings.from_arrays(t, **values, name=str(i)) for i in range(count)
    )
