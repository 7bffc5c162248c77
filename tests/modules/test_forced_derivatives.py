"""Derivatives of simulations under torque laws, damping and feedback."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..derivatives import assert_first_derivatives_agree, assert_gradient_agrees
from ..systems import GENERIC, PI0, R0, rng

BODY = lgvi.RigidBody(jnp.asarray(GENERIC))
VECTOR, OFFSET = np.array([0.3, -0.2, 0.1]), np.array([0.1, 0.2, 1.0])
DAMPING = np.array([[0.5, 0.2, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 0.3]])
GRAVITY = lgvi.UniformGravity(1.3, OFFSET, 1.0)
SPACE = lgvi.ConstantTorque(VECTOR, "space")


def changing(t, R):
    """A torque without a potential, of time and attitude."""
    return jnp.stack([jnp.sin(2 * t), R[0, 1], R[1, 2] * t])


def final(settings, R0, pi0, J, dt, t0, strength, gain):
    damping = None
    if not settings:
        damping = lgvi.LinearDamping(0.2 * DAMPING) + lgvi.QuadraticDamping(0.1 * VECTOR**2)
        damping += lambda t, R, omega: strength * (jnp.sin(omega) + t * R[0]) * omega
    law = strength * (GRAVITY + lgvi.GravityGradient(1.1, VECTOR)) + changing
    method = lgvi.MoserVeselovIntegrator(0.1 * dt, throw=False, **settings)
    R, pi, _ = method.simulate(
        lgvi.RigidBody(J),
        R0,
        pi0,
        torque=law if damping is None else law + damping,
        controller=lambda t, R, pi: -gain * (pi + R[0] * t),
        t0=t0,
    )
    return R[-1], pi[1:]


POINT = R0, PI0, GENERIC, np.array([1.0, 1.5, 1.2]), 0.3, 1.2, 0.4


def test_first_derivatives_along_one_direction():
    assert_gradient_agrees(partial(final, {}), *POINT, rtol=1e-10, forward=True)


@pytest.mark.slow
def test_first_derivatives():
    arguments = [jnp.asarray(x)[None] for x in POINT]
    assert_first_derivatives_agree(partial(final, {}), *arguments, rtol=1e-10)


@pytest.mark.parametrize("order", [4, pytest.param(6, marks=pytest.mark.slow)])
def test_the_gradient_of_a_high_order(order):
    assert_gradient_agrees(partial(final, {"order": order}), *POINT, rtol=1e-10)


def in_many_steps(x, dt, save_every=1, order=2):
    """Under a torque that changes with time, of strength x[0] and with steps x[1] dt."""
    law = x[0] * SPACE + changing
    method = lgvi.MoserVeselovIntegrator(x[1] * dt, order=order, throw=False)
    given = BODY, R0, PI0
    return method.simulate(*given, steps=16, torque=law, save_every=save_every, t0=0.4)[:2]


def scalar(x, order=2):
    R, pi = in_many_steps(x, jnp.full(16, 0.05 * order), order=order)
    weights = jnp.asarray(rng(64).normal(size=(2, 3)))
    return jnp.sum(jnp.sin(R[:, 0] @ weights[0])) + jnp.sum((pi @ weights[1]) ** 2)


@pytest.mark.parametrize(
    ("sizes", "every"),
    [
        pytest.param("equal", 1, marks=pytest.mark.slow),
        ("equal", 4),
        ("each its own", 1),
        pytest.param("each its own", 4, marks=pytest.mark.slow),
    ],
)
def test_time_goes_on_from_piece_to_piece(sizes, every, set_chunk_sizes):
    x, dt = np.array([0.7, 1.1]), np.linspace(0.05, 0.15, 16)
    if sizes == "equal":
        dt = np.full(16, 0.1)
    whole = in_many_steps(x, dt)
    set_chunk_sizes(chunk=3, long=5)
    in_chunks = in_many_steps(x, np.asarray(0.1) if sizes == "equal" else dt, every)
    for actual, desired in zip(in_chunks, whole, strict=True):
        np.testing.assert_allclose(actual, desired[::every], rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("order", "in_chunks"),
    [
        (2, False),
        pytest.param(4, False, marks=pytest.mark.slow),
        pytest.param(2, True, marks=pytest.mark.slow),
    ],
)
def test_second_derivatives(order, in_chunks, set_chunk_sizes):
    if in_chunks:
        set_chunk_sizes(chunk=3, long=5)
    x, direction, size = jnp.asarray([0.7, 1.1]), jnp.asarray([0.6, -0.8]), 1e-5
    # Of one compiled program: a gradient and its change along the direction.
    both = jax.jit(lambda x: jax.jvp(jax.grad(partial(scalar, order=order)), (x,), (direction,)))
    (_, actual), (ahead, _), (behind, _) = (both(x + s * size * direction) for s in (0, 1, -1))
    numeric = (ahead - behind) / (2 * size)
    np.testing.assert_allclose(actual, numeric, rtol=1e-7)


@pytest.mark.slow
def test_second_derivatives_with_feedback_and_damping():
    def scalar(x):
        R, pi = final({}, *POINT[:5], x[0], x[1])
        return jnp.sum(jnp.sin(R)) + jnp.sum(pi**2)

    x, direction, size = jnp.asarray([1.2, 0.4]), jnp.asarray([0.6, -0.8]), 1e-5
    both = jax.jit(lambda x: jax.jvp(jax.grad(scalar), (x,), (direction,)))
    (_, actual), (ahead, _), (behind, _) = (both(x + s * size * direction) for s in (0, 1, -1))
    np.testing.assert_allclose(actual, (ahead - behind) / (2 * size), rtol=1e-7)


def test_a_batch_is_a_loop():
    def final(strength):
        method = lgvi.MoserVeselovIntegrator(0.1, throw=False)
        return method.simulate(BODY, R0, PI0, steps=5, torque=strength * GRAVITY).pi[-1]

    def both(strength):
        return final(strength), jax.jacrev(final)(strength)

    strengths = jnp.asarray([0.5, 1.0, 2.0])
    batch, gradients = jax.jit(jax.vmap(both))(strengths)
    single = jax.jit(both)
    for i, strength in enumerate(strengths):
        value, gradient = single(strength)
        np.testing.assert_allclose(batch[i], value, rtol=0, atol=1e-14)
        np.testing.assert_allclose(gradients[i], gradient, rtol=0, atol=1e-13)


def test_the_gradient_of_gravity_depends_on_the_body():
    """`simulate` takes the body's inertia, and the derivative knows."""

    def final(J, law):
        method = lgvi.MoserVeselovIntegrator(0.1)
        pi = method.simulate(lgvi.RigidBody(J), R0, PI0, steps=3, torque=law).pi[-1]
        return pi, pi

    def of_body(J):
        return final(J, -lgvi.GravityGradient(1.1, VECTOR))

    def of_both(J, of_law):
        return final(J, -lgvi.GravityGradient(1.1, VECTOR, of_law))

    implicit, pi = jax.jit(jax.jacrev(of_body, has_aux=True))(GENERIC)
    by_both = jax.jit(jax.jacrev(of_both, argnums=(0, 1), has_aux=True))
    (fixed, by_law), desired = by_both(GENERIC, GENERIC)
    np.testing.assert_allclose(pi, desired, rtol=1e-7)
    np.testing.assert_allclose(implicit, fixed + by_law, rtol=0, atol=1e-14)
    assert np.max(np.abs(implicit - fixed)) > 1e-2


def test_a_network_learns_beside_a_law():
    class Network(eqx.Module):
        layers: eqx.nn.MLP

        def __call__(self, t, R):
            return self.layers(R.ravel())

    network = Network(eqx.nn.MLP(9, 3, 8, 1, key=jax.random.key(0)))
    method = lgvi.MoserVeselovIntegrator(0.1)

    def loss(network):
        pi = method.simulate(BODY, R0, PI0, steps=5, torque=network + GRAVITY).pi
        return jnp.sum(pi[-1] ** 2)

    value_and_gradient = eqx.filter_jit(eqx.filter_value_and_grad(loss))
    index = eqx.tree_at(
        lambda n: n.layers.layers[0].bias, network, replace_fn=lambda x: x.at[0].add(1e-5)
    )
    value, gradient = value_and_gradient(network)
    slope = (value_and_gradient(index)[0] - value) / 1e-5
    np.testing.assert_allclose(gradient.layers.layers[0].bias[0], slope, rtol=1e-3)


@pytest.mark.parametrize("kind", ["integer", "key", "closure"])
def test_derivatives_beside_what_has_none(kind):
    """A law may hold integers and keys, and close over them while they are traced."""

    class Row(eqx.Module):
        index: jax.Array

        def __call__(self, t, R):
            return R[self.index]

    class Noise(eqx.Module):
        key: jax.Array

        def __call__(self, t, R):
            return jax.random.normal(self.key, (3,))

    def final(pi0, n):
        law = {
            "integer": Row(jnp.asarray(0)),
            "key": Noise(jax.random.key(0)),
            "closure": lambda t, R: jnp.where(n > 2, 1.0, 2.0) * R[0],
        }[kind]
        method = lgvi.MoserVeselovIntegrator(0.1, throw=False)
        return method.simulate(BODY, R0, pi0, steps=3, torque=law).pi[-1, 0]

    run = jax.jit(jax.value_and_grad(final))
    gradient = run(jnp.asarray(PI0), 1)[1]
    ends = [run(PI0 + s * 1e-5 * np.eye(3)[0], 1)[0] for s in (1, -1)]
    np.testing.assert_allclose(gradient[0], (ends[0] - ends[1]) / 2e-5, rtol=1e-8)
