"""What a manoeuvre would tell, and how much of each limit it takes, with the derivatives.

A manoeuvre of one trajectory is a vector: the angular rate at the start, and the commands at the
knots, one knot after another. JAX simulates it and differentiates what the sensors read with
respect to the free leaves and the initial state; and the result, and the use of each limit, with
respect to the manoeuvre. All derivatives are forward, so that one program has all of them.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...core import so3
from ...core.kernels.vectors import matmul
from ...modules.body import RigidBody
from ...modules.sensors.gyroscope import Gyroscope
from ...modules.torques.law import as_law, call
from ..model.free_leaves import put_leaves, put_own_leaves
from ..model.model import Model
from ..running.compilation import compiled
from ..segments.programs import Acting, Segment, acting_in, read_nodes
from .limits import Commands, Limits

FEWEST_STEPS = 24  # where there are more readings, steps stand for some of them
STEPS_OF_SPAN = 6  # at least, from knot to knot
TURN_OF_STEP = 0.2  # rad, at most, at the largest rate
LONG = 10_000  # steps, from which on optimised programs take less time than compiling them
LOST = 100.0  # use of limits by a motion that is not finite
WEAK = 1e-12  # relative information on an initial state that no reading tells
HAT = -np.cross(np.eye(3)[:, None], np.eye(3)[None])  # times a vector: its hat matrix


class Grid(NamedTuple):
    """The nodes of a trajectory, and how many readings each node stands for."""

    t: np.ndarray  # (nodes,), s
    counts: dict[str, np.ndarray]  # (nodes,), by channel
    knots: np.ndarray  # (knots,), s; empty without commands
    values: np.ndarray  # (nodes, knots), from commands at the knots to the nodes
    slopes: np.ndarray  # (nodes, knots), of the lines that end there, for each s

    @classmethod
    def of(cls, times: dict[str, np.ndarray], rate: float, commands: Commands | None) -> "Grid":
        """The nodes for the times of the readings of each channel.

        `rate` is the largest one, rad in a recorded second.
        """
        t, number = np.unique(np.concatenate(list(times.values()))), 0
        fewest = FEWEST_STEPS
        if commands is not None:  # rates are largest where commands have a corner
            number, spans = commands.knots, commands.knots - 1
            fewest = spans * max(STEPS_OF_SPAN, -(-FEWEST_STEPS // spans))
        even = np.linspace(t[0], t[-1], fewest + 1)
        if len(t) > fewest + 1:
            t = even
        elif number:
            t = np.unique(np.concatenate([t, even]))
        parts = np.maximum(np.ceil(np.diff(t) * rate / TURN_OF_STEP), 1).astype(int)
        first = np.repeat(np.cumsum(parts) - parts, parts)
        within = (np.arange(parts.sum()) - first) / np.repeat(parts, parts)
        steps = np.repeat(np.diff(t), parts)
        t = np.append(np.repeat(t[:-1], parts) + within * steps, t[-1])
        counts = {}
        for channel, readings in times.items():
            nearest = np.round(np.interp(readings, t, np.arange(len(t)))).astype(int)
            counts[channel] = np.bincount(nearest, minlength=len(t)).astype(float)
        knots = np.linspace(t[0], t[-1], number)
        hats = np.eye(number)
        values = np.stack([np.interp(t, knots, hat) for hat in hats], axis=1) if number else hats
        values = values.reshape(len(t), number)
        slopes = np.zeros_like(values)
        slopes[1:] = np.diff(values, axis=0) / np.diff(t)[:, None]
        slopes[0] = slopes[1]
        return cls(t, counts, knots, values, slopes)


class Experiment(NamedTuple):
    """What all manoeuvres have in common."""

    model: Model
    selected: Any  # a model of True where a leaf is free
    own: Any  # a model of True where a leaf is a state of a trajectory; None without any
    grid: Grid
    commands: Commands | None
    limits: dict[str, np.ndarray]

    @classmethod
    def of(
        cls,
        model: Model,
        selected: Any,
        own: Any,
        grid: Grid,
        commands: Commands | None,
        limits: Limits,
    ) -> "Experiment":
        sizes = {
            "rate": limits.rate,
            "saturation": limits.saturation,
            "turn": limits.turn,
            "travel": limits.travel,
        }
        known = {name: np.asarray(x, float) for name, x in sizes.items() if x is not None}
        if commands is not None and np.any(np.isfinite(commands.torque)):
            known["torque"] = commands.torque
        return cls(model, selected, own, grid, commands, known)


class Effects(NamedTuple):
    """What manoeuvres (manoeuvres, ...) would tell, and the changes for changes of each."""

    gram: np.ndarray  # (n, n), of the whitened Jacobian in the free leaves and the initial state
    gram_changes: np.ndarray  # (numbers, n, n)
    uses: dict[str, np.ndarray]  # (k,), of each limit: 1 at the limit
    uses_changes: dict[str, np.ndarray]  # (k, numbers)
    rates: np.ndarray  # (nodes, 3), rad/s

    def information(self, leaves: int) -> tuple[np.ndarray, np.ndarray]:
        """The information (p, p) on the free leaves, and its changes (numbers, p, p).

        Initial states are eliminated.
        """
        scale = np.sqrt(np.diagonal(self.gram, axis1=1, axis2=2))[:, leaves:]
        scale = np.where(scale > 0, scale, 1)
        with_states = self.gram[:, :leaves, leaves:] / scale[:, None]
        of_states = self.gram[:, leaves:, leaves:] / (scale[:, :, None] * scale[:, None])
        of_states += WEAK * np.eye(scale.shape[1])
        eliminate = np.swapaxes(np.linalg.solve(of_states, np.swapaxes(with_states, 1, 2)), 1, 2)
        eliminate = eliminate / scale[:, None]
        identity = np.broadcast_to(np.eye(leaves), (len(scale), leaves, leaves))
        project = np.concatenate([identity, -eliminate], axis=2)
        information = project @ self.gram @ np.swapaxes(project, 1, 2)
        changes = project[:, None] @ self.gram_changes @ np.swapaxes(project, 1, 2)[:, None]
        return information, changes


def differentiate_manoeuvres(
    experiment: Experiment,
    theta: np.ndarray,
    R: np.ndarray,
    own: np.ndarray,
    manoeuvres: np.ndarray,
) -> Effects:
    """The effects of manoeuvres (manoeuvres, numbers) from attitudes, for values of the leaves."""
    dtype = jax.dtypes.canonicalize_dtype(float)
    experiment = jax.tree.map(
        lambda x: x.astype(dtype) if isinstance(x, np.ndarray) else x, experiment
    )
    arrays = [x.astype(dtype) for x in (theta, R, own, manoeuvres)]
    # The steps of the simulations of all derivatives.
    steps = len(experiment.grid.t) * manoeuvres.size * (theta.shape[1] + 6 + own.shape[1])
    results = _differentiated(experiment, *arrays, optimised=steps > LONG)
    (rows, uses, rates), (rows_changes, uses_changes, _) = jax.tree.map(np.asarray, results)
    gram, changes = np.zeros(()), np.zeros(())
    for channel, x in rows.items():
        columns = x.reshape(*x.shape[:2], -1).astype(float)
        moved = rows_changes[channel].reshape(*x.shape[:1], -1, *columns.shape[1:]).astype(float)
        gram = gram + columns @ np.swapaxes(columns, 1, 2)
        half = moved @ np.swapaxes(columns, 1, 2)[:, None]
        changes = changes + half + np.swapaxes(half, 2, 3)
    uses, uses_changes = (
        {name: x.astype(float) for name, x in tree.items()} for tree in (uses, uses_changes)
    )
    uses_changes = {name: np.moveaxis(x, 1, 2) for name, x in uses_changes.items()}
    parts = gram, changes, *uses.values(), *uses_changes.values()
    finite = np.all([np.isfinite(x).reshape(len(x), -1).all(1) for x in parts], axis=0)
    if not finite.all():  # motions that are lost tell nothing, and are far beyond all limits
        for x in (gram, changes, *uses_changes.values()):
            x[~finite] = 0
        for x in uses.values():
            x[~finite] = LOST
    return Effects(gram, changes, uses, uses_changes, rates)


@compiled("the information of a manoeuvre")
def _differentiated(
    experiment: Experiment, theta: Array, R: Array, own: Array, manoeuvres: Array
) -> Any:
    """Columns of the Jacobian, uses of limits and angular velocities, and their changes."""

    def of_manoeuvre(theta: Array, R: Array, own: Array, manoeuvre: Array) -> Any:
        def effects(manoeuvre: Array) -> Any:
            return _effects(experiment, theta, R, own, manoeuvre)

        def along(direction: Array) -> Any:
            return jax.jvp(effects, (manoeuvre,), (direction,))

        directions = jnp.eye(len(manoeuvre), dtype=manoeuvre.dtype)
        return jax.vmap(along, out_axes=(None, 0))(directions)

    return jax.vmap(of_manoeuvre)(*map(jnp.asarray, (theta, R, own, manoeuvres)))


def _effects(experiment: Experiment, theta: Array, R: Array, own: Array, manoeuvre: Array) -> Any:
    model, selected = experiment.model, experiment.selected
    grid, commands, dtype = experiment.grid, experiment.commands, manoeuvre.dtype
    inputs, rates, speeds = {}, {}, None
    if commands is not None:
        at_knots = manoeuvre[3:].reshape(commands.knots, -1)
        speeds = jnp.asarray(grid.values) @ at_knots
        inputs[commands.quantity] = speeds @ jnp.asarray(commands.to_quantity)
        rates[commands.quantity] = jnp.asarray(grid.slopes) @ at_knots @ commands.to_quantity
    segment = Segment(grid.t[0], jnp.diff(grid.t), {}, {}, inputs, rates)
    p = len(theta)

    def move(unknown: Array) -> tuple[dict[str, Array], Any]:
        turn, rate, states = unknown[p : p + 3], unknown[p + 3 : p + 6], unknown[p + 6 :]
        moved = put_leaves(model, selected, unknown[:p])
        if experiment.own is not None:
            moved = put_own_leaves(moved, experiment.own, states)
        start, acting = matmul(R, so3.exp(turn)), acting_in(moved, segment)
        motion = _move(moved, start, manoeuvre[:3] + rate, acting)
        return read_nodes(moved, acting, *motion)

    unknown = jnp.concatenate([theta, jnp.zeros(6, dtype), own])

    def column(direction: Array) -> Any:
        """A column of the Jacobian of all whitened residuals; what is read; the motion."""
        (read, nodes), (change, _) = jax.jvp(move, (unknown,), (direction,))
        rows = {}
        for channel, sensor in model.sensors.items():

            def residual(at: Array, change: Array, sensor: Any = sensor) -> Array:
                return jax.jvp(lambda x: sensor.compute_residual(x, at), (at,), (change,))[1]

            weight = jnp.sqrt(jnp.asarray(grid.counts[channel]))
            rows[channel] = weight[:, None] * jax.vmap(residual)(read[channel], change[channel])
        return rows, (read, nodes)

    rows, (read, nodes) = jax.vmap(column, out_axes=(0, None))(jnp.eye(len(unknown), dtype=dtype))
    return rows, _uses(experiment, read, nodes, speeds), nodes.omega


def _move(model: Model, R: Array, omega: Array, acting: Acting) -> tuple[Array, Array]:
    """Attitudes and momenta at the nodes, by Runge and Kutta's method of order 4.

    A search needs the motion to a thousandth, and this step is compiled in half of the time of that
    of the integrator. What a plan promises is computed by the integrator.
    """
    J = model.body.inertia.astype(R.dtype)
    inverse, law = jnp.linalg.inv(J), None
    if model.torque is not None:
        law = as_law("torque", model.torque).of_body(RigidBody(J))

    def slope(state: tuple[Array, Array], acts: Any) -> tuple[Array, Array]:
        (R, pi), (t, rho, tau) = state, acts
        omega = matmul(inverse, pi - rho)
        if law is not None:
            tau = tau + jnp.asarray(call(law, t, R, omega)).astype(R.dtype)
        hat = matmul(jnp.asarray(HAT, R.dtype), omega)
        return matmul(R, hat), tau - matmul(hat, pi)

    def step(state: Any, part: Any) -> Any:
        h, begin, end = part
        middle = jax.tree.map(lambda x, y: (x + y) / 2, begin, end)

        def along(size: Array, slope: Any) -> Any:
            return jax.tree.map(lambda x, dx: x + size * dx, state, slope)

        first = slope(state, begin)
        second = slope(along(h / 2, first), middle)
        third = slope(along(h / 2, second), middle)
        fourth = slope(along(h, third), end)
        mean = jax.tree.map(
            lambda a, b, c, d: (a + 2 * (b + c) + d) / 6, first, second, third, fourth
        )
        return along(h, mean), state

    acts = acting.t, acting.rho, acting.tau
    begins, ends = (jax.tree.map(lambda x, at=at: x[at], acts) for at in (np.s_[:-1], np.s_[1:]))
    start = R, matmul(J, omega) + acting.rho[0]
    last, states = jax.lax.scan(step, start, (acting.h, begins, ends))
    return jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), states, last)


def _uses(
    experiment: Experiment, read: dict[str, Array], nodes: Any, speeds: Array | None
) -> dict[str, Array]:
    """How much of each limit is taken at the nodes (k,): the squares of parts of the limits."""
    limits, uses = experiment.limits, {}
    uses["rate"] = jnp.sum(nodes.omega**2, axis=1) / limits["rate"] ** 2
    if "saturation" in limits:
        readings = [
            read[channel]
            for channel, sensor in experiment.model.sensors.items()
            if isinstance(sensor, Gyroscope)
        ]
        parts = jnp.concatenate(readings) / jnp.broadcast_to(limits["saturation"], 3)[None]
        uses["saturation"] = parts.ravel() ** 2
    if "turn" in limits:
        traces = jnp.sum(nodes.R * nodes.R[:1], axis=(1, 2))
        uses["turn"] = (3 - traces) / 2 / (1 - jnp.cos(limits["turn"]))
    if "travel" in limits:
        uses["travel"] = jnp.sum((nodes.x - nodes.x[:1]) ** 2, axis=1) / limits["travel"] ** 2
    if "torque" in limits and experiment.commands is not None and speeds is not None:
        momentum, dt = jnp.asarray(experiment.commands.momentum), jnp.diff(nodes.t)
        sizes = jnp.sqrt(jnp.sum(momentum**2, axis=1))
        spins = sizes[None] * speeds + matmul(nodes.omega, momentum.T)
        torques = jnp.diff(spins, axis=0) / dt[:, None]
        uses["torque"] = (torques / limits["torque"][None]).ravel() ** 2
    return uses
