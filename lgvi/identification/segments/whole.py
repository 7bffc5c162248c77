"""Costs of whole trajectories as one function, which JAX can compile and differentiate."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...core.kernels.interpolation import interpolate, line_at
from ...modules.integrator import MoserVeselovIntegrator
from ..data.formats import INPUTS
from ..model.free_leaves import put_own_leaves
from ..model.model import Model
from ..model.states import InitialStates, are_states
from .programs import Segment, simulate_segment
from .segment import Chains, Table


class Trajectories(NamedTuple):
    """Segments in sequence (positions, trajectories, ...), and the shifts of their nodes."""

    segments: Segment
    clocks: dict[str, np.ndarray]  # (..., nodes), shift of the time of a node for each s
    recorded: dict[str, tuple[np.ndarray, np.ndarray]]  # (trajectories, samples, ...)

    @classmethod
    def of(cls, chains: Chains) -> "Trajectories":
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


def simulate_costs(
    model: Model,
    own: Any,
    states: InitialStates,
    trajectories: Trajectories,
    method: MoserVeselovIntegrator,
) -> Array:
    """The sums of the losses of trajectories (trajectories,); infinite if a step is not solved.

    `own` is a model of True where a leaf is a trajectory's own, with values in `states.own`, or
    None. Where `states.own` is None, all trajectories have those of the model.
    """
    segments, dtype = trajectories.segments, trajectories.segments.dt.dtype
    first, is_state = None, np.zeros(0, int)
    if own is not None:
        leaves = jnp.concatenate([x.ravel() for x in jax.tree.leaves(eqx.filter(model, own))])
        same = jnp.broadcast_to(leaves, (len(states.omega), len(leaves)))
        # Other configurations may have more own leaves.
        first = same if states.own is None else jnp.asarray(states.own)[:, : len(leaves)]
        is_state = np.flatnonzero(are_states(model, own))

    def of_each(read: Callable[[Model], Array]) -> Array:
        """A number of the model of each trajectory, or (1,) where all have the same."""
        if first is None:
            return read(model).astype(dtype)[None]
        numbers = jax.vmap(lambda leaves: read(put_own_leaves(model, own, leaves)))(first)
        return numbers.astype(dtype)

    t = jnp.asarray(segments.start)[..., None] + jnp.cumsum(
        jnp.pad(jnp.asarray(segments.dt), ((0, 0), (0, 0), (1, 0))), axis=-1
    )
    for channel, moved in trajectories.clocks.items():
        offset = of_each(lambda m, c=channel: m.sensors[c].time_offset / m.time_scale)
        t = t + offset[None, :, None] * jnp.asarray(moved)
    inputs, rates = {}, {}
    for name, (times, values) in trajectories.recorded.items():
        is_line, at = name == "rotor_momentum", t
        if is_line and model.rotor_delay is not None:
            at = t - of_each(lambda m: jnp.asarray(m.rotor_delay))[None, :, None]
        inputs[name], rates[name] = _acting_at(at, times, values, is_line)
    segments = segments._replace(
        start=t[..., 0], dt=jnp.diff(t, axis=-1), inputs=inputs, rates=rates
    )

    def advance(state: tuple[Array, Array, Array | None], segments: Segment) -> Any:
        def follow(R, omega, leaves, segment):
            end = simulate_segment(method, put_own_leaves(model, own, leaves), R, omega, segment)
            after = None if leaves is None else leaves.at[is_state].set(end.own)
            return (end.R, end.omega, after), jnp.where(end.usable, end.cost, jnp.inf)

        return jax.vmap(follow)(*state, segments)

    state = jax.tree.map(jnp.asarray, (states.R, states.omega, first))
    _, costs = jax.lax.scan(advance, state, segments)
    return jnp.sum(costs, axis=0)


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
