"""Whitened residuals of windows, and the likelihood that they make."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from ...core.kernels import vectors as xyz
from ...core.kernels.vectors import matmul
from ...modules.gyrostat import Gyrostat
from ...modules.integrator import MoserVeselovIntegrator
from ...modules.sensor import AttitudeSensor, Gyroscope
from ...modules.torques.base import AbstractTorque, TorqueSum
from ..model.model import Model
from ..model.states import InitialStates, Numbers
from .grid import Readings, Windows


class Residuals(NamedTuple):
    """Whitened residuals (readings, 3) of each sensor, zero where padded."""

    attitude: Numbers | None
    angular_velocity: Numbers | None


class Motion(NamedTuple):
    """A simulated window."""

    sensed: tuple[Array | None, Array | None]  # attitudes and angular velocities at the readings
    end: InitialStates  # the state at the end
    usable: Bool[Array, ""]  # whether all steps converged


def residuals(
    model: Model, state: InitialStates, window: Windows, integrator: MoserVeselovIntegrator
) -> tuple[Residuals, Motion]:
    """Residuals of one window, and its motion."""
    motion = motion_at_readings(model, state, window, integrator)
    found = []
    for sensor, at, readings in zip(model.sensors, motion.sensed, window.readings, strict=True):
        if sensor is None or at is None or readings is None:
            found.append(None)
            continue
        whitened = jax.vmap(sensor.residual)(at, readings.value)
        found.append(jnp.where(readings.mask[:, None], whitened, 0))
    return Residuals(*found), motion


def motion_at_readings(
    model: Model, state: InitialStates, window: Windows, integrator: MoserVeselovIntegrator
) -> Motion:
    """The motion, with attitudes (readings, 3, 3) and angular velocities (readings, 3)."""
    dt = model.time_scale.astype(window.dt.dtype) * window.dt
    since = jnp.concatenate([jnp.zeros(1, dt.dtype), jnp.cumsum(dt)])
    start = (model.time_scale * window.start).astype(dt.dtype)
    J = model.body.inertia.astype(dt.dtype)
    rotor = window.rotor_momentum
    rotor = jnp.zeros((len(since), 3), dt.dtype) if rotor is None else model.rotor_inertia * rotor
    simulate = partial(_simulate, model, replace(integrator, throw=False), window)
    pi0 = matmul(J, jnp.asarray(state.omega)) + rotor[0]
    R, pi, converged = simulate(state.R, pi0, start + since, dt, window.body_torque, rotor)
    usable = jnp.all(converged)

    def of_sensor(sensor: AttitudeSensor | Gyroscope | None, readings: Readings | None):
        if sensor is None or readings is None:
            return None, True
        at = readings.index
        if sensor.time_offset is None:
            return (R[at], pi[at], rotor[at]), True
        # Some more steps, from the state at the time of the stamp.
        steps = sensor.time_offset.astype(dt.dtype) * window.parts
        later = jnp.concatenate([jnp.zeros(1, dt.dtype), jnp.cumsum(steps)])
        times = since[at][:, None] + later[None, :]
        at_times = jax.vmap(jax.vmap(partial(_interpolate, since), (None, 0)), (None, 0))
        torque = window.body_torque
        of_torque = None if torque is None else at_times(torque, times)
        of_rotor = at_times(rotor, times)
        in_axes = (0, 0, 0, None, None if of_torque is None else 0, 0)
        *moved, converged = jax.vmap(simulate, in_axes)(
            R[at], pi[at], start + times, steps, of_torque, of_rotor
        )
        return tuple(x[:, -1] for x in (*moved, of_rotor)), jnp.all(converged)

    (seen, usable_R), (felt, usable_omega) = map(of_sensor, model.sensors, window.readings)
    attitudes = None if seen is None else seen[0]
    inverse = xyz.join_matrix(xyz.inverse(xyz.split_matrix(J / jnp.trace(J)))) / jnp.trace(J)
    omegas = None if felt is None else matmul(felt[1] - felt[2], inverse.T)
    end = InitialStates(R[-1], matmul(inverse, pi[-1] - rotor[-1]))
    return Motion((attitudes, omegas), end, usable & usable_R & usable_omega)


class _Given(AbstractTorque):
    """Torques at the times of a grid, of which some may be equal, linear between them."""

    t: Float[Array, " times"]
    torque: Float[Array, "times 3"]

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        return _interpolate(self.t, self.torque, t)


def _simulate(model, integrator, window, R0, pi0, t, dt, body_torque, rotor):
    """Attitudes and momenta of one trajectory, and whether its steps converged."""
    body, law = model.body, model.torque
    if window.rotor_momentum is not None:
        body = Gyrostat(body.inertia, (rotor[:-1] + rotor[1:]) / 2)
    if body_torque is not None and law is not None:
        law, body_torque = TorqueSum((_Given(t, body_torque), law)), None
    result = replace(integrator, dt=dt).simulate(
        body, R0, pi0, torque=law, t0=t[0], body_torques=body_torque
    )
    return result.R, result.pi, result.solver_info.converged


def _interpolate(t, values, at):
    """A vector (3,), linear between (times, 3); times may be equal, where padded."""
    i = jnp.clip(jnp.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    length = t[i + 1] - t[i]
    part = jnp.clip((at - t[i]) / jnp.where(length != 0, length, 1), 0, 1)
    return values[i] + part * (values[i + 1] - values[i])
