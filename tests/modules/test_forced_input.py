"""What a simulation under laws is given: precisions, kinds of functions, bad input."""

from dataclasses import dataclass
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import GENERIC, PI0, R0

BODY = lgvi.RigidBody(jnp.asarray(GENERIC))
VECTOR, OFFSET = np.array([0.3, -0.2, 0.1]), np.array([0.1, 0.2, 1.0])
DAMPING = np.eye(3)
GRAVITY = lgvi.UniformGravity(1.3, OFFSET, 1.0)
RAISED = (RuntimeError, eqx.EquinoxRuntimeError)


@pytest.mark.parametrize("frozen", [False, True])
def test_a_law_that_cannot_be_hashed(frozen):
    @dataclass(frozen=frozen)  # a frozen one has a hash method, which fails
    class Law:
        torque: np.ndarray

        def __call__(self, t, R):
            return jnp.asarray(self.torque)

    method = lgvi.MoserVeselovIntegrator(0.1)
    for torque in (VECTOR, 2 * VECTOR):
        actual = method.simulate(BODY, R0, PI0, steps=4, torque=Law(torque))
        desired = method.simulate(BODY, R0, PI0, body_torques=np.stack([torque] * 5))
        np.testing.assert_allclose(actual.pi, desired.pi, rtol=0, atol=1e-14)


@cache
def in_double_precision(order):
    method = lgvi.MoserVeselovIntegrator(0.1, order=order)
    return method.simulate(BODY, R0, PI0, steps=10, torque=GRAVITY)


@pytest.mark.parametrize(
    ("dtype", "order"),
    [
        (jnp.float32, 2),
        (jnp.float64, 2),
        pytest.param(jnp.float32, 4, marks=pytest.mark.slow),
        pytest.param(jnp.float64, 4, marks=pytest.mark.slow),
        pytest.param(jnp.float32, 6, marks=pytest.mark.slow),
        pytest.param(jnp.float64, 6, marks=pytest.mark.slow),
    ],
)
def test_the_precision_is_that_of_all_that_is_given(dtype, order):
    law = jax.tree.map(lambda x: x.astype(dtype), GRAVITY)
    body = lgvi.RigidBody(jnp.asarray(GENERIC, jnp.float32))
    state = jnp.asarray(R0, jnp.float32), jnp.asarray(PI0, jnp.float32)
    method = lgvi.MoserVeselovIntegrator(0.1, order=order)
    with jax.numpy_dtype_promotion("standard"):
        R, pi, info = method.simulate(body, *state, steps=10, torque=law)
    assert R.dtype == pi.dtype == info.residual_norm.dtype == dtype
    np.testing.assert_allclose(pi, in_double_precision(order).pi, rtol=0, atol=2e-5)


def test_no_steps():
    method = lgvi.MoserVeselovIntegrator(0.1)
    for law in (GRAVITY, lgvi.ConstantTorque(VECTOR)):
        R, pi, info = method.simulate(BODY, R0, PI0, steps=0, torque=law)
        np.testing.assert_array_equal(R, R0[None])
        np.testing.assert_array_equal(pi, PI0[None])
        assert info.converged.shape == (0,)


@pytest.mark.parametrize("order", [2, 4, 8])
def test_a_step_without_a_solution_is_named(order):

    def law(t, R):
        return jnp.where(t > 0.45, 1e4, 0.0) * jnp.asarray(VECTOR)

    method = lgvi.MoserVeselovIntegrator(0.1, order=order)
    with pytest.raises(RAISED, match=r"Step [45] did not converge"):
        method.simulate(BODY, R0, PI0, steps=8, torque=law)
    quiet = lgvi.MoserVeselovIntegrator(0.1, order=order, throw=False)
    info = quiet.simulate(BODY, R0, PI0, steps=8, torque=law).solver_info
    assert info.converged.shape == (8,)
    assert np.all(info.converged[:4])
    assert not np.all(info.converged)


SAMPLED = lgvi.SampledTorque(np.array([0.0, 1.0]), np.stack([VECTOR, VECTOR]))


@pytest.mark.parametrize(
    ("given", "settings", "error", "message"),
    [
        ({"torque": 1.0}, {}, TypeError, r"`torque` .* of \(t, R\) or \(t, R, omega\), but is 1.0"),
        ({"torque": lambda t: t}, {}, TypeError, "`torque` must be .*too many positional"),
        ({"controller": VECTOR}, {}, TypeError, r"`controller` must be a function of \(t, R, pi\)"),
        ({"controller": GRAVITY}, {}, TypeError, "`controller` must be .*too many positional"),
        ({"torque": lgvi.UniformGravity}, {}, TypeError, "`torque` must be a function.*class"),
        ({"torque": lambda t, R, pi: pi}, {}, TypeError, "`pi` where `omega` is given"),
        ({"torque": lambda R, t: R[0]}, {}, TypeError, "`R` where `t` is given"),
        ({"controller": lambda t, R, omega: omega}, {}, TypeError, "`omega` where `pi` is given"),
        ({"torque": SAMPLED, "t0": np.zeros(2)}, {}, ValueError, "`t0` must have shape"),
        ({"torque": lambda t, R: R}, {}, ValueError, r"`torque\(t, R\)` must have shape \(3,\)"),
        ({"torque": lambda t, R: None}, {}, TypeError, r"`torque\(t, R\)` must be an array"),
        (
            {"controller": lambda t, R, pi: 1.0},
            {},
            ValueError,
            r"`controller\(t, R, pi\)` must have shape \(3,\)",
        ),
        ({"torque": GRAVITY}, {"order": 10}, ValueError, r"`order` must be one of \(2, 4, 6, 8\)"),
        (
            {"torque": SAMPLED},
            {"order": 4},
            ValueError,
            "`SampledTorque` `order` .* at most 2.*kinks",
        ),
        (
            {"torque": GRAVITY + lgvi.LinearDamping(DAMPING)},
            {"order": 4},
            ValueError,
            "`LinearDamping` `order` must be at most 2.*back in time",
        ),
        (
            {"torque": GRAVITY + (lambda t, R, omega: omega)},
            {"order": 4},
            ValueError,
            r"`function of \(t, R, omega\)` `order` must be at most 2",
        ),
        (
            {"torque": lambda t, R, omega: 1.0},
            {},
            ValueError,
            r"`torque\(t, R, omega\)` must have shape \(3,\)",
        ),
        (
            {"torque": GRAVITY, "body_torques": np.zeros((5, 3))},
            {},
            ValueError,
            "`body_torques` must be None",
        ),
        ({"body_torques": np.zeros((5, 3))}, {"order": 4}, ValueError, "`body_torques` needs"),
        ({"torque": SAMPLED, "t0": 0.7}, {}, RAISED, r"from 0.7 to 1.1 s, but go from 0 to 1 s"),
        ({"torque": SAMPLED, "t0": -0.1}, {}, RAISED, r"from -0.1 to 0.3 s"),
        (
            {"torque": lgvi.SampledTorque(np.array([0.0, 2.0, 1.0]), np.zeros((3, 3)))},
            {},
            RAISED,
            r"must increase, but t\[1\] is 2 and t\[2\] is 1",
        ),
    ],
)
def test_bad_input_is_named(given, settings, error, message, unchecked):
    method = lgvi.MoserVeselovIntegrator(0.1, **settings)
    with pytest.raises(error, match=message):
        method.simulate(BODY, R0, PI0, steps=4, **given)


def test_samples_that_are_left_on_the_way_are_missed():
    there_and_back = np.array([0.9, 0.9, -0.9, -0.9])
    with pytest.raises(RAISED, match=r"from 0 to 1.8 s"):
        lgvi.MoserVeselovIntegrator(there_and_back).simulate(BODY, R0, PI0, torque=SAMPLED)
    quiet = lgvi.MoserVeselovIntegrator(0.2, throw=False)
    info = quiet.simulate(BODY, R0, PI0, steps=10, torque=SAMPLED).solver_info
    assert not np.any(info.converged)


def test_a_last_impulse_that_is_no_number_is_seen():
    def law(t, R):
        return jnp.where(t > 0.35, jnp.nan, 1.0) * R[0]

    samples = np.where(np.arange(5)[:, None] < 4, VECTOR, np.nan)
    method = lgvi.MoserVeselovIntegrator(0.1, throw=False)
    for trajectory in (
        method.simulate(BODY, R0, PI0, steps=4, torque=law),
        method.simulate(BODY, R0, PI0, body_torques=samples),
    ):
        converged = trajectory.solver_info.converged
        np.testing.assert_array_equal(converged, [True, True, True, False])


def test_samples_may_be_left_by_rounding_only():
    method = lgvi.MoserVeselovIntegrator(0.1)
    method.simulate(BODY, R0, PI0, steps=10, torque=SAMPLED)  # 10 x 0.1 is not exactly 1
    shorter = lgvi.MoserVeselovIntegrator(0.03)
    shorter.simulate(BODY, R0, PI0, steps=10, torque=SAMPLED, t0=0.7 + 1e-12)
    backwards = lgvi.MoserVeselovIntegrator(-0.1)
    backwards.simulate(BODY, R0, PI0, steps=10, torque=SAMPLED, t0=1.0)
