"""Bodies whose inertia is known in time."""

from decimal import Decimal, localcontext
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.identification import Model
from lgvi.plotting import plot_polhode

from ..systems import GENERIC, PI0, R0, rng

ANY: Any = lgvi  # whose arguments a type checker does not know
# The inverse of the inertia is diagonal, and linear in time.
START, RATE = (1.0, 0.6, 0.4), (0.5, -0.2, 0.3)
SPAN = 1.5
MANY = 5000


def inertias(steps, span=SPAN):
    middle = (np.arange(steps) + 0.5) * span / steps
    inverse = np.array(START) + middle[:, None] * np.array(RATE)
    return jnp.asarray(np.stack([np.diag(1 / x) for x in inverse]))


def reference(span, pieces=30, terms=40):
    """The momentum and the attitude by Taylor series, with 40 digits of which 30 are right."""
    with localcontext() as context:
        context.prec = 40
        zero, h = Decimal(0), Decimal(str(span)) / pieces
        y = [[Decimal(float(x)) for x in row] for row in (PI0, *R0)]  # and the rows of R
        for piece in range(pieces):
            at = [
                Decimal(str(x)) + Decimal(str(v)) * h * piece
                for x, v in zip(START, RATE, strict=True)
            ]
            series, omega = [y], []
            for n in range(terms):
                pi, before = series[n][0], series[n - 1][0] if n else [zero] * 3
                omega.append(
                    [
                        a * x + Decimal(str(v)) * b
                        for a, v, x, b in zip(at, RATE, pi, before, strict=True)
                    ]
                )
                derivative = [[zero] * 3 for _ in y]
                for row in range(4):  # each row r of (pi, R) has the derivative r x omega
                    for k in range(n + 1):
                        r, w = series[k][row], omega[n - k]
                        for i in range(3):
                            j, m = (i + 1) % 3, (i + 2) % 3
                            derivative[row][i] += r[j] * w[m] - r[m] * w[j]
                series.append([[x / (n + 1) for x in row] for row in derivative])
            y = [
                [sum(c[row][i] * h**n for n, c in enumerate(series)) for i in range(3)]
                for row in range(4)
            ]
        return np.array(y[0], float), np.array(y[1:], float)


def simulate(steps, dtype=jnp.float64, **options):
    body = lgvi.VaryingRigidBody(inertias(steps).astype(dtype))
    integrator = lgvi.MoserVeselovIntegrator(dt=jnp.asarray(SPAN / steps, dtype))
    return integrator.simulate(body, jnp.asarray(R0, dtype), jnp.asarray(PI0, dtype), **options)


def test_states_are_of_order_two_and_the_momentum_in_space_is_kept():
    pi, R = reference(SPAN)
    errors = []
    for steps in (50, 100, 200):
        motion = simulate(steps)
        errors.append([np.max(abs(motion.pi[-1] - pi)), np.max(abs(motion.R[-1] - R))])
        momenta = jnp.einsum("nij,nj->ni", motion.R, motion.pi)
        np.testing.assert_allclose(momenta, np.tile(R0 @ PI0, (steps + 1, 1)), atol=2e-14)
    orders = np.log2(np.array(errors)[:-1] / np.array(errors)[1:])
    np.testing.assert_allclose(orders, 2, atol=0.05)
    assert np.max(errors[-1]) < 1e-3


def test_an_inertia_that_stays_is_that_of_a_rigid_body():
    repeated = jnp.tile(jnp.asarray(GENERIC), (50, 1, 1))
    integrator = lgvi.MoserVeselovIntegrator(dt=0.05)
    varying = integrator.simulate(lgvi.VaryingRigidBody(repeated), R0, PI0)
    rigid = integrator.simulate(lgvi.RigidBody(jnp.asarray(GENERIC)), R0, PI0, steps=50)
    for one, other in zip(varying[:2], rigid[:2], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-13)


def test_long_trajectories_keep_the_momentum_and_store_some_states():
    all_states, some = simulate(MANY), simulate(MANY, save_every=100)
    assert bool(jnp.all(some.solver_info.converged))
    np.testing.assert_allclose(some.R, all_states.R[::100], atol=1e-12)
    momenta = jnp.einsum("nij,nj->ni", some.R, some.pi)
    np.testing.assert_allclose(momenta, np.tile(R0 @ PI0, (len(momenta), 1)), atol=1e-12)


def test_torques_of_time_change_the_momentum_by_their_impulses():
    steps, h = 40, SPAN / 40
    torques = rng(8).normal(size=(steps + 1, 3))
    motion = simulate(steps, body_torques=torques)
    momenta = np.einsum("nij,nj->ni", motion.R, motion.pi)
    in_space = np.einsum("nij,nj->ni", motion.R, torques)
    np.testing.assert_allclose(
        np.diff(momenta, axis=0), h / 2 * (in_space[1:] + in_space[:-1]), atol=1e-13
    )
    law = lgvi.SampledTorque(h * np.arange(steps + 1), torques)
    by_law = simulate(steps, torque=law)
    np.testing.assert_allclose(by_law.pi, motion.pi, atol=1e-12)


def test_derivatives_are_exact():
    integrator = lgvi.MoserVeselovIntegrator(dt=SPAN / 30)
    direction = rng(9).normal(size=(30, 3, 3))
    direction = direction + direction.transpose(0, 2, 1)

    def final(size):
        body = lgvi.VaryingRigidBody(inertias(30) + size * direction)
        motion = integrator.simulate(body, R0, PI0)
        return motion.R[-1, 0, 1] + motion.pi[-1, 2]

    h = 1e-5
    change = (final(h) - final(-h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(final)(0.0), change, rtol=1e-7)


def test_single_precision_stays():
    motion = simulate(40, jnp.float32)
    assert motion.R.dtype == motion.pi.dtype == jnp.float32
    np.testing.assert_allclose(motion.pi, simulate(40).pi, atol=1e-5)


BODY = lgvi.VaryingRigidBody(inertias(10))
STEP = lgvi.MoserVeselovIntegrator(dt=0.05)
BATCH = eqx.filter_vmap(lgvi.RigidBody)(inertias(10))


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: ANY.VaryingRigidBody(GENERIC), ValueError, r"must have shape \(steps, 3, 3\)"),
        (lambda: ANY.VaryingRigidBody(np.zeros((0, 3, 3))), ValueError, "at least one step"),
        (lambda: STEP.simulate(BODY, R0, omega0=PI0), ValueError, "`pi0` must be given"),
        (lambda: STEP.simulate(BODY, R0, PI0, steps=9), ValueError, "`inertia` is 10"),
        (
            lambda: STEP.simulate(BODY, R0, PI0, torque=lgvi.UniformGravity(1.0, PI0)),
            ValueError,
            "torques must depend on nothing but time",
        ),
        (
            lambda: lgvi.MoserVeselovIntegrator(dt=0.05, order=4).simulate(BODY, R0, PI0),
            ValueError,
            "`inertia` needs an integrator of order 2",
        ),
        (lambda: STEP.step(BODY, R0, PI0), ValueError, "`body` must have one inertia"),
        (lambda: plot_polhode(BODY, simulate(10)), ValueError, "`body` must have one inertia"),
        (
            lambda: STEP.simulate(BODY, R0, PI0, torque=lgvi.GravityGradient(1.0, PI0)),
            ValueError,
            "`body` must have one inertia",
        ),
        (
            lambda: STEP.simulate(BATCH, R0, PI0, steps=10),
            ValueError,
            r"`body` must have one inertia \(3, 3\).* use `jax.vmap` for batches",
        ),
        (lambda: ANY.free_motion(BODY, R0, PI0, times=[0.0, 1.0]), ValueError, "one inertia"),
        (lambda: ANY_MODEL(BODY, [lgvi.Gyroscope(0.01)]), TypeError, "one inertia"),
        (
            lambda: STEP.simulate(
                lgvi.VaryingRigidBody(inertias(10).at[3, 0, 0].set(-1.0)), R0, PI0
            ),
            RuntimeError,
            "must be symmetric and positive definite, but in step 3 is",
        ),
        (
            lambda: STEP.simulate(lgvi.VaryingRigidBody(inertias(10)), R0, 200 * PI0),
            RuntimeError,
            "Step 0 did not converge",
        ),
    ],
)
def test_wrong_arguments_are_named(call, error, words):
    with pytest.raises(error, match=words):
        call()


ANY_MODEL: Any = Model


def test_where_nothing_is_raised_no_step_has_converged():
    wrong = lgvi.VaryingRigidBody(inertias(10).at[3, 0, 0].set(-1.0))
    motion = lgvi.MoserVeselovIntegrator(dt=0.05, throw=False).simulate(wrong, R0, PI0)
    assert not np.any(motion.solver_info.converged)


def test_bodies_side_by_side():
    bodies = eqx.filter_vmap(lgvi.VaryingRigidBody)(jnp.stack([inertias(10), 2 * inertias(10)]))
    run = eqx.filter_vmap(lambda body: STEP.simulate(body, R0, PI0))(bodies)
    alone = STEP.simulate(lgvi.VaryingRigidBody(2 * inertias(10)), R0, PI0)
    np.testing.assert_allclose(run.R[1], alone.R, atol=1e-14)
