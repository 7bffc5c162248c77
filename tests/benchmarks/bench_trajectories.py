"""Times of trajectories and of their derivatives, against C and against textbook code."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import GENERIC, rotation
from .reference import compiled_c, textbook

STEPS, BODIES, BODY_STEPS, TEXTBOOK_STEPS = 20_000, 1000, 200, 1000
R0, J, DT = rotation(70), GENERIC, 0.05
PI0 = J @ np.array([0.5, 1.0, 1.5])
WEIGHT = rotation(71)
TORQUES = 0.01 * np.sin(0.01 * np.arange(STEPS + 1))[:, None] * np.ones(3)


@pytest.fixture(scope="module")
def c(tmp_path_factory):
    return compiled_c(tmp_path_factory.mktemp("c"))


def free(J, dt, pi0, R0, steps=STEPS):
    return lgvi.simulate_free_rigid_body(R0, pi0, J, dt, steps)


def a_short_one(J, dt, pi0, R0):
    return free(J, dt, pi0, R0, BODY_STEPS)


def forced(J, dt, pi0, R0, torques):
    return lgvi.simulate_rigid_body(R0, pi0, J, torques, dt)


def loss(simulate: Callable[..., Any]):
    """Value and gradient in J, dt and pi0 of a scalar of all attitudes."""

    def scalar(*arguments):
        return jnp.sum(simulate(*arguments)[0] * WEIGHT)

    return jax.value_and_grad(scalar, argnums=(0, 1, 2))


def arrays(*values):
    return [jnp.asarray(value) for value in values]


ONE = arrays(J, DT, PI0, R0)
FORCED = arrays(J, np.full(STEPS, DT), PI0, R0, TORQUES)


def batch():
    random = np.random.default_rng(72)
    factors = 1 + 0.1 * random.uniform(-1, 1, (BODIES, 1, 1))
    pi0s = PI0 * random.uniform(0.8, 1.2, (BODIES, 1))
    return arrays(J * factors, DT, pi0s, np.broadcast_to(R0, (BODIES, 3, 3)))


def test_the_references_compute_the_same(c):
    Rs, pis, _ = free(*ONE, steps=1000)
    book = textbook(*arrays(R0, PI0, J, DT), steps=1000)
    for R, pi in (c(R0, PI0, J, DT, 1000)()[:2], book):
        np.testing.assert_allclose(R[-1], Rs[-1], atol=1e-11)
        np.testing.assert_allclose(pi[-1], pis[-1], atol=1e-11)
    R, pi, _ = c(R0, PI0, J, np.full(STEPS, DT), STEPS, TORQUES)()
    Rs, pis, _ = forced(*FORCED)
    np.testing.assert_allclose(R[-1], Rs[-1], atol=1e-9)
    np.testing.assert_allclose(pi[-1], pis[-1], atol=1e-9)


def test_c(clock, c):
    clock("C", c(R0, PI0, J, DT, STEPS), STEPS)


def test_free(clock, compiled):
    clock("free", compiled("free", free, *ONE), STEPS, *ONE)


def test_gradient(clock, compiled):
    clock("value and gradient", compiled("value and gradient", loss(free), *ONE), STEPS, *ONE)


def test_c_with_torques(clock, c):
    clock("C, torques", c(R0, PI0, J, np.full(STEPS, DT), STEPS, TORQUES), STEPS)


def test_torques_and_array_dt(clock, compiled):
    name = "torques, array dt"
    clock(name, compiled(name, forced, *FORCED), STEPS, *FORCED)


def test_gradient_with_torques(clock, compiled):
    name = "torques: gradient"
    clock(name, compiled(name, loss(forced), *FORCED), STEPS, *FORCED)


def test_batch(clock, compiled):
    run, arguments = jax.vmap(a_short_one, (0, None, 0, 0)), batch()
    clock("1000 bodies", compiled("1000 bodies", run, *arguments), BODIES * BODY_STEPS, *arguments)


def test_gradient_of_a_batch(clock, compiled):
    run, arguments = jax.vmap(loss(a_short_one), (0, None, 0, 0)), batch()
    name = "1000 bodies: gradient"
    clock(name, compiled(name, run, *arguments), BODIES * BODY_STEPS, *arguments)


def test_textbook(clock):
    run = jax.jit(textbook, static_argnums=4)
    clock("textbook", run, TEXTBOOK_STEPS, *arrays(R0, PI0, J, DT), TEXTBOOK_STEPS, rounds=5)


def test_textbook_gradient(clock):
    def scalar(J, dt, pi0, R0):
        return jnp.sum(textbook(R0, pi0, J, dt, TEXTBOOK_STEPS)[0] * WEIGHT)

    run = jax.jit(jax.value_and_grad(scalar, argnums=(0, 1, 2)))
    clock("textbook gradient", run, TEXTBOOK_STEPS, *ONE, rounds=5)


def test_step_in_a_scan(clock):
    steps, integrator, body = 5000, lgvi.MoserVeselovIntegrator(DT), lgvi.RigidBody(J)

    @eqx.filter_jit
    def run(integrator, body, state):
        def step(state, _):
            # A closed loop: the torque follows the state.
            torque = -0.01 * state[1]
            state = integrator.step(body, *state, torque, torque)[:2]
            return state, state

        return jax.lax.scan(step, state, length=steps)[1]

    clock("step in a scan", run, steps, integrator, body, (ONE[3], ONE[2]))
