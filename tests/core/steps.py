"""Many single steps at once: random ones, their solution, and their residual by matrices."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

import lgvi

from ..oracle import oracle_F
from ..systems import momenta, physical_inertias, residual

COUNT = 150
LARGEST = 180
H = 0.1


def eps(dtype):
    return float(jnp.finfo(dtype).eps)


@cache
def solver(newton_iters=8):
    """Solve for a batch of pi and J at one h, with one tolerance."""
    solve = jax.vmap(lgvi.solve_F_with_info, in_axes=(0, 0, None, None, None))
    solve_many = jax.jit(lambda pi, J, h, tolerance: solve(pi, J, h, newton_iters, tolerance))

    def padded(pi, J, h, tolerance):
        count = len(pi)
        index = np.arange(LARGEST).clip(max=count - 1)  # one size, so that one program serves all
        solved = solve_many(np.asarray(pi)[index], np.asarray(J)[index], h, tolerance)
        return jax.tree.map(lambda x: np.asarray(x)[:count], solved)

    return padded


def step_after_step(R0, pi0, J, torques, dt):
    """The states after the steps of a trajectory, each step by itself."""

    def step(state, inputs):
        (R, pi), (torque, next_torque, h) = state, inputs
        state = lgvi.rigid_body_step(R, pi, J, torque, next_torque, h)[:2]
        return state, state

    return jax.lax.scan(step, (R0, pi0), (torques[:-1], torques[1:], dt))[1]


def random_steps(dtype, largest, *key):
    Js = physical_inertias(COUNT, *key)
    return jnp.asarray(momenta(Js, largest, *key, h=H), dtype), jnp.asarray(Js, dtype)


def residual_norms(F, pi, J, h):
    steps = zip(np.asarray(F), np.asarray(pi), np.asarray(J), strict=True)
    return np.array([np.linalg.norm(residual(F_i, pi_i, J_i, h)) for F_i, pi_i, J_i in steps])


def oracle(pi, J, h):
    steps = zip(np.asarray(pi), np.asarray(J), strict=True)
    return np.array([oracle_F(pi_i, J_i, h) for pi_i, J_i in steps])


def traces(J):
    return np.trace(np.asarray(J, float), axis1=1, axis2=2)
