"""Trajectories of which every state is stored, or only some."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from . import components as xyz
from .checks import as_count, as_floats
from .moser_veselov import SolverInfo, solver_info
from .motion import motion
from .pieces import pieces_of
from .preprocessing import modified_inertia


class Failure(NamedTuple):
    """The first step that did not converge (the first of all, where all did)."""

    step: Array
    residual_norm: Array
    h: Array
    pi: Array  # momentum (3,) at the start of the step's rotation


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
    order: int = 2,
) -> tuple[Array, Array, SolverInfo, Failure | None]:
    """Attitudes and momenta of the initial state and of the last one of every `save_every` steps.

    `dt` is a scalar or (steps,), `body_torques` (steps+1, 3); `save_every` divides `steps`. The
    solver info has an entry for each stored state but the first; the failure is the first of
    all, None without steps. Without torque `order` may be more than 2.

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
    static = newton_iters, steps, save_every, pieces_of(steps, save_every), order
    return _trajectory(R0, pi0, J, body_torques, dt, tolerance, *static)


# Compiled here, so that calls outside of `jax.jit` compile once for each number of steps.
@partial(jax.jit, static_argnames=("newton_iters", "steps", "save_every", "pieces", "order"))
def _trajectory(
    R0, pi0, J, body_torques, dt, tolerance, newton_iters, steps, save_every, pieces, order
):
    torques = None if body_torques is None else (body_torques[:-1], body_torques[1:])
    J = (J + J.T) / 2

    def solve(R0, pi0, dt, h, torques):
        inertia = modified_inertia(J, pi0, dt, order) if order > 2 and steps > 0 else J
        return _states(R0, pi0, inertia, h, torques, newton_iters, tolerance)

    if pieces is not None:
        return _in_pieces(solve, R0, pi0, dt, torques, pieces)
    Rs, pis, info, failures = solve(R0, pi0, dt, jnp.broadcast_to(dt, (steps,)), torques)
    first = _first(info.converged, failures) if steps > 0 else None
    info = _worst(jax.tree.map(lambda x: x.reshape(-1, save_every), info), axis=1)
    return Rs[::save_every], pis[::save_every], info, first


def _in_pieces(solve, R0, pi0, dt, torques, pieces):
    """Piece after piece. The derivative, too, computes each anew from its first state."""
    stored, save_every, groups, of_group, each, length = pieces
    stride = length // each
    identity = jnp.eye(3, dtype=R0.dtype)

    def cut(x):
        x = x.reshape(stored, save_every, *x.shape[1:])
        ends = (0, groups * each - stored), (0, of_group * stride - save_every)
        x = jnp.pad(x, [*ends, *[(0, 0)] * (x.ndim - 2)])
        return x.reshape(groups, of_group, length, *x.shape[2:])

    def piece(of, state, inputs):
        (Q, pi), (number, h, torques) = state, inputs
        start, count = pieces.first_and_count(of, number)
        real = jnp.arange(length) < count
        size = dt if h is None else h
        Rs, pis, info, failures = solve(Q, pi, size, jnp.where(real, size, 0), torques)
        info = SolverInfo(jnp.where(real, info.residual_norm, 0), info.converged | ~real)
        first = _first(info.converged, failures)
        info = _worst(jax.tree.map(lambda x: x.reshape(each, stride), info), axis=1)
        # Towards the nearest rotation, or the roundings of the pieces' products would add up.
        Q = xyz.matmul(Rs[-1], 1.5 * identity - 0.5 * xyz.matmul(Rs[-1].T, Rs[-1]))
        ends = xyz.matmul(R0[None], Rs[stride::stride]), pis[stride::stride]
        return (Q, pis[-1]), (*ends, info, first._replace(step=start + first.step))

    def group(state, inputs):
        number, *arrays = inputs
        inputs = jnp.arange(of_group), *arrays
        each_piece = _recomputed(partial(piece, number))
        state, (Rs, pis, info, firsts) = jax.lax.scan(each_piece, state, inputs)
        first = _first(jnp.all(info.converged, axis=1), firsts)
        return state, (Rs[-1], pis[-1], _worst(info, axis=0), first)

    inputs = jnp.arange(groups), cut(dt) if dt.ndim else None, jax.tree.map(cut, torques)
    group = _recomputed(group) if of_group > 1 else group
    _, (Rs, pis, info, firsts) = jax.lax.scan(group, (identity, pi0), inputs)
    first = _first(jnp.all(info.converged, axis=1), firsts)
    Rs, pis, info = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:stored], (Rs, pis, info))
    return jnp.concatenate([R0[None], Rs]), jnp.concatenate([pi0[None], pis]), info, first


# In a scan nothing is computed twice by accident, which `prevent_cse` guards against elsewhere.
_recomputed = partial(jax.checkpoint, prevent_cse=False)


def _states(R0, pi0, J, h, torques, newton_iters, tolerance):
    """All states of steps of sizes `h` (steps,) with the torques (steps, 3) at their two ends."""
    impulses, first = None, jnp.zeros((1, 3), pi0.dtype)
    if torques is not None:
        half = h[:, None] / 2
        # Each step's rotation starts with the momentum after its first impulse.
        first = jnp.pad(half * torques[0], [(0, 1), (0, 0)])
        impulses = half * torques[1] + first[1:]
    out = motion(R0, pi0 + first[0], J, h, impulses, newton_iters)
    pis = out.pi
    if torques is not None:
        pis = (pis - first).at[0].set(pi0)
    size = jnp.abs(jnp.trace(J, axis1=-2, axis2=-1))
    size, c, pi, residual_norm, h = jax.lax.stop_gradient(
        (size, out.c[:-1], out.pi[:-1], out.residual_norm[:-1], h)
    )
    info = solver_info(residual_norm, size, xyz.split(c), tolerance)
    return out.R, pis, info, Failure(jnp.arange(len(h)), residual_norm, h, pi)


def _worst(info: SolverInfo, axis: int) -> SolverInfo:
    return SolverInfo(jnp.max(info.residual_norm, axis=axis), jnp.all(info.converged, axis=axis))


def _first(converged: Array, failures: Failure) -> Failure:
    first = jnp.argmax(~converged)
    return jax.tree.map(lambda x: x[first], failures)
