"""Whether a model goes with recordings, and has values that are possible."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..modules.sensors.accelerometer import Accelerometer
from ..modules.torques.potential import UniformGravity
from .arguments import is_float, require_instance
from .data.recordings import Recordings
from .model.model import Model


def require_model(model: Any, recordings: Recordings) -> None:
    """Check that a model goes with recordings.

    Raises
    ------
    ValueError, TypeError
        If sensors and recorded channels differ, or a value is not possible.
    """
    require_sensors(model, recordings)
    _require_no_nan(model)
    _require_pivot(model)
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


def _require_rotor(model: Model, recordings: Recordings) -> None:
    """Check that a model has the axis of a rotor of which one column is recorded, and no other."""
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
    # Beyond what is recorded, the momentum goes on along a line, which is no motion of a rotor.
    shortest = min(np.ptp(t) for t, _ in rotor)
    if not abs(delay := float(model.rotor_delay)) < shortest:
        raise ValueError(
            "Argument `rotor_delay` must be a time shorter than each record of `rotor_momentum`, "
            f"of which the shortest lasts {shortest:.6g} s, but is {delay} s."
        )


def _require_rotors(model: Model, recordings: Recordings) -> None:
    """Check that a model has the rotors whose speeds are recorded, and no others."""
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
