"""A body with a damper."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lgvi

from ..systems import R0, hat, inertia, rotation

ANY: Any = lgvi  # whose arguments a type checker does not know
J = inertia([1.0, 2.0, 2.5], rotation(12))
AXIS, WHEEL, FRICTION = np.array([0.3, -0.5, 1.0]), 0.08, 0.06
A = AXIS / np.linalg.norm(AXIS)
BODY = lgvi.DampedBody(J, AXIS, WHEEL, FRICTION)
OMEGA0, SPIN0 = np.array([1.5, 0.3, -0.4]), 2.0
PI0 = J @ OMEGA0 + WHEEL * SPIN0 * A
SPAN = 4.0


def by_scipy(span):
    """The motion in velocities: (R, omega, speed of the wheel) at the end."""
    mass = np.block([[J, WHEEL * A[:, None]], [WHEEL * A[None], np.array([[WHEEL]])]])

    def derivative(_, y):
        R, omega, spin = y[:9].reshape(3, 3), y[9:12], y[12]
        gyroscopic = np.cross(J @ omega + WHEEL * spin * A, omega)
        rates = np.linalg.solve(mass, [*gyroscopic, -FRICTION * spin])
        return np.concatenate([(R @ hat(omega)).ravel(), rates])

    start = np.concatenate([R0.ravel(), OMEGA0, [SPIN0]])
    y = solve_ivp(derivative, (0, span), start, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    return y[:9].reshape(3, 3), y[9:12], y[12]


def simulate(steps, span=SPAN, **options):
    return BODY.simulate(R0, PI0, SPIN0, dt=span / steps, steps=steps, **options)


def test_states_are_of_order_two():
    R, omega, spin = by_scipy(SPAN)
    errors = []
    for steps in (200, 400, 800):
        motion = simulate(steps, save_every=steps)
        velocity = BODY.angular_velocity(motion.pi[-1], motion.spin[-1])
        pairs = (motion.R[-1], R), (velocity, omega), (motion.spin[-1], spin)
        errors.append([np.max(abs(np.asarray(x) - y)) for x, y in pairs])
    orders = np.log2(np.array(errors)[:-1] / np.array(errors)[1:])
    np.testing.assert_allclose(orders, 2, atol=0.05)
    assert np.max(errors[-1]) < 1e-3


def test_each_step_keeps_the_momentum_and_loses_what_friction_takes():
    steps, h = 400, SPAN / 400
    motion = simulate(steps)
    momenta = np.einsum("nij,nj->ni", motion.R, motion.pi)
    np.testing.assert_allclose(momenta, np.tile(R0 @ PI0, (steps + 1, 1)), atol=1e-13)
    energy = np.asarray(jax.vmap(BODY.energy)(motion.pi, motion.spin))
    omega = np.asarray(jax.vmap(BODY.angular_velocity)(motion.pi, motion.spin))
    direct = np.einsum("ni,ij,nj->n", omega, J, omega) / 2
    spin = np.asarray(motion.spin)
    direct += WHEEL * (spin * (omega @ A) + spin**2 / 2)
    np.testing.assert_allclose(energy, direct, rtol=1e-13)
    # The speed is linear in the momenta, of which the middle is the mean.
    momentum = (motion.pi[1:] + motion.pi[:-1]) / 2
    axial = WHEEL * (spin + omega @ A)
    at_middle = (axial[1:] + axial[:-1]) / 2
    without = J - WHEEL * np.outer(A, A)
    velocity = np.linalg.solve(without, (momentum - at_middle[:, None] * A).T).T
    middle = at_middle / WHEEL - velocity @ A
    np.testing.assert_allclose(np.diff(energy), -h * FRICTION * middle**2, atol=1e-13)


def test_a_million_steps_end_in_a_spin_about_the_largest_moment():
    motion = simulate(1_000_000, span=20_000.0, save_every=1000)
    assert bool(jnp.all(motion.converged))
    momenta = np.einsum("nij,nj->ni", motion.R, motion.pi)
    np.testing.assert_allclose(momenta, np.tile(R0 @ PI0, (1001, 1)), atol=2e-12)
    energy = np.asarray(jax.vmap(BODY.energy)(motion.pi, motion.spin))
    assert np.all(np.diff(energy) < 1e-13)
    np.testing.assert_allclose(motion.spin[-1], 0, atol=1e-10)
    moments, axes = np.linalg.eigh(J)
    size = np.linalg.norm(PI0)
    np.testing.assert_allclose(abs(axes[:, 2] @ motion.pi[-1]), size, rtol=1e-10)
    np.testing.assert_allclose(energy[-1], size**2 / (2 * moments[2]), rtol=1e-10)


def test_without_friction_nothing_is_lost():
    body = lgvi.DampedBody(J, AXIS, WHEEL, 0.0)
    motion = body.simulate(R0, PI0, SPIN0, dt=0.1, steps=2000)
    energy = jax.vmap(body.energy)(motion.pi, motion.spin)
    np.testing.assert_allclose(energy, jnp.full(2001, energy[0]), rtol=1e-13)


def test_derivatives_are_exact():
    def final(leaves):
        body = lgvi.DampedBody(*leaves)
        motion = body.simulate(R0, PI0, SPIN0, dt=0.05, steps=40, throw=False)
        return motion.R[-1, 0, 1] + motion.spin[-1] + motion.pi[-1, 2]

    leaves = (jnp.asarray(J), jnp.asarray(AXIS), jnp.asarray(WHEEL), jnp.asarray(FRICTION))
    gradient = jax.jit(jax.grad(final))(leaves)
    value = jax.jit(final)
    for i in range(4):
        change = 1e-5 * jnp.ones_like(leaves[i])
        ends = [(*leaves[:i], leaves[i] + k * change, *leaves[i + 1 :]) for k in (1, -1)]
        slope = (value(ends[0]) - value(ends[1])) / 2e-5
        np.testing.assert_allclose(jnp.sum(gradient[i]), slope, rtol=1e-7)


def test_single_precision_and_small_bodies():
    scale, single = 1e-12, jnp.float32
    leaves = scale * J, AXIS, scale * WHEEL, scale * FRICTION
    body = lgvi.DampedBody(*(jnp.asarray(leaf, single) for leaf in leaves))
    motion = body.simulate(
        jnp.asarray(R0, single),
        jnp.asarray(scale * PI0, single),
        single(SPIN0),
        dt=single(0.01),
        steps=400,
        save_every=400,
    )
    assert motion.R.dtype == motion.spin.dtype == single
    expected = simulate(400, save_every=400)
    np.testing.assert_allclose(motion.spin, expected.spin, rtol=1e-4)
    np.testing.assert_allclose(motion.R, expected.R, atol=1e-4)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: ANY.DampedBody([1.0, 2.0], AXIS, 0.1, 0.1), ValueError, "`inertia` must have"),
        (lambda: ANY.DampedBody(J, "x", 0.1, 0.1), TypeError, "`axis` must be"),
        (lambda: ANY.DampedBody(J, AXIS, AXIS, 0.1), ValueError, "`wheel_inertia` must have"),
        (lambda: simulate(10, save_every=3), ValueError, "`save_every` must divide"),
        (
            lambda: lgvi.DampedBody(J, AXIS, 3.0, 0.1).simulate(R0, PI0, dt=0.1, steps=1),
            RuntimeError,
            "must be less than what the body has",
        ),
        (
            lambda: lgvi.DampedBody(J, AXIS, -0.1, 0.1).simulate(R0, PI0, dt=0.1, steps=1),
            RuntimeError,
            "`wheel_inertia` must be finite and above 0",
        ),
        (
            lambda: lgvi.DampedBody(J, AXIS, 0.1, -0.1).simulate(R0, PI0, dt=0.1, steps=1),
            RuntimeError,
            "`friction` must be finite and not below 0, but is -0.1",
        ),
        (
            lambda: lgvi.DampedBody(J, 0 * AXIS, 0.1, 0.1).simulate(R0, PI0, dt=0.1, steps=1),
            RuntimeError,
            "`axis` must be finite and not zero",
        ),
        (lambda: BODY.simulate(R0, PI0, dt=-0.1, steps=1), RuntimeError, "`dt` must be finite and"),
        (lambda: BODY.simulate(R0, np.nan * PI0, dt=0.1, steps=1), RuntimeError, "`pi0` must be"),
        (
            lambda: lgvi.DampedBody(-J, AXIS, 0.1, 0.1).simulate(R0, PI0, dt=0.1, steps=1),
            RuntimeError,
            "must be symmetric and positive definite",
        ),
        (lambda: BODY.simulate(2 * R0, PI0, dt=0.1, steps=1), RuntimeError, "`R0` must be a rot"),
        (lambda: BODY.simulate(R0, 100 * PI0, dt=0.1, steps=1), RuntimeError, "smaller `dt`"),
    ],
)
def test_wrong_arguments_are_named(call, error, words):
    with pytest.raises(error, match=words):
        call()


def test_where_nothing_is_raised_the_failure_is_told():
    motion = BODY.simulate(R0, 100 * PI0, dt=0.1, steps=2, throw=False)
    assert not np.any(motion.converged)
