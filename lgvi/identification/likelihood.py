"""The likelihood of recordings as a differentiable function, for any optimiser."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core.kernels.interpolation import interpolate, line_at
from ..modules.arguments import require_instance
from ..modules.integrator import MoserVeselovIntegrator
from .checks import require_sensors, require_states
from .data.formats import INPUTS
from .data.recordings import Recordings
from .model.free_leaves import put_own_leaves
from .model.model import Model
from .model.states import InitialStates, state_leaves
from .segments.levels import scalar_step
from .segments.programs import Segment, simulate_segment
from .segments.segment import Chains, Table, lay_out, whole_trajectories


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
        return _value(model, states, _Trajectories.of(chains), method)

    return value


class _Trajectories(NamedTuple):
    """Segments in sequence (positions, trajectories, ...), and the shifts of their nodes."""

    segments: Segment
    clocks: dict[str, np.ndarray]  # (..., nodes), shift of the time of a node for each s
    recorded: dict[str, tuple[np.ndarray, np.ndarray]]  # (trajectories, samples, ...)

    @classmethod
    def of(cls, chains: Chains) -> "_Trajectories":
        """The segments of whole trajectories."""
        # With no clock late, and with each of them, but that of the recordings, late by one.
        late = np.diag(np.append(0.0, np.ones(len(chains.channels))))
        tables = [chains.table(clocks) for clocks in late]
        counts, first = tables[0].counts, tables[0].first
        position = np.arange(int(counts.max()))[:, None]
        index, real = first + np.minimum(position, counts - 1), position < counts

        def in_turn(x: np.ndarray) -> np.ndarray:
            x = x[index]
            return np.where(real.reshape(*real.shape, *[1] * (x.ndim - 2)), x, 0 * x)

        def nodes(table: Table) -> np.ndarray:
            dt = in_turn(table.segments.dt)
            return table.segments.start[index][..., None] + np.cumsum(
                np.pad(dt, ((0, 0), (0, 0), (1, 0))), axis=-1
            )

        still = tables[0].segments
        segments = Segment(
            still.start[index],
            in_turn(still.dt),
            {channel: values[index] for channel, values in still.readings.items()},
            {channel: mask[index] & real[..., None] for channel, mask in still.mask.items()},
            {},
            {},
        )
        moved = {
            channel: nodes(table) - nodes(tables[0])
            for channel, table in zip(chains.channels, tables[1:], strict=True)
        }
        recorded = {
            name: (samples.t, samples.value)
            for name, samples in chains.recordings.quantities.items()
            if name in INPUTS
        }
        return cls(segments, moved, recorded)


def _value(
    model: Model,
    states: InitialStates,
    trajectories: _Trajectories,
    method: MoserVeselovIntegrator,
) -> Array:
    segments, dtype = trajectories.segments, trajectories.segments.dt.dtype
    own, masks = state_leaves(model), segments.mask
    t = jnp.asarray(segments.start)[..., None] + jnp.cumsum(
        jnp.pad(jnp.asarray(segments.dt), ((0, 0), (0, 0), (1, 0))), axis=-1
    )
    for channel, moved in trajectories.clocks.items():
        offset = model.sensors[channel].time_offset / model.time_scale
        t = t + offset.astype(dtype) * jnp.asarray(moved)
    inputs, rates = {}, {}
    for name, (times, values) in trajectories.recorded.items():
        is_line, at = name == "rotor_momentum", t
        if is_line and model.rotor_delay is not None:
            at = t - model.rotor_delay.astype(dtype)
        inputs[name], rates[name] = _acting_at(at, times, values, is_line)
    segments = segments._replace(
        start=t[..., 0], dt=jnp.diff(t, axis=-1), inputs=inputs, rates=rates
    )

    def advance(state: tuple[Array, Array, Array | None], segments: Segment) -> Any:
        def follow(R, omega, leaves, segment):
            end = simulate_segment(method, put_own_leaves(model, own, leaves), R, omega, segment)
            after = None if leaves is None else end.own
            return (end.R, end.omega, after), (end.cost, end.usable)

        return jax.vmap(follow)(*state, segments)

    first = None if own is None else states.own
    if own is not None and first is None:
        leaves = jnp.concatenate([x.ravel() for x in jax.tree.leaves(eqx.filter(model, own))])
        first = jnp.broadcast_to(leaves, (len(states.omega), len(leaves)))
    state = jax.tree.map(jnp.asarray, (states.R, states.omega, first))
    _, (cost, usable) = jax.lax.scan(advance, state, segments)
    total = jnp.sum(cost) / 2
    for channel, sensor in model.sensors.items():
        noise = jnp.sum(jnp.broadcast_to(jnp.log(sensor.sigma), (len(sensor.axes),)))
        total += int(np.sum(masks[channel])) * noise
    return jnp.where(jnp.all(usable), total, jnp.inf)


def _acting_at(
    t: Array, times: np.ndarray, values: np.ndarray, is_line: bool
) -> tuple[Array, Array]:
    """Recorded inputs (trajectories, samples, ...) at nodes, and their slopes.

    Beyond the record, inputs continue along a line, or are constant.
    """

    def at_nodes(t, times, values):
        def at(t):
            value, slope = line_at(times, values, t)
            if is_line:
                return value, slope
            inside = (times[0] <= t) & (t <= times[-1])
            return interpolate(times, values, t), jnp.where(inside, slope, 0)

        return jax.vmap(jax.vmap(at))(t)

    return jax.vmap(at_nodes, (1, 0, 0), (1, 1))(
        t, jnp.asarray(times, t.dtype), jnp.asarray(values, t.dtype)
    )
