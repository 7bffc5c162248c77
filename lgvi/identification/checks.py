"""Checks of arguments of an identification, and whether a model fits recordings."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core.trajectory.translation import depends_on_velocity
from ..modules.arguments import require_instance
from ..modules.convergence_error import attitude_tolerance
from ..modules.forces.law import during
from ..modules.sensors.accelerometer import Accelerometer
from ..modules.sensors.position import PositionSensor
from ..modules.sensors.sensor import MotionState
from ..modules.torques.law import as_law
from ..modules.torques.potential import UniformGravity
from .data.recordings import Recordings
from .model.model import Model
from .model.states import InitialStates, state_leaves


def in_one_precision(parameters: Any) -> Any:
    """Parameters, such as a model, in the default precision.

    An estimate would be rounded to the precision of its leaf in each iteration.
    """
    floats, others = eqx.partition(parameters, is_float)
    dtype = jax.dtypes.canonicalize_dtype(float)
    floats = jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf).astype(dtype)), floats)
    return eqx.combine(floats, others)


def as_arrays(parameters: Any) -> Any:
    """Parameters with arrays for the floats in dictionaries and other containers.

    The floats of a module do not change: an Equinox module has arrays where it can be learned.
    """

    def is_module(node: Any) -> bool:
        return isinstance(node, eqx.Module)

    return jax.tree.map(
        lambda node: jnp.asarray(node) if isinstance(node, (float, np.floating)) else node,
        parameters,
        is_leaf=is_module,
    )


def is_float(leaf: Any) -> bool:
    """Whether a leaf is an array of real numbers."""
    return eqx.is_array(leaf) and jnp.issubdtype(leaf.dtype, jnp.floating)


def require_key(name: str, value: Any) -> None:
    """Check a random key of JAX: typed, or of the older kind, two integers."""
    typed = isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
    older = isinstance(value, (jax.Array, np.ndarray)) and value.dtype == np.uint32
    if not (typed and value.shape == ()) and not (older and value.shape == (2,)):
        raise TypeError(
            f"Argument `{name}` must be a random key, as `jax.random.key` makes it, but is "
            f"{value!r}."
        )


def require_parts(parts: Any) -> None:
    """Check the configurations of a joint fit."""
    if not isinstance(parts, Mapping) or not parts:
        raise TypeError(
            "Argument `parts` must be a mapping of names to pairs of a function, which gives a "
            f"`Model`, and recordings, with one at least, but is {parts!r}."
        )
    for name, part in parts.items():
        if not isinstance(name, str):
            raise TypeError(f"Argument `parts` must have names that are strings, but has {name!r}.")
        pair = part if isinstance(part, tuple) and len(part) == 2 else (None, None)
        if not callable(pair[0]) or not isinstance(pair[1], Recordings):
            raise TypeError(
                f"Argument `parts` must have a pair of a function and `Recordings` for each name, "
                f"but for {name!r} has {part!r}."
            )


def require_starts(
    starts: Mapping[str, InitialStates] | None, parts: Mapping[str, tuple[Model, Recordings]]
) -> list[InitialStates | None]:
    """The initial states of each configuration; None where `starts` has no states."""
    starts = {} if starts is None else starts
    if not isinstance(starts, Mapping):
        raise TypeError(
            "Argument `starts` must be a mapping of names of parts to initial states, but is "
            f"{starts!r}."
        )
    for name, states in starts.items():
        if name not in parts:
            raise ValueError(f"Argument `starts` must have names of parts, but has {name!r}.")
        require_states(f"starts[{name!r}]", states, *parts[name])
        require_rotations(f"starts[{name!r}]", states)
    return [starts.get(name) for name in parts]


def require_states(name: str, states: InitialStates, model: Model, recordings: Recordings) -> None:
    require_instance(name, states, InitialStates)
    count, shapes = len(recordings), (states.R.shape, states.omega.shape)
    if shapes != ((count, 3, 3), (count, 3)):
        raise ValueError(
            f"Argument `{name}` must have the states of {count} trajectories, but its shapes are "
            f"{shapes[0]} and {shapes[1]}."
        )
    if states.own is None:
        return
    selected, shape = state_leaves(model), np.shape(states.own)
    if selected is None:
        raise ValueError(
            f"Argument `{name}` must have None as `own`, as nothing in the model has a state, "
            f"but the shape of `own` is {shape}."
        )
    numbers = sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(model, selected)))
    if shape != (count, numbers):
        raise ValueError(
            f"Argument `{name}` must have `own` of shape {(count, numbers)}, the states of "
            "sensors, of rotors and of the centre of mass, or None, but its shape is "
            f"{shape}."
        )


def require_rotations(name: str, states: InitialStates) -> None:
    R = np.asarray(states.R, float)
    error = np.max(np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)))
    if not error <= attitude_tolerance(jax.dtypes.canonicalize_dtype(float)):
        raise ValueError(
            f"Argument `{name}` must have rotation matrices `R`, but R^T R - I has an entry of "
            f"{error:.2g}."
        )
    if not np.all(np.isfinite(states.omega)):
        raise ValueError(f"Argument `{name}` must have finite `omega`, but an entry is not.")
    if states.own is not None and not np.all(np.isfinite(states.own)):
        raise ValueError(f"Argument `{name}` must have finite `own`, but an entry is not.")


def require_model(model: Any, recordings: Recordings) -> None:
    """Check that a model fits recordings.

    Raises
    ------
    ValueError, TypeError
        If sensors and recorded channels differ, or a value is impossible.
    """
    require_sensors(model, recordings)
    _require_no_nan(model)
    _require_pivot(model)
    _require_forces(model, recordings)
    if model.torque is not None:
        _require_resolved_times(recordings)
    if not 0 < float(model.time_scale) < np.inf:
        raise ValueError(
            f"Argument `time_scale` must be above 0, but is {float(model.time_scale)}."
        )


def require_sensors(model: Model, recordings: Recordings) -> None:
    require_instance("model", model, Model)
    require_instance("recordings", recordings, Recordings)
    recorded, sensed = set(recordings.channels), set(model.sensors)
    for channel in sorted(recorded ^ sensed):
        have = "have" if channel in recorded else "do not have"
        raise ValueError(
            "Argument `model` must have a sensor for what was recorded and for nothing else, but "
            f"the recordings {have} `{channel}`."
        )
    _require_rotor(model, recordings)
    _require_rotors(model, recordings)


def require_noise(model: Model) -> None:
    for channel, sensor in model.sensors.items():
        if not np.all((sigma := np.asarray(sensor.sigma)) > 0):
            raise ValueError(
                "Argument `model` must have a `sigma` above 0 in each sensor, but that of "
                f"`{channel}` is {sigma}."
            )


def _require_no_nan(model: Model) -> None:
    for path, leaf in jax.tree_util.tree_leaves_with_path(eqx.filter(model, is_float)):
        if np.any(np.isnan(leaf)):
            name = jax.tree_util.keystr(path).removeprefix(".")
            raise ValueError(f"Argument `model` must have no NaN, but its `{name}` is {leaf}.")


def _require_pivot(model: Model) -> None:
    """Check that an accelerometer feels gravity where its weight turns the body about a pivot."""

    def is_weight(node: Any) -> bool:
        return isinstance(node, UniformGravity)

    # Also within sums and products of laws.
    if not any(map(is_weight, jax.tree.leaves(model.torque, is_leaf=is_weight))):
        return
    for channel, sensor in model.sensors.items():
        if isinstance(sensor, Accelerometer) and sensor.gravity is None:
            raise ValueError(
                "Argument `gravity` of the `Accelerometer` must be given, such as (0, 0, -9.81), "
                "where the model has a `UniformGravity`, as the body turns about a pivot and the "
                f"sensor feels gravity, but that of `{channel}` is None, which is free flight."
            )


def _require_forces(model: Model, recordings: Recordings) -> None:
    """Check that what sensors read of forces and of the centre of mass is in the model."""
    has_mass, moves = model.mass is not None, model.gravity is not None
    acts = None
    if model.rotors is not None:
        acts = "`rotors`"
    elif model.torque is not None and as_law("torque", model.torque).force_law is not None:
        acts = "a `torque` with a force"
    if moves and acts is not None and not has_mass:
        raise ValueError(
            f"Argument `mass` of the model must be given where it has {acts} and a `gravity`, as "
            "the force moves the centre of mass."
        )
    for channel, sensor in model.sensors.items():
        own_gravity = getattr(sensor, "gravity", None) is not None
        if isinstance(sensor, Accelerometer) and own_gravity and (has_mass or moves):
            raise ValueError(
                f"Argument `gravity` of the `Accelerometer` of `{channel}` must be None where the "
                "model has a `mass` or a `gravity`: it is that of a body about a pivot."
            )
        if isinstance(sensor, PositionSensor) and own_gravity and (has_mass or moves):
            raise ValueError(
                f"Argument `gravity` of the `PositionSensor` of `{channel}` must be None where the "
                "model has a `mass` or a `gravity`: give it as argument `gravity` of the model."
            )
        flies = isinstance(sensor, Accelerometer) and not own_gravity
        if (flies or isinstance(sensor, PositionSensor)) and acts is not None and not has_mass:
            raise ValueError(
                f"Argument `mass` of the model must be given where it has {acts}, as the sensor "
                f"of `{channel}` feels the force."
            )
        if not moves:
            _read_without_path(sensor)
    if model.force is not None:
        during(model.force, lambda: _ends(model, recordings), throw=True)
    law, zero = model.specific_force, jnp.zeros(3)
    if moves or law is None:
        return
    in_plane = 0.0 if model.rotors is None else np.asarray(model.rotors.in_plane_drag)

    def force(instant: tuple[Array, Array, Array], v: Array) -> Array:
        return law(*instant, v)

    instant = jnp.zeros(()), jnp.eye(3), zero
    if np.any(in_plane != 0) or depends_on_velocity(force, instant, zero):
        raise ValueError(
            "Argument `gravity` of the model must be given, such as (0, 0, -9.81), where a force "
            "depends on the velocity, but is None."
        )


def _ends(model: Model, recordings: Recordings) -> Array:
    """The first and the last time of all readings, s, as a force law gets them."""
    times = [t[[0, -1]] for t in map(recordings.times_of, recordings)]
    return jnp.asarray([np.min(times), np.max(times)]) * model.time_scale


def _read_without_path(sensor: Any) -> None:
    """Raise if a sensor reads the motion of the centre of mass."""

    def predict(zero: Array) -> Any:
        return sensor.predict(
            MotionState(zero[0], jnp.eye(3), zero, lambda: zero, zero[0], None, None, zero)
        )

    jax.eval_shape(predict, jnp.zeros(3))


def _require_rotor(model: Model, recordings: Recordings) -> None:
    """Check that a model has the axis of a rotor if and only if one column is recorded."""
    rotor, shape = recordings.rotor_momentum, model.rotor_inertia.shape
    wanted = (3,) if rotor is not None and rotor.shape == (1,) else ()
    if shape != wanted:
        columns = "one column" if wanted else "three columns, or is not recorded"
        raise ValueError(
            f"Argument `rotor_inertia` must have shape {wanted} where `rotor_momentum` has "
            f"{columns}, but its shape is {shape}."
        )
    if model.rotor_delay is None:
        return
    if rotor is None:
        raise ValueError(
            "Argument `rotor_delay` must be None where no `rotor_momentum` is recorded."
        )
    # Beyond the record, the momentum continues along a line, unlike that of a rotor.
    shortest = min(np.ptp(t) for t, _ in rotor)
    if not abs(delay := float(model.rotor_delay)) < shortest:
        raise ValueError(
            "Argument `rotor_delay` must be a time shorter than each record of `rotor_momentum`, "
            f"of which the shortest lasts {shortest:.6g} s, but is {delay} s."
        )


def _require_rotors(model: Model, recordings: Recordings) -> None:
    """Check that a model has the rotors whose speeds are recorded, and no other rotors."""
    rotors, speed = model.rotors, recordings.rotor_speed
    if (rotors is None) != (speed is None):
        was = "it is None" if rotors is None else "it is a `Multirotor`"
        raise ValueError(
            "Argument `rotors` of a model must be a `Multirotor` where `rotor_speed` is recorded, "
            f"and else None, but {was}, and `rotor_speed` is{' not' * (speed is None)} recorded."
        )
    if rotors is not None and speed is not None and speed.shape != (count := len(rotors.arms),):
        raise ValueError(
            f"Argument `rotors` of a model has {count} rotors, but `rotor_speed` has "
            f"{speed.shape[0]} columns."
        )


def _require_resolved_times(recordings: Recordings) -> None:
    dtype = jax.dtypes.canonicalize_dtype(float)
    for samples in recordings.channels.values():
        largest, shortest = 0.0, np.inf
        for t, _ in samples:
            largest = np.max(abs(t), initial=largest)
            shortest = np.min(np.diff(t), initial=shortest)
        if jnp.finfo(dtype).eps * largest > 0.01 * shortest:
            raise ValueError(
                f"Argument `recordings` has times up to {largest:g} s, which {dtype} does not tell "
                "apart for a torque law: subtract their start, or enable float64."
            )
