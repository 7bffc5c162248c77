"""A simulated window: what the sensors read of it, and the whitened residuals."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from ...core.kernels import vectors as xyz
from ...core.kernels.interpolation import interpolate, interval
from ...core.kernels.vectors import matmul
from ...modules.gyrostat import Gyrostat
from ...modules.integrator import MoserVeselovIntegrator
from ...modules.sensors.base import MotionState
from ...modules.torques.base import AbstractTorque, TorqueSum, as_law, call
from ..model.model import Model
from ..model.states import InitialStates, Numbers
from .grid import Windows

Readings = dict[str, Array]  # (readings, ...), by channel
Residuals = dict[str, Array]  # (readings, m), whitened, by channel; zero where padded


class SimulatedWindow(NamedTuple):
    """A simulated window."""

    predicted: Readings  # what the sensors read, without noise
    end: InitialStates  # the state at the end
    usable: Bool[Array, ""]  # whether all steps converged


def compute_residuals(
    model: Model, state: InitialStates, window: Windows, integrator: MoserVeselovIntegrator
) -> tuple[Residuals, SimulatedWindow]:
    """Residuals of one window, and its motion.

    Raises
    ------
    ValueError
        While tracing, if a residual does not have the shape that its sensor says.
    """
    motion = simulate_readings(model, state, window, integrator)
    found = {}
    for channel, sensor in model.sensors.items():
        readings = window.readings[channel]
        measured = jnp.asarray(readings.value)
        r = jax.vmap(sensor.compute_residual)(motion.predicted[channel], measured)
        if r.shape[1:] != (axes := (len(sensor.axes),)):
            raise ValueError(
                f"The residual of `{type(sensor).__name__}` must have shape {axes}, one number for "
                f"each of its `axes`, but its shape is {r.shape[1:]}."
            )
        found[channel] = jnp.where(readings.mask[:, None], r, 0)
    return found, motion


class _States(NamedTuple):
    """States at some times of a window, and what acts there."""

    since: Array  # s, since the start of the window
    R: Array
    pi: Array
    rotor_momentum: Array
    body_torque: Numbers | None


def simulate_readings(
    model: Model, state: InitialStates, window: Windows, integrator: MoserVeselovIntegrator
) -> SimulatedWindow:
    """The motion of one window, and what the sensors read of it without noise."""
    dt = model.time_scale.astype(window.dt.dtype) * window.dt
    since = jnp.concatenate([jnp.zeros(1, dt.dtype), jnp.cumsum(dt)])
    start = (model.time_scale * window.start).astype(dt.dtype)
    J = model.body.inertia.astype(dt.dtype)
    rotor = window.rotor_momentum
    rotor = jnp.zeros((len(since), 3), dt.dtype) if rotor is None else model.rotor_inertia * rotor
    simulate = partial(_simulate, model, replace(integrator, throw=False), window)
    pi0 = matmul(J, jnp.asarray(state.omega)) + rotor[0]
    R, pi, usable = simulate(state.R, pi0, start + since, dt, window.body_torque, rotor)
    along = _States(since, R, pi, rotor, window.body_torque)

    inverse = xyz.join_matrix(xyz.inverse(xyz.split_matrix(J / jnp.trace(J)))) / jnp.trace(J)
    usable, predicted = jnp.all(usable), {}
    for channel, sensor in model.sensors.items():
        at = window.readings[channel].index
        states = jax.tree.map(lambda x, at=at: x[at], along)
        if sensor.time_offset is not None:
            steps = sensor.time_offset.astype(dt.dtype) * window.parts
            states, converged = _later(simulate, start, states, along, steps)
            usable &= converged

        def read(state: _States, sensor=sensor):
            omega = matmul(inverse, state.pi - state.rotor_momentum)
            t = start + state.since
            rate = partial(_angular_acceleration, model, inverse, along, state, t, omega)
            return sensor.predict(MotionState(t, state.R, omega, rate))

        predicted[channel] = jax.vmap(read)(states)
    end = InitialStates(R[-1], matmul(inverse, pi[-1] - rotor[-1]))
    return SimulatedWindow(predicted, end, usable)


def _later(
    simulate, start: Array, states: _States, along: _States, steps: Array
) -> tuple[_States, Array]:
    """The states some more steps later, and whether these converged."""
    later = jnp.concatenate([jnp.zeros(1, steps.dtype), jnp.cumsum(steps)])
    since = states.since[:, None] + later[None, :]
    at_times = jax.vmap(jax.vmap(partial(interpolate, along.since), (None, 0)), (None, 0))
    torque = along.body_torque
    torque = None if torque is None else at_times(jnp.asarray(torque), since)
    rotor = at_times(along.rotor_momentum, since)
    in_axes = (0, 0, 0, None, None if torque is None else 0, 0)
    R, pi, converged = jax.vmap(simulate, in_axes)(
        states.R, states.pi, start + since, steps, torque, rotor
    )
    last = jax.tree.map(lambda x: x[:, -1], _States(since, R, pi, rotor, torque))
    return last, jnp.all(converged)


def _angular_acceleration(
    model: Model, inverse: Array, along: _States, state: _States, t: Array, omega: Array
) -> Array:
    r"""$\dot\omega = J^{-1}(\pi \times \omega + \tau - \dot h)$ (3,), rad/s²."""
    rate = jnp.cross(state.pi, omega)
    if state.body_torque is not None:
        rate += state.body_torque
    if model.torque is not None:
        rate += call(as_law("torque", model.torque).of_body(model.body), t, state.R, omega)
    i, length = interval(along.since, state.since)
    rotor = along.rotor_momentum
    return matmul(inverse, rate - (rotor[i + 1] - rotor[i]) / length)


class _Given(AbstractTorque):
    """Torques at the times of a grid, of which some may be equal, linear between them."""

    t: Float[Array, " times"]
    torque: Float[Array, "times 3"]

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        return interpolate(self.t, self.torque, t)


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
