"""The steps of a simulation: their number, their sizes, and the times of the states."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike

from ..core.typed_arrays import as_count, as_floats, as_real, steps_of_torques


class Schedule(NamedTuple):
    """The steps of a simulation, and which states are stored."""

    start: Array  # initial time
    dt: Array  # sizes of the steps (steps,), or one size for all
    steps: int
    save_every: int
    times: Array | None  # of the stored states, where they are an argument

    def stored_times(self, pi: Array) -> Array:
        """The times of the stored states, whose momenta are `pi`."""
        if self.times is not None:
            return _beside(pi, self.times)
        return _stored_times(*self._start_and_sizes(), self.steps, self.save_every, pi)

    def all_times(self) -> Array:
        """Times that reach as far as those of all states."""
        every = 1 if self.dt.ndim else max(self.steps, 1)
        return _times(*self._start_and_sizes(), self.steps, every)

    def _start_and_sizes(self) -> tuple[Array, ...]:
        return as_floats(start=(self.start, ()), dt=(self.dt, self.dt.shape))


# Compiled as one program each, where they are called outside of `jax.jit`.
@partial(jax.jit, static_argnames=("steps", "every"))
def _times(start, dt, steps, every):
    if dt.ndim:
        passed = jnp.cumsum(dt)[every - 1 :: every]
    else:
        passed = dt * jnp.arange(every, steps + 1, every).astype(dt.dtype)
    return jnp.append(start, start + passed)


@jax.jit
def _beside(pi, times):
    """The times, of the type of the momenta and on the same devices.

    The selection, of two equal arrays, is there for batches: times alone would be computed once
    for all bodies, and each device would have those of all.
    """
    return jnp.where(jnp.isnan(pi[:, 0]), times, times).astype(pi.dtype)


@partial(jax.jit, static_argnames=("steps", "every"))
def _stored_times(start, dt, steps, every, pi):
    return _beside(pi, _times(start, dt, steps, every))


@partial(jax.jit, static_argnames="substeps")
def _sizes_between(times, substeps):
    """Sizes of the steps; of times that are not in order NaN, with which no step converges."""
    changes = jnp.diff(times)
    sizes = jnp.where(_in_one_direction(changes), changes / substeps, jnp.nan)
    return jnp.repeat(sizes, substeps)


def _in_one_direction(changes: Any) -> Any:
    return (changes >= 0).all() | (changes <= 0).all()


def schedule_of_steps(
    dt: Array | None,
    steps: int | None,
    t0: ArrayLike | None,
    save_every: int | None,
    body_torques: ArrayLike | None,
    rotor: Array | None,
    inertia: Array,
) -> Schedule:
    """Steps of the sizes `dt`, of which every `save_every`-th is stored."""
    if dt is None:
        raise ValueError(
            "Argument `times` must be given where the integrator has no `dt`, but is None; or give "
            "the integrator a `dt`."
        )
    start = _as_start(0.0 if t0 is None else t0)
    counts = {} if steps is None else {"`steps`": as_count("steps", steps, 0)}
    if dt.ndim:
        counts["the length of `dt`"] = len(dt)
    steps = _number_of_steps(counts, body_torques, rotor, inertia)
    save_every = as_count("save_every", 1 if save_every is None else save_every, 1)
    if steps % save_every:
        raise ValueError(
            f"Argument `save_every` must divide the number of steps, which is {steps}, but is "
            f"{save_every}."
        )
    return Schedule(start, dt, steps, save_every, None)


def schedule_of_times(
    times: ArrayLike,
    substeps: int,
    body_torques: ArrayLike | None,
    rotor: Array | None,
    inertia: Array,
    **not_allowed: object,
) -> Schedule:
    """`substeps` equal steps from each of the times to the next."""
    for name, value in not_allowed.items():
        if value is not None:
            raise ValueError(
                f"Argument `{name}` must be None where there are `times`, but is {value!r}."
            )
    shape = as_real("times", times).shape
    if len(shape) != 1 or shape == (0,):
        raise ValueError(
            "Argument `times` must have shape (states,) and at least one entry, but its shape is "
            f"{shape}."
        )
    (all_times,) = as_floats(times=(times, shape))
    if not isinstance(all_times, Tracer):
        known = np.asarray(all_times)
        if not (np.isfinite(known).all() and _in_one_direction(np.diff(known))):
            raise ValueError(
                "Argument `times` must be finite and in order, increasing or decreasing, but is "
                f"{known.tolist()}."
            )
    counts = {"`substeps` times the intervals of `times`": substeps * (len(all_times) - 1)}
    steps = _number_of_steps(counts, body_torques, rotor, inertia)
    sizes = _sizes_between(all_times, substeps)
    return Schedule(all_times[0], sizes, steps, substeps, all_times)


def _number_of_steps(
    counts: dict[str, int],
    body_torques: ArrayLike | None,
    rotor: Array | None,
    inertia: Array,
) -> int:
    """The number of steps on which all arguments agree."""
    if body_torques is not None:
        counts["the length of `body_torques` less one"] = steps_of_torques(body_torques)
    if rotor is not None and rotor.ndim > 1:
        counts["the length of `rotor_momentum`"] = len(rotor)
    if jnp.ndim(inertia) > 2:
        counts["the length of `inertia`"] = len(inertia)
    if not counts:
        raise ValueError(
            "Argument `steps` must be given when neither `dt`, nor `body_torques`, nor the body's "
            "`rotor_momentum` or `inertia` has one entry for each step, but it is None."
        )
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{name} is {count}" for name, count in counts.items())
        raise ValueError(f"The number of steps must be given consistently, but {listed}.")
    return next(iter(counts.values()))


def _as_start(t0: ArrayLike) -> Array:
    """An initial time, finite where it is known. A Python number stays weakly typed."""
    start = as_real("t0", t0)
    (checked,) = as_floats(t0=(start, ()))
    if not isinstance(checked, Tracer) and not jnp.isfinite(checked):
        raise ValueError(f"Argument `t0` must be finite, but is {float(checked)}.")
    return start
