"""`free_motion` as users call it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import GENERIC, PI0, R0, physical_inertias

BODY = lgvi.RigidBody(GENERIC)
TIMES = np.array([2.0, -1.0, 0.0])
simulate = jax.jit(lgvi.simulate_free_rigid_body, static_argnames=("steps", "order"))


@jax.jit
def motion(body, R0, pi0, times):
    return lgvi.free_motion(body, R0, pi0, times)


def test_times_in_any_order_and_one_time():
    R, pi = motion(BODY, R0, PI0, TIMES)
    assert (R.shape, pi.shape) == ((3, 3, 3), (3, 3))
    np.testing.assert_allclose(R[2], R0, rtol=0, atol=1e-15)
    np.testing.assert_allclose(pi[2], PI0, rtol=0, atol=1e-15)
    R_one, pi_one = motion(BODY, R0, PI0, 2.0)
    assert (R_one.shape, pi_one.shape) == ((3, 3), (3,))
    np.testing.assert_allclose(R_one, R[0], rtol=0, atol=2e-15)
    np.testing.assert_allclose(pi_one, pi[0], rtol=0, atol=2e-15)
    # Back from the second state, by the motion of the negative time.
    R_back, pi_back = motion(BODY, R[1], pi[1], -TIMES[1:])
    np.testing.assert_allclose(R_back[0], R0, rtol=0, atol=4e-15)
    np.testing.assert_allclose(pi_back[0], PI0, rtol=0, atol=4e-15)


@pytest.mark.parametrize(
    "order", [2, *(pytest.param(order, marks=pytest.mark.slow) for order in (4, 6, 8, 10)), 12]
)
def test_steps_of_every_order_approach_it(order):
    pi0, steps, end = 4 * PI0, 32, 4.0
    exact = motion(BODY, R0, pi0, np.array([end / 2, end / 2, end]))[0]
    errors = []
    for dt in (end / steps, end / steps / 2):
        R = simulate(R0, pi0, GENERIC, dt, steps=steps, order=order)[0]
        errors.append(np.max(np.abs(R[round(end / 2 / dt)] - exact[0])))
    assert errors[1] < 1e-13 or np.log2(errors[0] / errors[1]) > order - 0.5


def test_momentum_and_energy_of_a_batch_of_bodies_are_conserved():
    inertias = physical_inertias(5, 3, ratio=0.2)
    bodies = jax.vmap(lgvi.RigidBody)(inertias)
    R, pi = jax.vmap(motion, in_axes=(0, None, None, None))(bodies, R0, PI0, TIMES)
    spatial = np.einsum("btij,btj->bti", R, pi)
    np.testing.assert_allclose(spatial, np.broadcast_to(R0 @ PI0, spatial.shape), atol=3e-15)
    energies = jax.vmap(lambda body, pi: jax.vmap(body.energy)(pi))(bodies, pi)
    initial = jax.vmap(lambda body: body.energy(PI0))(bodies)
    np.testing.assert_allclose(energies, np.tile(initial[:, None], 3), rtol=3e-15)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"R0": 2 * R0}, "`R0` must be a rotation"),
        ({"pi0": np.array([1.0, np.nan, 0])}, "`pi0` must be finite"),
        ({"times": np.array([0.0, np.inf, 1])}, "`times` must be finite, but entry 1 is inf"),
        ({"body": lgvi.RigidBody(-GENERIC)}, "symmetric and positive definite"),
    ],
)
def test_impossible_values_raise(changed, message):
    given = {"body": BODY, "R0": R0, "pi0": PI0, "times": TIMES} | changed
    with pytest.raises(RuntimeError, match=message):
        lgvi.free_motion(**given)
    with pytest.raises(RuntimeError, match="A value failed a check inside a compiled"):
        jax.block_until_ready(motion(**given))


@pytest.mark.parametrize("unit", [1e-30, 1e30])
def test_any_unit(unit, dtype):
    """Of the momentum and the time, at which squares would overflow in float32."""
    arrays = (jnp.asarray(x, dtype) for x in (GENERIC, R0, PI0 * unit, TIMES / unit))
    J, start, pi0, times = arrays
    R, pi = motion(lgvi.RigidBody(J), start, pi0, times)
    wanted_R, wanted_pi = motion(BODY, R0, PI0, TIMES)
    rounding = 30 * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(R, wanted_R, rtol=0, atol=rounding)
    np.testing.assert_allclose(pi / unit, wanted_pi, rtol=0, atol=rounding)


def test_rotors_are_refused():
    with pytest.raises(ValueError, match="`body` must have no rotors, but is a Gyrostat"):
        lgvi.free_motion(lgvi.Gyrostat(GENERIC, jnp.ones(3)), R0, PI0, TIMES)


@pytest.mark.slow
def test_second_derivatives_with_respect_to_state_and_times():
    """By differences of first derivatives."""

    def along(s):
        R, pi = lgvi.free_motion(BODY, R0, PI0 + s * jnp.array([0.3, -0.2, 0.5]), TIMES * (1 + s))
        return jnp.sum(R[0] * GENERIC) + jnp.sum(pi**2 * GENERIC)

    def compiled(function):  # in a third of the time
        options = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0}
        return jax.jit(function).lower(0.0).compile(compiler_options=options)

    slope, h = compiled(jax.jacfwd(along)), 1e-5
    second = compiled(jax.jacfwd(jax.jacfwd(along)))(0.0)
    np.testing.assert_allclose(second, (slope(h) - slope(-h)) / (2 * h), rtol=1e-7)
