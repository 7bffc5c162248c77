"""A simulated window: what the sensors read of it, and the whitened residuals."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ...core.checks import as_floats
from ...core.kernels.interpolation import interpolate, line_at
from ...core.kernels.vectors import Mat3, matmul
from ...modules.body import AbstractRigidBody
from ...modules.gyrostat import Gyrostat
from ...modules.integrator import MoserVeselovIntegrator
from ...modules.sensors.base import MotionState, advance, require_shapes, time_offset_of
from ...modules.torques.base import AbstractTorque, Torque, TorqueSum, as_law, call
from ..model.free import put_own_leaves
from ..model.model import Model
from ..model.states import InitialStates, Numbers
from .grid import Windows

Predictions = dict[str, Array]  # (readings, ...), by channel
Residuals = dict[str, Array]  # (readings, m), whitened, by channel; zero where padded


class SimulatedWindow(NamedTuple):
    """A simulated window."""

    predicted: Predictions  # what the sensors read, without noise
    end: InitialStates  # the state at the end
    speed: Float[Array, ""]  # rad/s, the largest at the grid
    usable: Bool[Array, ""]  # whether all steps converged


def compute_residuals(
    model: Model,
    own: Any,
    state: InitialStates,
    window: Windows,
    integrator: MoserVeselovIntegrator,
) -> tuple[Residuals, SimulatedWindow]:
    """Residuals of one window, and its motion; raises as `simulate_readings`."""
    model = put_own_leaves(model, own, state.own)
    motion = simulate_readings(model, own, state, window, integrator)
    found = {}
    for channel, sensor in model.sensors.items():
        readings = window.readings[channel]
        measured = jnp.asarray(readings.value)
        r = jax.vmap(sensor.compute_residual)(motion.predicted[channel], measured)
        found[channel] = jnp.where(readings.mask[:, None], r, 0)
    return found, motion


class _States(NamedTuple):
    """States at some times of a window, and what acts there."""

    since: Array  # s, since the start of the window
    R: Array
    pi: Array
    rotor_momentum: Array
    body_torque: Numbers | None  # None also where it is a part of the law
    behind: Array | None = None  # of rotors, their commands


def simulate_readings(
    model: Model,
    own: Any,
    state: InitialStates,
    window: Windows,
    integrator: MoserVeselovIntegrator,
) -> SimulatedWindow:
    """The motion of one window, and what the sensors read of it without noise.

    `own` is a model of True where a leaf is in the state.

    Raises
    ------
    ValueError
        While tracing, if residuals or readings do not have the shapes that their sensor says.
    """
    model = put_own_leaves(model, own, state.own)
    along, start, usable, law, simulate = _simulate_grid(model, state, window, integrator)
    R, pi, rotor, dtype = along.R, along.pi, along.rotor_momentum, window.dt.dtype
    inverse = _inverse_inertia(model, window)
    usable, predicted = jnp.all(usable), {}
    for channel, sensor in model.sensors.items():
        at = window.readings[channel].index
        states = jax.tree.map(lambda x, at=at: x[at], along)
        if (offset := time_offset_of(sensor)) is not None:
            steps = jnp.asarray(offset, dtype) * window.parts
            states, converged = _later(simulate, start, states, along, steps)
            usable &= converged

        def read(state: _States, sensor=sensor):
            omega = matmul(inverse, state.pi - state.rotor_momentum)
            t = start + state.since
            rate = partial(_angular_acceleration, model.body, law, inverse, along, state, t, omega)
            return sensor.predict(MotionState(t, state.R, omega, rate, state.since))

        predicted[channel] = jax.vmap(read)(states)
        require_shapes(sensor, predicted[channel].shape[1:], dtype)
    after = _own_after(model, own, state, along, -1)
    end = InitialStates(R[-1], matmul(inverse, pi[-1] - rotor[-1]), after)
    omega = jax.vmap(matmul, (None, 0))(inverse, pi - rotor)
    speed = jnp.sqrt(jnp.max(jnp.sum(omega**2, axis=1)))
    return SimulatedWindow(predicted, end, speed, usable)


def simulate_states(
    model: Model,
    own: Any,
    state: InitialStates,
    window: Windows,
    nodes: Int[Array, " n"],
    integrator: MoserVeselovIntegrator,
) -> InitialStates:
    """The states (n, ...) at some nodes of the grid of one window."""
    model = put_own_leaves(model, own, state.own)
    grid = _simulate_grid(model, state, window, integrator)
    R, pi, rotor = (x[nodes] for x in (grid.along.R, grid.along.pi, grid.along.rotor_momentum))
    omega = jax.vmap(matmul, (None, 0))(_inverse_inertia(model, window), pi - rotor)
    after = jax.vmap(partial(_own_after, model, own, state, grid.along))(nodes)
    return InitialStates(R, omega, after)


def _own_after(
    model: Model, own: Any, state: InitialStates, along: "_States", node: int | Array
) -> Array | None:
    """The leaves that are in the state (m,) at a node, of a model with those of the start.

    Beyond `m` there may be padding, for configurations that have more.
    """
    if state.own is None:
        return None
    duration = along.since[node]
    sensors = {channel: advance(each, duration) for channel, each in model.sensors.items()}
    later = eqx.tree_at(lambda m: m.sensors, model, type(model.sensors)(sensors))
    if along.behind is not None:
        later = eqx.tree_at(lambda m: m.rotors.behind, later, along.behind[node])
    later = eqx.filter(later, own)
    leaves = [leaf.ravel().astype(state.own.dtype) for leaf in jax.tree.leaves(later)]
    return jnp.concatenate([*leaves, jnp.asarray(state.own)[sum(map(len, leaves)) :]])


class _Grid(NamedTuple):
    """A simulated window at all times of its grid."""

    along: _States
    start: Array  # s, of the window
    usable: Array  # whether its steps converged
    law: Torque | None
    simulate: Any  # a function of a state and what acts, as `_simulate`


def _simulate_grid(
    model: Model, state: InitialStates, window: Windows, integrator: MoserVeselovIntegrator
) -> _Grid:
    dt = model.time_scale.astype(window.dt.dtype) * window.dt
    since = jnp.concatenate([jnp.zeros(1, dt.dtype), jnp.cumsum(dt)])
    start = (model.time_scale * window.start).astype(dt.dtype)
    J = model.body.inertia.astype(dt.dtype)
    rotor, law, torque, behind = _rotor_momentum(model, window), model.torque, None, None
    if window.body_torque is not None:
        torque = jnp.asarray(window.body_torque)
    if model.rotors is not None:
        commands = jnp.asarray(window.rotor_speed)
        speeds = model.rotors.follow(commands, dt).astype(dt.dtype)
        behind = None if model.rotors.behind is None else commands - speeds
        of_rotors = jax.vmap(model.rotors.torque)(speeds).astype(dt.dtype)
        torque = of_rotors if torque is None else torque + of_rotors
        rotor += jax.vmap(model.rotors.momentum)(speeds).astype(dt.dtype)
    if law is not None and torque is not None:
        law, torque = TorqueSum((_Recorded(start + since, torque), law)), None
    has_rotor = window.rotor_momentum is not None or model.rotors is not None
    simulate = partial(_simulate, model.body, law, has_rotor, replace(integrator, throw=False))
    pi0 = matmul(J, jnp.asarray(state.omega)) + rotor[0]
    R, pi, usable = simulate(state.R, pi0, start + since, dt, torque, rotor)
    along = _States(since, R, pi, rotor, torque, behind)
    return _Grid(along, start, usable, law, simulate)


def _inverse_inertia(model: Model, window: Windows) -> Array:
    J = model.body.inertia.astype(window.dt.dtype)
    return Mat3.of(J / jnp.trace(J)).inverse().array() / jnp.trace(J)


def _rotor_momentum(model: Model, window: Windows) -> Array:
    """Momenta of rotors at the grid (states, 3)."""
    dtype = window.dt.dtype
    if window.rotor_momentum is None:
        return jnp.zeros((len(window.dt) + 1, 3), dtype)
    values = jnp.asarray(window.rotor_momentum)
    if model.rotor_delay is not None:
        recorded = jnp.concatenate([jnp.zeros(1, dtype), jnp.cumsum(window.dt)])
        before = recorded - model.rotor_delay.astype(dtype)
        values = jax.vmap(lambda t: line_at(recorded, values, t)[0])(before)
    inertia = model.rotor_inertia.astype(dtype)
    return inertia[None, :] * values if inertia.ndim else inertia * values


def _later(
    simulate, start: Array, states: _States, along: _States, steps: Array
) -> tuple[_States, Array]:
    """The states some more steps later, and whether these converged."""
    later = jnp.concatenate([jnp.zeros(1, steps.dtype), jnp.cumsum(steps)])
    since = states.since[:, None] + later[None, :]

    def at_times(function, values):
        return jax.vmap(jax.vmap(partial(function, along.since, values)))(since)

    # Beyond the window what acts on the body goes on: the torque, and that of the rotors.
    torque = along.body_torque
    torque = None if torque is None else at_times(interpolate, jnp.asarray(torque))
    rotor, _ = at_times(line_at, along.rotor_momentum)
    in_axes = (0, 0, 0, None, None if torque is None else 0, 0)
    R, pi, converged = jax.vmap(simulate, in_axes)(
        states.R, states.pi, start + since, steps, torque, rotor
    )
    last = jax.tree.map(lambda x: x[:, -1], _States(since, R, pi, rotor, torque))
    return last, jnp.all(converged)


def _angular_acceleration(
    body: AbstractRigidBody,
    law: Torque | None,
    inverse: Array,
    along: _States,
    state: _States,
    t: Array,
    omega: Array,
) -> Array:
    r"""$\dot\omega = J^{-1}(\pi \times \omega + \tau - \dot h)$ (3,), rad/s²."""
    rate = jnp.cross(state.pi, omega)
    if state.body_torque is not None:
        rate += state.body_torque
    if law is not None:
        torque = call(as_law("torque", law).of_body(body), t, state.R, omega)
        (torque,) = as_floats(**{"torque(t, R)": (torque, (3,))})
        rate += torque
    _, rotor_rate = line_at(along.since, along.rotor_momentum, state.since)
    return matmul(inverse, rate - rotor_rate)


class _Recorded(AbstractTorque):
    """Recorded torques at the times of a grid, of which some may be equal, linear between them."""

    t: Float[Array, " times"]
    torque: Float[Array, "times 3"]

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        return interpolate(self.t, self.torque, t)


def _simulate(body, law, has_rotor, integrator, R0, pi0, t, dt, body_torque, rotor):
    """Attitudes and momenta of one trajectory, and whether its steps converged."""
    if has_rotor:
        body = Gyrostat(body.inertia, (rotor[:-1] + rotor[1:]) / 2)
    result = replace(integrator, dt=dt).simulate(
        body, R0, pi0, torque=law, t0=t[0], body_torques=body_torque
    )
    return result.R, result.pi, result.solver_info.converged
