"""Trajectories of which every state is stored, or only some."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from . import components as xyz
from .checks import as_count, as_floats
from .moser_veselov import SolverInfo, solver_info
from .motion import motion

# Steps computed at once in a trajectory that is long or of which not every state is stored: many
# enough to hide what a piece costs, few enough to stay in the cache.
PIECE = 2000
# From here on even a trajectory of which every state is stored is computed in pieces: its
# derivative then takes a fourth of the memory, and no longer.
LONG = 100_000


class Failure(NamedTuple):
    """The first step that did not converge (the first of all, where all did)."""

    step: Array
    residual_norm: Array
    h: Array
    pi: Array  # momentum (3,) at the start of the step's rotation


class Outcome(NamedTuple):
    """How steps, or runs of steps, were solved, one after another on the leading axis."""

    info: SolverInfo
    failure: Failure


def simulate(
    R0: ArrayLike,
    pi0: ArrayLike,
    J: ArrayLike,
    body_torques: ArrayLike | None,
    dt: ArrayLike,
    steps: int,
    newton_iters: int,
    tolerance: ArrayLike | None,
    save_every: int = 1,
) -> tuple[Array, Array, SolverInfo, Failure | None]:
    """Attitudes and momenta of the initial state and of the last one of every `save_every` steps.

    `dt` is a scalar or (steps,), `body_torques` (steps+1, 3); `save_every` divides `steps`. The
    solver info has an entry for each stored state but the first; the failure is the first of
    all, None without steps.

    Raises
    ------
    ValueError, TypeError
        While tracing, for a wrong shape, type or Newton budget.
    """
    newton_iters = as_count("newton_iters", newton_iters, 1)
    R0, pi0, J, dt, *torques = as_floats(
        R0=(R0, (3, 3)),
        pi0=(pi0, (3,)),
        J=(J, (3, 3)),
        dt=(dt, [(), (steps,)]),
        **({} if body_torques is None else {"body_torques": (body_torques, (steps + 1, 3))}),
    )
    body_torques = torques[0] if torques else None
    return _trajectory(R0, pi0, J, body_torques, dt, steps, newton_iters, tolerance, save_every)


# Compiled here, so that calls outside of `jax.jit` compile once for each number of steps.
@partial(jax.jit, static_argnames=("steps", "newton_iters", "save_every"))
def _trajectory(R0, pi0, J, body_torques, dt, steps, newton_iters, tolerance, save_every):
    torques = None if body_torques is None else (body_torques[:-1], body_torques[1:])
    solve = partial(_states, J=J, newton_iters=newton_iters, tolerance=tolerance)
    at_once = steps < LONG if save_every == 1 else steps <= PIECE
    if at_once:
        dt = jnp.broadcast_to(dt, (steps,))
        Rs, pis, outcome = solve(R0, pi0, h=dt, torques=torques)
        Rs, pis, outcome = Rs[::save_every], pis[::save_every], _runs(outcome, save_every, 1)
    else:
        Rs, pis, outcome = _in_pieces(solve, R0, pi0, dt, torques, steps, save_every)
    failure = None
    if steps > 0:
        first = _runs(outcome, steps // save_every, save_every).failure
        failure = jax.tree.map(lambda x: x[0], first)
    return Rs, pis, outcome.info, failure


def _in_pieces(solve, R0, pi0, dt, torques, steps, save_every):
    """Piece after piece. The derivative, too, computes each anew from its first state.

    Either a piece has several stored states or several pieces follow each other to the next
    one: `inner` pieces in each of `outer` groups. Where the steps do not fill the pieces, some
    pieces end with steps of size zero.
    """
    stored, inner = steps // save_every, -(-save_every // PIECE)
    if inner == 1:
        outer = -(-stored // (PIECE // save_every))
        each = -(-stored // outer)
        padded, length = save_every, each * save_every
        left = steps - length * np.arange(outer)[:, None]
    else:
        outer, each, length = stored, 1, -(-save_every // inner)
        padded = inner * length
        left = np.tile(save_every - length * np.arange(inner), (outer, 1))
    stride = length // each
    identity = jnp.eye(3, dtype=R0.dtype)

    def cut(x):
        x = x.reshape(stored, save_every, *x.shape[1:])
        ends = (0, outer * each - stored), (0, padded - save_every)
        return jnp.pad(x, [*ends, *[(0, 0)] * (x.ndim - 2)]).reshape(
            outer, inner, length, *x.shape[2:]
        )

    def piece(state, inputs):
        (Q, pi), (count, h, torques) = state, inputs
        real = jnp.arange(length) < count
        h = jnp.where(real, dt if h is None else h, 0)
        Rs, pis, (info, failure) = solve(Q, pi, h=h, torques=torques)
        info = SolverInfo(jnp.where(real, info.residual_norm, 0), info.converged | ~real)
        run = _runs(Outcome(info, failure), stride, 1)
        # Towards the nearest rotation, or the roundings of the pieces' products would add up.
        Q = Rs[-1] @ (1.5 * identity - 0.5 * Rs[-1].T @ Rs[-1])
        return (Q, pis[-1]), (Rs[stride::stride], pis[stride::stride], run)

    def group(state, inputs):
        state, (Rs, pis, runs) = jax.lax.scan(_recomputed(piece), state, inputs)
        runs = jax.tree.map(lambda x: x.reshape(inner * each, *x.shape[2:]), runs)
        return state, (Rs[-1], pis[-1], _runs(runs, inner, length))

    counts = jnp.asarray(np.clip(left, 0, length))
    inputs = counts, cut(dt) if dt.ndim else None, jax.tree.map(cut, torques)
    _, states = jax.lax.scan(_recomputed(group) if inner > 1 else group, (identity, pi0), inputs)
    Qs, pis, outcome = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:stored], states)
    return jnp.concatenate([R0[None], R0[None] @ Qs]), jnp.concatenate([pi0[None], pis]), outcome


# In a scan nothing is computed twice by accident, which `prevent_cse` guards against elsewhere.
_recomputed = partial(jax.checkpoint, prevent_cse=False)


def _states(R0, pi0, *, J, h, torques, newton_iters, tolerance):
    """All states of steps of sizes `h` (steps,) with the torques (steps, 3) at their two ends."""
    impulses, first = None, jnp.zeros((1, 3), pi0.dtype)
    if torques is not None:
        half = h[:, None] / 2
        # Each step's rotation starts with the momentum after its first impulse.
        first = jnp.pad(half * torques[0], [(0, 1), (0, 0)])
        impulses = half * torques[1] + first[1:]
    out = motion(R0, pi0 + first[0], (J + J.T) / 2, h, impulses, newton_iters)
    pis = out.pi
    if torques is not None:
        pis = (pis - first).at[0].set(pi0)
    size, c, pi, residual_norm, h = jax.lax.stop_gradient(
        (jnp.abs(jnp.trace(J)), out.c[:-1], out.pi[:-1], out.residual_norm[:-1], h)
    )
    info = solver_info(residual_norm, size, xyz.split(c), tolerance)
    return out.R, pis, Outcome(info, Failure(jnp.zeros(h.shape, int), residual_norm, h, pi))


def _runs(outcome: Outcome, count: int, length: int) -> Outcome:
    """Outcomes of runs of `count` entries, of `length` steps each."""
    if count == 1:
        return outcome
    info, failure = jax.tree.map(lambda x: x.reshape(-1, count, *x.shape[1:]), outcome)
    first = jnp.argmax(~info.converged, axis=1)
    failure = jax.tree.map(lambda x: jax.vmap(lambda entries, i: entries[i])(x, first), failure)
    return Outcome(
        SolverInfo(jnp.max(info.residual_norm, axis=1), jnp.all(info.converged, axis=1)),
        failure._replace(step=first * length + failure.step),
    )
