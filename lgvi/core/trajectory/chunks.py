"""Long trajectories, chunk after chunk; the derivative computes each chunk again."""

from collections.abc import Callable
from contextvars import ContextVar
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..kernels.finite import product
from ..step.solution import SolverInfo
from .convergence import Failure, first_failure, worst_info
from .translation import CentrePath


class ChunkSizes(NamedTuple):
    """How many steps are computed at once."""

    # In a trajectory that is long or of which not every state is stored: many enough to hide what
    # a chunk costs, few enough to stay in the cache.
    chunk: int = 2000
    # From here on even a trajectory of which every state is stored is computed in chunks: its
    # derivative then takes less memory than the trajectory itself, and no longer.
    long: int = 100_000


USUAL_SIZES = ChunkSizes()
chunk_sizes: ContextVar[ChunkSizes] = ContextVar("chunk_sizes", default=USUAL_SIZES)

Integers = Array | np.ndarray


class Chunks(NamedTuple):
    """Chunks of equal length in groups; each group ends with a stored state.

    A group is one chunk with several stored states, or several chunks from one stored state to
    the next. Where the steps do not fill the chunks of a group, the last steps have size zero.
    """

    stored: int  # states that are stored, beside the initial one
    save_every: int  # steps from one to the next
    groups: int
    of_group: int  # chunks of a group
    by_group: int  # states that a group stores
    length: int  # steps of a chunk

    def first_and_count(self, group: Integers, chunk: Integers) -> tuple[Integers, Integers]:
        """First step of a chunk of a group, and the number of its steps not of size zero."""
        state, step = self.by_group * group, self.length * chunk
        of_group = self.save_every * (self.stored - state).clip(max=self.by_group)
        return self.save_every * state + step, (of_group - step).clip(0, self.length)


def choose_chunks(steps: int, save_every: int, saves_memory: bool = True) -> Chunks | None:
    """Chunks of at most `chunk_sizes.chunk` steps; None where all steps are computed at once.

    Fewer stored states are to save memory, or else time: all steps at once are quicker.
    """
    chunk, long = chunk_sizes.get()
    most = chunk if save_every > 1 and saves_memory else long - 1
    if steps <= most:
        return None
    stored, of_group = steps // save_every, -(-save_every // chunk)
    groups = -(-stored // max(chunk // save_every, 1))
    by_group = -(-stored // groups)
    steps_of_chunk = by_group * -(-save_every // of_group)
    return Chunks(stored, save_every, groups, of_group, by_group, steps_of_chunk)


class Steps(NamedTuple):
    """The steps of a trajectory, or of a chunk (steps, ...)."""

    number: Array
    real: Array | None  # False for steps of size zero that only fill a chunk; None if none does
    dt: Array  # sizes, or one size for all
    arrays: dict[str, Any]  # other arrays with an entry for each step


Solve = Callable[[Array, Array, Steps], tuple[Array, Array, SolverInfo, Failure]]
Follow = Callable[[CentrePath | None, Array, Array, Steps], CentrePath | None]


def simulate_in_chunks(
    solve: Solve,
    follow: Follow,
    R0: Array,
    pi0: Array,
    path: CentrePath | None,
    dt: Array,
    by_step: dict[str, Any],
    chunks: Chunks,
) -> tuple[Array, Array, SolverInfo, Failure, CentrePath | None]:
    """The stored states, the worst solver info between them, the first failure, and the path.

    `solve` gives the states of the steps of one chunk, with info and failures of all its drifts,
    and `follow` the path of what is carried along, from where it is at the start of the chunk.
    The derivative computes each chunk again from its first state.
    """

    def of_group(state, inputs):
        number, *arrays = inputs
        of_chunk = _recomputed(partial(_solve_chunk, solve, follow, R0, dt, chunks, number))
        inputs = jnp.arange(chunks.of_group), *arrays
        state, (states, info, failures) = jax.lax.scan(of_chunk, state, inputs)
        failure = first_failure(jnp.all(info.converged, axis=1), failures)
        return state, (jax.tree.map(lambda x: x[-1], states), worst_info(info, axis=0), failure)

    cut = partial(_cut, chunks)
    inputs = jnp.arange(chunks.groups), cut(dt) if dt.ndim else None, jax.tree.map(cut, by_step)
    run = _recomputed(of_group) if chunks.of_group > 1 else of_group
    start = jnp.eye(3, dtype=R0.dtype), pi0, path
    _, (states, info, failures) = jax.lax.scan(run, start, inputs)
    failure = first_failure(jnp.all(info.converged, axis=1), failures)
    stored = chunks.stored
    states, info = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:stored], (states, info))
    Rs, pis, path = jax.tree.map(
        lambda first, later: jnp.concatenate([first[None], later]), (R0, pi0, path), states
    )
    return Rs, pis, info, failure, path


def _cut(chunks: Chunks, x: Array) -> Array:
    """An array of all steps (steps, ...) as (groups, chunks of a group, steps of a chunk, ...)."""
    stored, save_every, groups, of_group, by_group, length = chunks
    x = x.reshape(stored, save_every, *x.shape[1:])
    ends = (0, groups * by_group - stored), (0, of_group * (length // by_group) - save_every)
    x = jnp.pad(x, [*ends, *[(0, 0)] * (x.ndim - 2)], mode="edge")
    return x.reshape(groups, of_group, length, *x.shape[2:])


def _solve_chunk(
    solve: Solve,
    follow: Follow,
    R0: Array,
    dt: Array,
    chunks: Chunks,
    of_group: Array,
    state,
    inputs,
):
    """The state after a chunk; and its stored states, their worst info and the first failure.

    The state is the attitude relative to `R0`, the momentum, and where the passenger is.
    """
    (Q, pi, path), (index, sizes, by_step) = state, inputs
    by_group, length = chunks.by_group, chunks.length
    start, count = chunks.first_and_count(of_group, index)
    number, real = jnp.asarray(start) + jnp.arange(length), jnp.arange(length) < count
    steps = Steps(number, real, dt if sizes is None else sizes, by_step)
    Rs, pis, info, failures = solve(Q, pi, steps)
    real = jnp.repeat(real, len(failures.h) // length)
    info = SolverInfo(jnp.where(real, info.residual_norm, 0), info.converged | ~real)
    failure = first_failure(info.converged, failures)
    info = worst_info(jax.tree.map(lambda x: x.reshape(by_group, -1), info), axis=1)
    # Towards the nearest rotation, or the roundings of the products of chunks would add up.
    identity = jnp.eye(3, dtype=R0.dtype)
    Q = product(Rs[-1], 1.5 * identity - 0.5 * product(Rs[-1].T, Rs[-1]))
    stride = length // by_group
    attitudes = product(R0[None], Rs[stride::stride])
    path = None if path is None else follow(path, product(R0[None], Rs), pis, steps)
    last, stored = (
        jax.tree.map(lambda x, part=part: x[part], path)
        for part in (-1, slice(stride, None, stride))
    )
    return (Q, pis[-1], last), ((attitudes, pis[stride::stride], stored), info, failure)


# In a scan nothing is computed twice by accident, which `prevent_cse` guards against elsewhere.
_recomputed = partial(jax.checkpoint, prevent_cse=False)
