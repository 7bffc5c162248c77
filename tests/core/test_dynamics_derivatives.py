"""Derivatives of trajectories with respect to everything that defines them."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..derivatives import assert_first_derivatives_agree, assert_second_derivatives_agree
from ..systems import GENERIC, PI0, R0, physical_inertias, rng
from .steps import step_after_step

STEPS = 10
TORQUES = rng(30).normal(size=(STEPS + 1, 3))


def assert_a_later_step_moves_no_earlier_state(jacobian):
    by_dt = jacobian[0, : 9 * (STEPS + 1), -STEPS:].reshape(STEPS + 1, 9, STEPS)
    moved = np.max(np.abs(by_dt), axis=1) > 0
    np.testing.assert_array_equal(moved, np.tri(STEPS + 1, STEPS, -1, dtype=bool))


@pytest.mark.parametrize(
    "dt",
    [
        pytest.param(0.1, id="one step", marks=pytest.mark.slow),
        pytest.param(np.linspace(0.05, 0.15, STEPS), id="each step"),
    ],
)
def test_derivatives_with_respect_to_every_argument(dt):
    def run(*args):
        return lgvi.simulate_rigid_body(*args)[:2]

    args = [jnp.asarray(x)[None] for x in (R0, PI0, GENERIC, TORQUES, dt)]
    jacobian = assert_first_derivatives_agree(run, *args)
    if np.ndim(dt):
        assert_a_later_step_moves_no_earlier_state(jacobian)


@pytest.mark.slow
def test_derivatives_with_respect_to_each_of_many_steps_of_free_motion():
    def run(pi0, dt):
        return lgvi.simulate_free_rigid_body(R0, pi0, GENERIC, dt, STEPS)[:2]

    dt = np.linspace(0.05, 0.15, STEPS)
    jacobian = assert_first_derivatives_agree(run, jnp.asarray(PI0)[None], jnp.asarray(dt)[None])
    assert_a_later_step_moves_no_earlier_state(jacobian)


def test_derivatives_of_many_steps_are_those_of_step_after_step():
    steps = 1000
    random = rng(33)
    torques = 0.1 * random.normal(size=(steps + 1, 3))
    dt = random.uniform(0.05, 0.1, steps)
    arguments = [jnp.asarray(x) for x in (R0, PI0, GENERIC, torques, dt)]

    def one_by_one(R0, pi0, J, torques, dt):
        Rs, pis = step_after_step(R0, pi0, J, torques, dt)
        return jnp.concatenate([R0[None], Rs]), jnp.concatenate([pi0[None], pis])

    def whole(R0, pi0, J, torques, dt):
        return lgvi.simulate_rigid_body(R0, pi0, J, torques, dt)[:2]

    tangents = [jnp.asarray(random.normal(size=x.shape)) for x in arguments]
    weights = tuple(jnp.asarray(random.normal(size=(steps + 1, *x))) for x in ((3, 3), (3,)))

    @partial(jax.jit, static_argnums=0)
    def derivatives(simulate: Callable[..., Any], tangents, weights):
        forward = jax.jvp(simulate, arguments, tangents)[1]
        return forward, jax.vjp(simulate, *arguments)[1](weights)

    desired = derivatives(one_by_one, tangents, weights)
    for actual, wanted in zip(
        jax.tree.leaves(derivatives(whole, tangents, weights)),
        jax.tree.leaves(desired),
        strict=True,
    ):
        size = np.max(np.abs(wanted))
        np.testing.assert_allclose(actual / size, wanted / size, rtol=0, atol=1e-10)


def test_second_derivatives_of_a_fit():
    target = jnp.asarray(rng(31).normal(size=(5, 3, 3)))

    def loss(J, pi0):
        Rs, pis, _ = lgvi.simulate_free_rigid_body(R0, pi0, J, 0.1, 4)
        return jnp.sum((Rs - target) ** 2) + jnp.sum(pis[:, 0] ** 2)

    # A body at rest is where a fit often starts.
    pi0 = np.stack([PI0, 0 * PI0])
    assert_second_derivatives_agree(loss, jnp.asarray([GENERIC, GENERIC]), jnp.asarray(pi0))


@pytest.mark.parametrize("dtype", [jnp.float32, pytest.param(jnp.float64, marks=pytest.mark.slow)])
def test_a_batch_of_gradients_is_a_loop_and_keeps_the_precision(dtype):
    def loss(J, pi0):
        Rs, _, _ = lgvi.simulate_free_rigid_body(jnp.eye(3, dtype=J.dtype), pi0, J, 0.1, STEPS)
        return jnp.sum(Rs[-1] * jnp.asarray(TORQUES[:3], J.dtype))

    gradient = jax.grad(loss, argnums=(0, 1))
    J, pi0 = jnp.asarray(physical_inertias(3, 32, ratio=0.1), dtype), jnp.asarray(PI0, dtype)
    batch = jax.jit(jax.vmap(gradient, in_axes=(0, None)))(J, pi0)
    single = jax.jit(gradient)
    for i in range(3):
        for actual, desired in zip(single(J[i], pi0), batch, strict=True):
            assert actual.dtype == dtype
            unit = float(jnp.finfo(dtype).eps * jnp.max(jnp.abs(desired[i])))
            np.testing.assert_allclose(actual, desired[i], rtol=0, atol=64 * unit)
