"""Recordings of motion that is simulated: to plan an experiment, and to try an identification."""

import zlib
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, ArrayLike, PRNGKeyArray

from ..modules.integrator import MoserVeselovIntegrator
from .arguments import (
    in_one_precision,
    require_instance,
    require_key,
    require_rotations,
    require_states,
    scalar_step,
)
from .compilation import compiled
from .data.checks import as_times
from .data.recordings import Recordings, stack_trajectories
from .model.model import Model
from .model.states import InitialStates, state_leaves
from .model_checks import require_model
from .progress import show_progress
from .windows.batching import batch_size, map_batches
from .windows.grid import Windows, whole_trajectories
from .windows.layout import lay_out
from .windows.measured import initial_rates
from .windows.residuals import simulate_readings
from .windows.step_size import choose_method, first_steps, mean_intervals

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
    """What the sensors of a model would record.

    Parameters
    ----------
    model
        The body, what acts on it, and its sensors.
    layout
        Recordings of which the times, and the recorded torques, momenta and speeds of rotors, are
        taken, and what was measured is not. Or times (samples,), s, at which all sensors read all
        trajectories.
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
        For arguments that do not go together.
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
    found = _simulated(model, layout, states, method, longest_step, key)
    for _ in range(MOST_REFINEMENTS if integrator is None else 0):
        longest_step = np.minimum(longest_step, mean_intervals(layout))
        finer = np.full(len(layout), 4.0)
        if found is not None:  # What acts may have made it faster than it was at the start.
            speeds = found.speeds + by_rotors
            finer = np.maximum(longest_step * speeds / turn, 1)
            if np.all(finer < 2):
                break
        longest_step = longest_step / finer
        found = _simulated(model, layout, states, method, longest_step, key)
    if found is None:
        raise RuntimeError("A step did not converge: the step is too long or the rates are wrong.")
    return found.recordings


def _rates_by_rotors(model: Model, layout: Recordings) -> np.ndarray:
    """About the fastest nutation that rotors cause (trajectories,), rad in a recorded second."""
    momenta, rotors = np.zeros(len(layout)), model.rotors
    if (recorded := layout.rotor_momentum) is not None:
        size = float(np.linalg.norm(np.asarray(model.rotor_inertia, float)))
        momenta += [size * _largest(values) for _, values in recorded]
    if rotors is not None and (recorded := layout.rotor_speed) is not None:
        of_each = np.asarray(jax.vmap(rotors.momentum)(np.eye(len(rotors.arms))), float)
        momenta += [_largest(speeds @ of_each) for _, speeds in recorded]
    if not momenta.any():
        return momenta
    smallest = np.linalg.eigvalsh(np.asarray(model.body.inertia, float))[0]
    return momenta / smallest * float(model.time_scale)


def _largest(vectors: np.ndarray) -> float:
    return np.max(np.linalg.norm(vectors, axis=1))


class _Simulated(NamedTuple):
    recordings: Recordings
    speeds: np.ndarray  # the largest turn of each trajectory in a recorded second, rad


def _simulated(
    model: Model,
    layout: Recordings,
    states: InitialStates,
    integrator: MoserVeselovIntegrator,
    longest_step: np.ndarray,
    key: PRNGKeyArray | None,
) -> _Simulated | None:
    """Recordings and speeds, unless a step does not converge."""
    (laid_out,) = lay_out(layout, [whole_trajectories(layout)], longest_step)
    dtype = jax.dtypes.canonicalize_dtype(float)
    # One program with and without noise.
    noise, key = np.asarray(key is not None, dtype), jax.random.key(0) if key is None else key
    given = jax.tree.map(lambda x: np.asarray(x, dtype), states)

    trajectories, speeds = list(layout), np.zeros(len(layout))
    for group in laid_out.groups:

        def of_batch(some, group=group):
            index = group.index[some]
            of_some = given.at(index), group.windows(some), index.astype(np.uint32)
            return _seen(model, *of_some, integrator, key, noise, few=laid_out.few)

        index, batch = group.index, batch_size(len(group), group.steps, columns=0)
        seen, speeds[index], converged = map_batches(of_batch, len(group), batch)
        if not np.all(converged):
            return None
        for channel, values in seen.items():
            for i, row in zip(index, values, strict=True):
                t, _ = trajectories[i][channel]
                trajectories[i][channel] = t, row[: len(t)].astype(float)
    recordings = stack_trajectories(trajectories, layout.names)
    return _Simulated(recordings, speeds * float(model.time_scale))


@compiled("a simulation")
def _seen(
    model: Model,
    states: InitialStates,
    windows: Windows,
    number: Array,
    integrator: MoserVeselovIntegrator,
    key: PRNGKeyArray,
    noise: Array,
) -> tuple[dict[str, Array], Array, Array]:
    """Readings (windows, readings, ...) by channel, largest speeds (windows,), and convergence.

    `noise` is 1, or 0 for none. The noise of a channel depends on its name, and not on what other
    channels there are.
    """
    own = state_leaves(model)

    def of_window(state, window, number):
        motion = simulate_readings(model, own, state, window, integrator)
        seen, of_trajectory = {}, jax.random.fold_in(key, number)
        for channel, sensor in model.sensors.items():
            of_channel = jax.random.fold_in(of_trajectory, zlib.crc32(channel.encode()))
            predicted = motion.predicted[channel]
            normal = jax.random.normal(
                of_channel, (len(predicted), len(sensor.axes)), window.dt.dtype
            )
            seen[channel] = jax.vmap(sensor.add_noise)(predicted, noise * normal)
        return seen, motion.speed, motion.usable

    return jax.vmap(of_window)(states, windows, number)


def _at_times(t: np.ndarray, model: Model, count: int) -> Recordings:
    """Recordings of which nothing but the times is known."""
    trajectory = dict.fromkeys(model.sensors, (t, np.zeros((len(t), 0))))
    return stack_trajectories([trajectory] * count, tuple(map(str, range(count))))
