"""How time grows with the number of steps and of bodies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import GENERIC, R0

PI0 = GENERIC @ np.array([0.5, 1.0, 1.5])


def free(pi0, steps):
    return lgvi.simulate_free_rigid_body(R0, pi0, GENERIC, 0.05, steps)


@pytest.mark.parametrize("steps", [10**3, 10**4, 10**5, 10**6])
def test_steps(clock, line, steps):
    run = jax.jit(free, static_argnums=1)
    time = clock(f"{steps} steps", run, steps, jnp.asarray(PI0), steps, rounds=5)
    line(f"{f'{steps:,} steps':42} {1e6 * time:11.3f}")


@pytest.mark.parametrize("bodies", [1, 10, 100, 1000, 10**4])
def test_bodies(clock, line, bodies):
    pi0s = jnp.asarray(PI0 * np.linspace(0.5, 1, bodies)[:, None])
    run = jax.jit(jax.vmap(lambda pi0: free(pi0, 200)))
    time = clock(f"{bodies} bodies", run, bodies * 200, pi0s, rounds=5)
    line(f"{f'{bodies:,} bodies x 200 steps, per body':42} {1e6 * time:11.3f}")
