"""Recordings of simulated motion, to plan an experiment and to try an identification."""

import zlib
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PRNGKeyArray

from ..modules.arguments import require_instance
from ..modules.integrator import MoserVeselovIntegrator
from ..modules.sensors.sensor import MotionState
from .checks import (
    in_one_precision,
    require_key,
    require_model,
    require_rotations,
    require_states,
)
from .data.recordings import Recordings, stack_trajectories
from .data.sample_checks import as_times
from .model.configuration import ModelAt
from .model.model import Model
from .model.states import InitialStates, state_leaves
from .running.compilation import compiled
from .running.progress import show_progress
from .segments.chain import follow
from .segments.levels import choose_method, first_steps, mean_intervals, scalar_step
from .segments.segment import lay_out, whole_trajectories
from .start.measured import initial_rates

TURN_OF_STEP = 0.02  # rad, about
TURN_OF_ORDER_2 = 0.005  # rad, about: this changes the phase by a millionth
STEP_OF_LAG = 0.1  # of the lag of rotors, at most
MOST_REFINEMENTS = 4


@show_progress("simulate_recordings")
def simulate_recordings(
    model: Model,
    layout: Recordings | ArrayLike,
    states: InitialStates,
    integrator: MoserVeselovIntegrator | None = None,
    *,
    key: PRNGKeyArray | None = None,
) -> Recordings:
    """Simulated recordings by the sensors of a model.

    Parameters
    ----------
    model
        The body, what acts on it, and its sensors.
    layout
        Recordings, from which the times, torques, momenta and speeds of rotors are taken, but no
        readings. Or times (samples,), s, at which all sensors read all trajectories.
    states
        Initial states, at the first reading of each trajectory.
    integrator
        Its `order`, and in `dt`, s, the longest step. By default the body and its nutation by
        rotors together turn about 0.02 rad in a step; 0.005 rad where the order is 2: with recorded
        torques or rotors, and torques that are sampled or depend on the rate.
    key
        A JAX random key for the noise of the sensors. `None` is no noise.

    Returns
    -------
    Recordings
        The recordings.

    Raises
    ------
    ValueError, TypeError
        For arguments that do not fit together.
    RuntimeError
        If a step of the integrator does not converge.
    """
    require_instance("model", model, Model)
    require_instance("states", states, InitialStates)
    if states.omega.ndim != 2 or not len(states.omega):
        raise ValueError(
            "Argument `states` must have shapes (trajectories, 3, 3) and (trajectories, 3), with "
            f"a trajectory at least, but they are {states.R.shape} and {states.omega.shape}."
        )
    if not isinstance(layout, Recordings):
        layout = _at_times(as_times("layout", layout), model, len(states.omega))
    model = in_one_precision(model)
    require_model(model, layout)
    require_states("states", states, model, layout)
    require_rotations("states", states)
    if key is not None:
        require_key("key", key)
    if integrator is not None:
        scalar_step(integrator)
    by_rotors = _rates_by_rotors(model, layout)
    method = choose_method(model, layout, integrator)
    turn = TURN_OF_ORDER_2 if method.order == 2 else TURN_OF_STEP
    longest_step = first_steps(integrator, initial_rates(model, states) + by_rotors, turn)
    if integrator is None and model.rotors is not None and model.rotors.lag is not None:
        longest_step = np.minimum(longest_step, STEP_OF_LAG * float(model.rotors.lag))
    blank = _without_readings(layout, model)
    simulated = _simulated(model, blank, states, method, longest_step)
    for _ in range(MOST_REFINEMENTS if integrator is None else 0):
        longest_step = np.minimum(longest_step, mean_intervals(layout))
        finer = np.full(len(layout), 4.0)
        if simulated is not None:  # The body may turn faster than at the start.
            speeds = simulated.speeds + by_rotors
            finer = np.maximum(longest_step * speeds / turn, 1)
            if np.all(finer < 2):
                break
        longest_step = longest_step / finer
        simulated = _simulated(model, blank, states, method, longest_step)
    if simulated is None:
        raise RuntimeError("A step did not converge: the step is too long or the rates are wrong.")
    return _with_noise(model, blank, simulated.predicted, key)


def _rates_by_rotors(model: Model, layout: Recordings) -> np.ndarray:
    """About the fastest nutation that rotors cause (trajectories,), rad in a recorded second."""
    momenta, rotors = np.zeros(len(layout)), model.rotors
    if (recorded := layout.rotor_momentum) is not None:
        size = float(np.linalg.norm(np.asarray(model.rotor_inertia, float)))
        momenta += [size * _largest(values) for _, values in recorded]
    if rotors is not None and (recorded := layout.rotor_speed) is not None:
        unit_momenta = np.asarray(jax.vmap(rotors.momentum)(np.eye(len(rotors.arms))), float)
        momenta += [_largest(speeds @ unit_momenta) for _, speeds in recorded]
    if not momenta.any():
        return momenta
    smallest = np.linalg.eigvalsh(np.asarray(model.body.inertia, float))[0]
    return momenta / smallest * float(model.time_scale)


def _largest(vectors: np.ndarray) -> float:
    return np.max(np.linalg.norm(vectors, axis=1))


class _Simulated(NamedTuple):
    predicted: dict[str, np.ndarray]  # what the sensors read of all trajectories, without noise
    speeds: np.ndarray  # the largest turn of each trajectory in a recorded second, rad


def _simulated(
    model: Model,
    layout: Recordings,
    states: InitialStates,
    integrator: MoserVeselovIntegrator,
    longest_step: np.ndarray,
) -> _Simulated | None:
    """The simulated readings of sensors; None if a step does not converge."""
    (chains,) = lay_out(layout, [whole_trajectories(layout)], longest_step, model)
    nothing, dtype = jax.tree.map(lambda _: False, model), jax.dtypes.canonicalize_dtype(float)
    at = ModelAt(model, nothing, np.zeros(0), None, state_leaves(model))
    motion = follow(at, jax.tree.map(lambda x: np.asarray(x, dtype), states), chains, integrator)
    if not np.all(motion.usable):
        return None
    return _Simulated(motion.predicted, motion.speed * float(model.time_scale))


def _with_noise(
    model: Model, layout: Recordings, predicted: dict[str, np.ndarray], key: PRNGKeyArray | None
) -> Recordings:
    """Recordings of the predicted readings, with noise if there is a key.

    The noise of a reading depends on the name of the channel and the number of the trajectory, and
    not on other channels and trajectories.
    """
    trajectories = list(layout)
    for channel, sensor in model.sensors.items():
        samples, values = layout.channels[channel], predicted[channel].astype(float)
        if key is not None and len(values):
            axes, salt = len(sensor.axes), zlib.crc32(channel.encode())
            normal = [
                np.random.default_rng([*_seeds(key), salt, i]).normal(size=(count, axes))
                for i, count in enumerate(samples.count)
            ]
            values = _disturb(sensor, values, np.concatenate(normal))
        for trajectory, readings in zip(trajectories, samples.split(values), strict=True):
            trajectory[channel] = trajectory[channel][0], readings
    return stack_trajectories(trajectories, layout.names)


def _without_readings(layout: Recordings, model: Model) -> Recordings:
    """The recordings with zeros in the shapes of the readings of the sensors."""

    def read(sensor: Any) -> Array:
        zero = jnp.zeros(3)
        state = MotionState(0.0, jnp.eye(3), zero, lambda: zero, 0.0, zero, zero, zero)
        return sensor.predict(state)

    shapes = {
        channel: jax.eval_shape(partial(read, sensor)).shape
        for channel, sensor in model.sensors.items()
    }
    trajectories = [
        {
            name: (t, np.zeros((len(t), *shapes[name]))) if name in shapes else (t, values)
            for name, (t, values) in trajectory.items()
        }
        for trajectory in layout
    ]
    return stack_trajectories(trajectories, layout.names)


def _seeds(key: PRNGKeyArray) -> list[int]:
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    return np.ravel(jax.random.key_data(key) if typed else key).tolist()


def _disturb(sensor: Any, predicted: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Readings disturbed by noise (readings, m), in standard deviations."""
    # Lengths are powers of two, so that one program serves many lengths.
    count, dtype = len(predicted), jax.dtypes.canonicalize_dtype(float)
    index = np.arange(2 ** (count - 1).bit_length()) % count
    readings = _disturbed(sensor, predicted[index].astype(dtype), noise[index].astype(dtype))
    return np.asarray(readings, float)[:count]


@compiled("the noise of a sensor")
def _disturbed(sensor: Any, predicted: Array, noise: Array) -> Array:
    return jax.vmap(sensor.add_noise)(predicted, noise)


def _at_times(t: np.ndarray, model: Model, count: int) -> Recordings:
    """Recordings with times, but without readings."""
    trajectory = dict.fromkeys(model.sensors, (t, np.zeros((len(t), 0))))
    return stack_trajectories([trajectory] * count, tuple(map(str, range(count))))
