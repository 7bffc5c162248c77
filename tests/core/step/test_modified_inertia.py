"""Free motion of high order."""

import math
from decimal import Decimal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.core.step.modified_inertia import ORDERS, modified_inertia, series

from ...derivatives import assert_second_derivatives_agree
from ...systems import FLAT, GENERIC, R0, SYMMETRIC_TOP, euler_equations, rng
from .. import decimal_motion as exact

J, PI0 = exact.numbers(exact.INERTIA), exact.numbers(exact.MOMENTUM)


@exact.digits
def coefficients(order, J, pi):
    """Coefficients of alpha and beta, in the unit of the inertia."""
    trace = sum(row[i] for i, row in enumerate(J))
    of_unit_trace = [[x / trace for x in row] for row in J], [x / trace for x in pi]
    u, w, s, q = exact.variables(*of_unit_trace)
    exponents, numerators, denominators = series(order)
    powers = [(u, w, 1 + q * s, s, q)[i] ** np.arange(order) for i in range(5)]
    products = [math.prod(x[n] for x, n in zip(powers, row, strict=True)) for row in exponents]
    alpha, beta = numerators @ np.array(products, object) / denominators
    return list(zip(alpha, beta / trace, strict=True))


SERIES = {order: coefficients(order, J, PI0) for order in ORDERS}
simulate = jax.jit(lgvi.simulate_free_rigid_body, static_argnames=("steps", "order"))
slow = pytest.mark.slow
MANY = 500


def distance(a, b):
    return np.max(np.abs(np.asarray(a) - np.asarray(b)))


def test_the_reference_is_what_it_was():
    after = exact.exact_motion(J, PI0, Decimal(1))
    stored = exact.R_AFTER, exact.MOMENTUM_AFTER
    for computed, desired in zip(after, stored, strict=True):
        assert distance(computed, exact.numbers(desired)) < Decimal("1e-24")


@pytest.mark.parametrize("order", ORDERS)
def test_the_order_in_many_digits(order):
    reference = exact.exact_motion(J, PI0, Decimal(1))
    errors = [
        [distance(x, y) for x, y in zip(motion, reference, strict=True)]
        for motion in (exact.discrete_motion(J, PI0, Decimal(1), n, SERIES[order]) for n in (8, 16))
    ]
    for coarse, fine in zip(*errors, strict=True):
        assert float((coarse / fine).ln() / Decimal(2).ln()) == pytest.approx(order, abs=0.01)


# What depends on the order does not depend on whether all steps are of one size.
IN_THE_ORDINARY_RUN = {"one size": (2, 4), "sizes": (2, 12)}


@pytest.mark.parametrize(
    ("order", "sizes"),
    [
        pytest.param(order, sizes, marks=() if order in orders else slow)
        for sizes, orders in IN_THE_ORDINARY_RUN.items()
        for order in ORDERS
    ],
)
def test_the_library_takes_these_steps(order, sizes):
    inertia, pi0 = (jnp.asarray(np.array(x, float)) for x in (J, PI0))
    for steps in (2, 8):  # of one compiled program for MANY, which goes on where few are enough
        R, pi = exact.discrete_motion(J, PI0, Decimal(1), steps, SERIES[order])
        dt = np.full(() if sizes == "one size" else MANY, 1 / steps)
        Rs, pis, info = simulate(np.eye(3), pi0, inertia, dt, steps=MANY, order=order)
        assert np.all(info.converged[:steps])
        np.testing.assert_allclose(Rs[steps], np.array(R, float), rtol=0, atol=2e-15)
        np.testing.assert_allclose(pis[steps], np.array(pi, float), rtol=0, atol=4e-15)


@pytest.mark.parametrize("order", [2, pytest.param(6, marks=slow), 12])
@pytest.mark.parametrize("body", [GENERIC, SYMMETRIC_TOP, FLAT], ids=["generic", "top", "flat"])
def test_steps_of_all_orders_conserve_energy_and_momentum(body, order):
    pi0 = jnp.asarray(body @ np.array([0.3, 0.5, -0.4]))
    dt = jnp.asarray(rng(101).uniform(0.2, 0.6, MANY))
    Rs, pis, info = simulate(R0, pi0, jnp.asarray(body), dt, steps=MANY, order=order)
    assert np.all(info.converged)
    energy = np.einsum("ni,ni->n", pis, np.linalg.solve(body, pis.T).T)
    np.testing.assert_allclose(energy, energy[0], rtol=2e-14)
    spatial = np.einsum("nij,nj->ni", Rs, pis)
    np.testing.assert_allclose(spatial, spatial[:1].repeat(MANY + 1, 0), rtol=0, atol=2e-14)


def test_in_float32_too():
    arguments = [jnp.asarray(x, jnp.float32) for x in (np.eye(3), np.array(PI0, float))]
    inertia = jnp.asarray(np.array(J, float), jnp.float32)
    R = simulate(*arguments, inertia, 0.25, steps=4, order=8)[0][-1]
    assert R.dtype == jnp.float32
    np.testing.assert_allclose(R, np.array(exact.R_AFTER, float), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "dt",
    [
        pytest.param(0.3, id="one step", marks=slow),
        pytest.param(np.linspace(0.2, 0.4, 5), id="each step"),
    ],
)
def test_derivatives(dt):
    weights = jnp.asarray(rng(102).normal(size=(6, 3, 3)))

    def scalar(x):
        inertia = jnp.asarray(GENERIC) + jnp.diag(x[:3])
        Rs, pis, _ = simulate(R0, x[3:6], inertia, x[6] * jnp.asarray(dt), steps=5, order=6)
        return jnp.sum(weights * Rs) + jnp.sum(jnp.sin(pis))

    x = jnp.concatenate([jnp.zeros(3), jnp.asarray([0.7, 0.9, -0.5]), jnp.ones(1)])
    size = 1e-5

    # The same program at the point and about it: there is less to compile than of two.
    def at(x):
        value, backward = jax.value_and_grad(scalar)(x)
        return value, backward, jax.jacfwd(scalar)(x)

    about = np.concatenate([np.zeros((1, 7)), size * np.eye(7), -size * np.eye(7)])
    values, (backward, *_), (forward, *_) = jax.jit(jax.vmap(at))(x[None] + about)
    numeric = (values[1:8] - values[8:]) / (2 * size)
    np.testing.assert_allclose(backward, forward, rtol=0, atol=1e-13 * np.max(np.abs(forward)))
    np.testing.assert_allclose(forward, numeric, rtol=0, atol=1e-8 * np.max(np.abs(forward)))


@slow
def test_second_derivatives():
    def modified(J, pi, h):
        return modified_inertia((J + J.T) / 2, pi, h, 8)

    bodies = jnp.asarray([GENERIC, 0.3 * GENERIC + 0.1 * np.eye(3)])  # of different size
    pi, h = jnp.asarray([[0.7, 0.9, -0.5], [0.1, -0.3, 0.2]]), jnp.asarray([0.3, 0.2])
    assert_second_derivatives_agree(modified, bodies, pi, h, rtol=1e-9)


BODY = np.array(J, float)


def fitted_moments(order, h, steps):
    """Principal moments fitted to the exact attitudes of a body, which starts at 1 rad/s."""
    omega = np.array([1.0, 0.2, 0.2])
    pi0 = BODY @ omega / np.linalg.norm(omega)
    reference, _ = euler_equations(R0, pi0, BODY, h * np.arange(steps + 1))
    rows, columns = np.triu_indices(3)

    def residual(entries):
        inertia = jnp.zeros((3, 3)).at[rows, columns].set(entries)
        inertia = inertia + jnp.triu(inertia, 1).T
        Rs = simulate(R0, pi0, inertia, h, steps=steps, order=order)[0]
        return ((Rs - reference).ravel(),) * 2

    evaluate = jax.jit(jax.jacfwd(residual, has_aux=True))
    entries = jnp.asarray(BODY[rows, columns])
    for _ in range(4):
        jacobian, value = evaluate(entries)
        entries = entries - jnp.linalg.lstsq(jacobian, value)[0]
    fitted = np.zeros((3, 3))
    fitted[rows, columns] = entries
    return np.linalg.eigvalsh(fitted + np.triu(fitted, 1).T)


@slow
def test_order_two_biases_an_identified_inertia_and_order_six_does_not():
    true = np.linalg.eigvalsh(BODY)
    bias = fitted_moments(2, 0.19, 100) / true - 1
    assert np.all((np.abs(bias) > 0.004) & (np.abs(bias) < 0.0065)), bias
    assert np.max(np.abs(fitted_moments(6, 0.19, 100) / true - 1)) < 1e-5


def test_wrong_orders_are_refused():
    state = jnp.eye(3), jnp.ones(3), GENERIC
    for order in (1, 3, 14):
        with pytest.raises(ValueError, match=f"`order` must be .*, but is {order}"):
            lgvi.simulate_free_rigid_body(*state, 0.1, 2, order=order)


@pytest.mark.parametrize(
    "order", [4, *(pytest.param(order, marks=slow) for order in (6, 8, 10)), 12]
)
def test_a_turn_by_more_than_a_right_angle_has_not_converged(order):
    """The equation has a solution even so, but it is not the motion's."""
    J, axis = jnp.asarray(GENERIC), np.linalg.eigh(GENERIC)[1][:, 0]

    @jax.jit
    def step_has_converged(angle, pi):
        quiet = lgvi.MoserVeselovIntegrator(angle, tolerance=1e-8, throw=False, order=order)
        return quiet.step(lgvi.RigidBody(J), R0, pi)[2].converged

    for angle in (1.2, 1.65, 3.0):
        dt = jnp.asarray([0.1, angle, 0.1])
        info = simulate(R0, jnp.asarray(GENERIC @ axis), J, dt, steps=3, order=order)[2]
        assert list(info.converged) == [True, angle < np.pi / 2, True]
        assert step_has_converged(angle, GENERIC @ axis) == (angle < np.pi / 2)


def thin_bodies(count):
    """Moments of rods, plates and others, parts of the trace, with ratios down to 1e-4."""
    random = rng(103)
    thin = 10 ** random.uniform(-4, 0, (count, 2)) * random.uniform(size=(count, 2))
    second = np.concatenate([np.ones((count, 1)), thin], axis=1)  # moments of the discrete inertia
    second[count // 2 :, 1] = random.uniform(size=count - count // 2)
    moments = np.sum(second, axis=1, keepdims=True) - second
    return moments / np.sum(moments, axis=1, keepdims=True)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_series_of_a_thin_body_does_not_cancel(dtype):
    order, bodies = 12, 200
    moments = thin_bodies(bodies).astype(dtype)
    omega = rng(104).normal(size=(bodies, 3))
    omega *= rng(105).uniform(0, 1, (bodies, 1)) / np.linalg.norm(omega, axis=1, keepdims=True)
    pi = moments * omega.astype(dtype)

    @jax.jit
    @jax.vmap
    def factor(moments, pi):
        return jnp.diag(modified_inertia(jnp.diag(moments), pi, jnp.ones((), dtype), order))

    found = factor(moments, pi) / moments
    for own, p, ratio in zip(moments.tolist(), pi.tolist(), found, strict=True):
        J = [[Decimal(own[i]) * (i == j) for j in range(3)] for i in range(3)]
        pairs = coefficients(order, J, [Decimal(x) for x in p])
        alpha, beta = (sum(map(Decimal, pair)) for pair in zip(*pairs, strict=True))
        desired = [float(1 / (1 + alpha + beta * row[i])) for i, row in enumerate(J)]
        np.testing.assert_allclose(ratio, desired, rtol=8 * float(np.finfo(dtype).eps))


@pytest.mark.parametrize("order", [4, pytest.param(12, marks=slow)])
def test_units_do_not_matter(order):
    """By powers of two, so that nothing is rounded otherwise."""
    weights, omega = rng(106).normal(size=(6, 3, 3)).astype(np.float32), [0.2, 0.15, -0.17]

    @jax.jit
    @jax.value_and_grad
    def loss(arguments):
        J, pi, h = arguments
        R, _, info = lgvi.simulate_free_rigid_body(
            jnp.eye(3, dtype=J.dtype), pi, J, h, steps=5, tolerance=None, order=order
        )
        return jnp.sum(weights * R) + jnp.where(jnp.all(info.converged), 0, jnp.nan)

    J = np.asarray(GENERIC / np.trace(GENERIC), np.float32)
    at_unity = J, (J @ np.asarray(omega, np.float32)), np.float32(1)
    desired, gradient = loss(at_unity)
    for of_inertia in (-66, -20, 46):
        for of_time in (-30, -10, 20):
            units = [np.float32(2.0**n) for n in (of_inertia, of_inertia - of_time, of_time)]
            value, found = loss([x * unit for x, unit in zip(at_unity, units, strict=True)])
            assert value == desired
            for x, y, unit in zip(found, gradient, units, strict=True):
                np.testing.assert_allclose(x * unit, y, rtol=1e-5)
