"""The integrator as a module: the functional API with learnable steps."""

import io
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import GENERIC, PI0, R0, physical_inertias, rng

STEPS = 6
DT = 0.1
TORQUES = rng(50).normal(size=(STEPS + 1, 3))
BODY = lgvi.RigidBody(jnp.asarray(GENERIC))


def assert_same(actual, desired):
    """Every leaf is equal, bit for bit."""
    for a, d in zip(jax.tree.leaves(actual), jax.tree.leaves(desired), strict=True):
        np.testing.assert_array_equal(a, d)


@pytest.mark.parametrize("dt", [DT, np.linspace(0.05, 0.15, STEPS)], ids=["scalar", "array"])
def test_simulate_is_the_functional_api(dt):
    integrator = lgvi.MoserVeselovIntegrator(dt, newton_iters=1, tolerance=1e-3, throw=False)
    dt = jnp.asarray(dt)
    settings = (1, 1e-3)  # other results than those of the defaults
    free = integrator.simulate(BODY, R0, PI0, steps=STEPS)
    assert isinstance(free, lgvi.Trajectory)
    assert_same(tuple(free), lgvi.simulate_free_rigid_body(R0, PI0, GENERIC, dt, STEPS, *settings))
    Rs, pis, info = forced = integrator.simulate(BODY, R0, PI0, body_torques=TORQUES)
    assert_same(tuple(forced), lgvi.simulate_rigid_body(R0, PI0, GENERIC, TORQUES, dt, *settings))
    assert Rs is forced.R
    assert pis is forced.pi
    assert info is forced.solver_info
    assert len(forced) == 3
    assert forced[-1] is info


def test_step_is_the_functional_api():
    integrator = lgvi.MoserVeselovIntegrator(DT, newton_iters=1, tolerance=1e-3, throw=False)
    dt, zero = jnp.asarray(DT), np.zeros(3)
    pair = TORQUES[0], TORQUES[1]
    desired = lgvi.rigid_body_step(R0, PI0, GENERIC, *pair, dt, 1, 1e-3)
    assert_same(integrator.step(BODY, R0, PI0, *pair), desired)
    desired = lgvi.rigid_body_step(R0, PI0, GENERIC, zero, zero, dt, 1, 1e-3)
    assert_same(integrator.step(BODY, R0, PI0), desired)


def test_checking_convergence_does_not_change_the_result():
    quiet = lgvi.MoserVeselovIntegrator(DT, throw=False)
    loud = lgvi.MoserVeselovIntegrator(DT, throw=True)
    for integrator in (quiet, loud):
        assert integrator.tolerance is None
    assert_same(
        loud.simulate(BODY, R0, PI0, body_torques=TORQUES),
        quiet.simulate(BODY, R0, PI0, body_torques=TORQUES),
    )
    assert_same(loud.step(BODY, R0, PI0), quiet.step(BODY, R0, PI0))


def test_settings_reach_the_solver():
    def info(**settings):
        integrator = lgvi.MoserVeselovIntegrator(DT, throw=False, **settings)
        return integrator.step(BODY, R0, 8 * PI0)[2]

    assert info(newton_iters=1).residual_norm > 1e3 * info().residual_norm
    assert not info(newton_iters=1).converged
    assert info(newton_iters=1, tolerance=1.0).converged


def test_high_order_is_that_of_the_function_step_by_step_too():
    integrator = lgvi.MoserVeselovIntegrator(DT, order=8)
    trajectory = integrator.simulate(BODY, R0, PI0, steps=3)
    Rs, _, _ = lgvi.simulate_free_rigid_body(R0, PI0, BODY.inertia, DT, 3, order=8)
    np.testing.assert_allclose(trajectory.R, Rs, rtol=0, atol=1e-15)
    plain = lgvi.MoserVeselovIntegrator(DT).simulate(BODY, R0, PI0, steps=3)
    assert np.max(np.abs(plain.R - Rs)) > 1e-6
    state, step = (jnp.asarray(R0), jnp.asarray(PI0)), eqx.filter_jit(integrator.step)
    for R in Rs[1:]:
        *state, _ = step(BODY, *state)
        np.testing.assert_allclose(state[0], R, rtol=0, atol=2e-15)


def test_torques_at_the_states_alone_are_refused_above_order_two():
    integrator = lgvi.MoserVeselovIntegrator(DT, order=4)
    with pytest.raises(ValueError, match=r"`body_torques` needs an integrator of order 2, .* is 4"):
        integrator.simulate(BODY, R0, PI0, body_torques=TORQUES)
    with pytest.raises(ValueError, match="`torque_next` needs an integrator of order 2"):
        integrator.step(BODY, R0, PI0, None, TORQUES[0])


def test_the_number_of_steps_is_given_once():
    scalar = lgvi.MoserVeselovIntegrator(DT)
    array = lgvi.MoserVeselovIntegrator(np.full(STEPS, DT))
    state = BODY, R0, PI0
    for integrator, given in [
        (scalar, {"steps": STEPS}),
        (scalar, {"body_torques": TORQUES}),
        (array, {}),
        (array, {"steps": STEPS, "body_torques": TORQUES}),
    ]:
        shapes = jax.eval_shape(lambda run=integrator.simulate, given=given: run(*state, **given))
        assert shapes.R.shape == (STEPS + 1, 3, 3)
    with pytest.raises(ValueError, match="`steps` must be given"):
        scalar.simulate(*state)
    with pytest.raises(ValueError, match=r"`steps` is 5.* `body_torques` less one is 6"):
        scalar.simulate(*state, steps=5, body_torques=TORQUES)
    with pytest.raises(ValueError, match="`steps` is 5, the length of `dt` is 6"):
        array.simulate(*state, steps=5)
    with pytest.raises(ValueError, match=r"`dt` is 6, .* less one is 4"):
        array.simulate(*state, body_torques=TORQUES[:5])
    with pytest.raises(ValueError, match="`steps` must be at least 0"):
        scalar.simulate(*state, steps=-1)


TIMES = 2.0 + np.cumsum(rng(53).uniform(0.05, 0.3, 5))


def test_states_at_given_times_are_those_of_equal_steps_between_them():
    """In a batch with times of their own, and with derivatives in them."""
    omega0 = jnp.asarray([0.4, -1.0, 0.7])

    def law(t, R):
        return jnp.cos(3 * t) * R[2]

    def entry(times):
        trajectory = lgvi.MoserVeselovIntegrator(throw=False).simulate(
            BODY, R0, omega0=omega0, times=times, substeps=3, torque=law
        )
        return trajectory.R[-1, 0, 1], trajectory

    change, size = rng(54).normal(size=5), 1e-5
    batch = jnp.asarray([TIMES, TIMES + size * change, TIMES - size * change])
    with_gradient = jax.jit(jax.vmap(jax.value_and_grad(entry, has_aux=True)))
    (entries, trajectories), gradients = with_gradient(batch)
    numeric = (entries[1] - entries[2]) / (2 * size)
    np.testing.assert_allclose(gradients[0] @ change, numeric, rtol=1e-8)

    by_sizes = lgvi.MoserVeselovIntegrator(np.repeat(np.diff(TIMES) / 3, 3), throw=False)
    state = BODY, R0, GENERIC @ omega0
    desired = by_sizes.simulate(*state, t0=TIMES[0], save_every=3, torque=law)
    for a, d in zip(jax.tree.leaves(trajectories), jax.tree.leaves(desired), strict=True):
        np.testing.assert_allclose(a[0], d, rtol=0, atol=1e-14)


def test_a_trajectory_has_the_times_of_its_states(dtype):
    pi0 = jnp.asarray(PI0, dtype)
    body, R = lgvi.RigidBody(GENERIC.astype(dtype)), jnp.asarray(R0, dtype)

    def stored(dt, **given):  # of a program of the times alone
        method = lgvi.MoserVeselovIntegrator(dt, throw=False)
        t = jax.jit(lambda: method.simulate(body, R, pi0, **given).t)()
        assert t.dtype == dtype
        return t

    sizes = np.linspace(0.05, 0.15, STEPS, dtype=dtype)
    every = 2.0 + DT * np.arange(STEPS + 1)
    np.testing.assert_allclose(stored(DT, steps=STEPS, t0=2.0), every, rtol=1e-6)
    np.testing.assert_allclose(stored(DT, steps=STEPS, t0=2.0, save_every=3), every[::3], rtol=1e-6)
    every = np.append(0.0, np.cumsum(sizes))
    np.testing.assert_allclose(stored(sizes), every, rtol=1e-6)
    np.testing.assert_allclose(stored(sizes, save_every=2), every[::2], rtol=1e-6)
    np.testing.assert_array_equal(stored(None, times=TIMES.astype(dtype)), TIMES.astype(dtype))


def test_states_at_given_times_are_of_one_number_of_steps(unchecked):
    state, method = (BODY, R0, PI0), lgvi.MoserVeselovIntegrator()
    bodies = BODY, lgvi.Gyrostat(GENERIC, np.zeros((12, 3)))
    for body, torques in zip(bodies, (np.zeros((13, 3)), None), strict=True):
        given = {"times": TIMES, "substeps": 3, "body_torques": torques}
        shapes = jax.eval_shape(
            lambda body=body, given=given: method.simulate(body, R0, PI0, **given)
        )
        assert shapes.R.shape == (5, 3, 3)
        assert shapes.solver_info.converged.shape == (4,)
    with pytest.raises(ValueError, match=r"intervals of `times` is 4, .* less one is 6"):
        method.simulate(*state, times=TIMES, body_torques=TORQUES)
    for name, value in {"steps": 4, "t0": 0.0, "save_every": 1}.items():
        with pytest.raises(ValueError, match=f"`{name}` must be None where there are `times`"):
            method.simulate(*state, times=TIMES, **{name: value})
    for times in (TIMES[:, None], TIMES[:0], 1.0):
        with pytest.raises(ValueError, match=r"`times` must have shape \(states,\)"):
            method.simulate(*state, times=times)
    with pytest.raises(ValueError, match="`substeps` must be at least 1"):
        method.simulate(*state, times=TIMES, substeps=0)
    with pytest.raises(ValueError, match="`substeps` must be 1 without `times`, but is 2"):
        lgvi.MoserVeselovIntegrator(DT).simulate(*state, steps=2, substeps=2)
    with pytest.raises(ValueError, match="`times` must be given where the integrator has no `dt`"):
        method.simulate(*state, steps=4)
    with pytest.raises(ValueError, match="`step` needs a scalar `dt`, but it is None"):
        method.step(*state)


def test_times_that_are_not_in_order_are_an_error(unchecked):
    """Or, where their values are not known, no step converges; but they may decrease."""
    method = lgvi.MoserVeselovIntegrator(throw=False)

    def converged(times):
        return method.simulate(BODY, R0, PI0, times=times).solver_info.converged

    for bad in (TIMES[[0, 1, 3, 2, 4]], np.append(TIMES[:4], np.nan), TIMES[:1] * np.nan):
        with pytest.raises(ValueError, match=r"`times` must be finite and in order, .* but is"):
            converged(bad)
        assert not np.any(jax.jit(converged)(bad))
    for good in (TIMES[::-1], TIMES[[0, 1, 1, 2, 2]]):
        assert np.all(jax.jit(converged)(good))


def test_a_first_attitude_is_a_rotation_without_steps_too(unchecked):
    method = lgvi.MoserVeselovIntegrator(DT)
    with pytest.raises(RuntimeError, match="`R0` must be a rotation matrix"):
        method.simulate(BODY, 2 * R0, PI0, steps=0)
    with pytest.raises(RuntimeError, match="`R0` must be a rotation matrix"):
        method.simulate(BODY, 2 * R0, PI0, times=TIMES[:1])


def test_a_torque_that_is_not_finite_is_named_by_a_step(unchecked):
    with pytest.raises(RuntimeError, match="state at its end is not finite, by a torque"):
        lgvi.MoserVeselovIntegrator(DT).step(BODY, R0, PI0, torque_next=np.array([np.nan, 0, 0]))


def test_the_initial_momentum_or_velocity_is_given(unchecked):
    method = lgvi.MoserVeselovIntegrator(DT)
    with pytest.raises(TypeError, match="`pi0` and `omega0` must be given, but none is"):
        method.simulate(BODY, R0, steps=1)
    with pytest.raises(TypeError, match="`pi0` and `omega0` must be given, but both are"):
        method.simulate(BODY, R0, PI0, omega0=PI0, steps=1)
    with pytest.raises(ValueError, match=r"`omega0` must have shape \(3,\)"):
        method.simulate(BODY, R0, omega0=PI0[:2], steps=1)


def test_no_steps_are_the_initial_state():
    trajectory = lgvi.MoserVeselovIntegrator(DT).simulate(BODY, R0, PI0, steps=0)
    np.testing.assert_array_equal(trajectory.R, R0[None])
    assert trajectory.solver_info.converged.shape == (0,)


def test_wrong_arguments_are_refused(unchecked):
    with pytest.raises(ValueError, match=r"`dt` must have shape \(\) or \(steps,\)"):
        lgvi.MoserVeselovIntegrator(np.ones((2, 2)))
    with pytest.raises(ValueError, match="`newton_iters` must be at least 1, but is 0"):
        lgvi.MoserVeselovIntegrator(DT, newton_iters=0)
    tolerances: Any = (
        (-1, "not below 0, but is -1"),
        (np.nan, "is nan"),
        (np.inf, "finite number not below 0, but is inf"),
        ("1", "number, but is '1'"),
    )
    for tolerance, message in tolerances:
        with pytest.raises((TypeError, ValueError), match=f"`tolerance` must be .*{message}"):
            lgvi.MoserVeselovIntegrator(DT, tolerance=tolerance)
    with pytest.raises(ValueError, match=r"`step` needs a scalar `dt`, but its shape is \(3,\)"):
        lgvi.MoserVeselovIntegrator(np.full(3, DT)).step(BODY, R0, PI0)
    words: Any = "x"
    for torques in ({"torque_k": words}, {"torque_next": words}):
        with pytest.raises(TypeError, match=f"`{next(iter(torques))}` must be an array"):
            lgvi.MoserVeselovIntegrator(DT).step(BODY, R0, PI0, **torques)
    with pytest.raises(ValueError, match="`t0` must be finite, but is nan"):
        lgvi.MoserVeselovIntegrator(DT).simulate(BODY, R0, PI0, steps=2, t0=np.nan)
    integrator = lgvi.MoserVeselovIntegrator(DT)
    with pytest.raises(ValueError, match=r"`body_torques` must have shape \(steps\+1, 3\)"):
        integrator.simulate(BODY, R0, PI0, body_torques=np.ones(3))
    with pytest.raises(ValueError, match=r"`pi0` must have shape \(3,\)"):
        integrator.simulate(BODY, R0, PI0[:2], steps=1)


def test_only_the_step_is_learnable_and_it_is_a_float_array(unchecked):
    steps: Any = (1, 0.5, [1, 2], np.ones(3), jnp.ones((), jnp.float32))
    for dt in steps:
        (leaf,) = jax.tree.leaves(lgvi.MoserVeselovIntegrator(dt))
        assert eqx.is_inexact_array(leaf)
        np.testing.assert_array_equal(leaf, dt)
    integrator = lgvi.MoserVeselovIntegrator(DT)
    with pytest.raises(AttributeError):
        integrator.dt = jnp.ones(())


def test_the_default_tolerance_suits_both_precisions(dtype):
    J = jnp.asarray(physical_inertias(20, 51), dtype)
    omega = 8 * jnp.asarray(rng(52).uniform(-1, 1, (20, 3)) / np.sqrt(3), dtype)

    integrator = lgvi.MoserVeselovIntegrator(jnp.asarray(DT, dtype))

    def one(J, omega):
        R = jnp.eye(3, dtype=dtype)
        return integrator.simulate(lgvi.RigidBody(J), R, J @ omega, steps=STEPS)

    info = eqx.filter_jit(eqx.filter_vmap(one))(J, omega).solver_info
    assert np.all(info.converged)
    # One bound for both would not do.
    assert np.all(info.residual_norm <= 1e-10) == (dtype == jnp.float64)


@pytest.mark.parametrize(
    "dt",
    [
        pytest.param(DT, id="scalar", marks=pytest.mark.slow),
        pytest.param(np.linspace(0.05, 0.15, STEPS), id="array"),
    ],
)
def test_gradient_in_the_step_and_in_the_body(dt):
    dt, J = jnp.asarray(dt), jnp.asarray(GENERIC)

    @eqx.filter_jit
    @eqx.filter_grad
    def gradient(model):
        integrator, body = model
        return integrator.simulate(body, R0, PI0, body_torques=TORQUES).R[-1, 0, 1]

    def entry(dt, J):
        return lgvi.simulate_rigid_body(R0, PI0, J, TORQUES, dt)[0][-1, 0, 1]

    by_dt, by_body = gradient((lgvi.MoserVeselovIntegrator(dt), BODY))
    by_step, by_inertia = jax.jit(jax.grad(entry, argnums=(0, 1)))(dt, J)
    np.testing.assert_allclose(by_dt.dt, by_step, rtol=0, atol=1e-14)
    np.testing.assert_allclose(by_body.inertia, by_inertia, rtol=0, atol=1e-14)


def test_the_integrator_is_saved_and_loaded():
    integrator = lgvi.MoserVeselovIntegrator(DT, newton_iters=5)
    file = io.BytesIO()
    eqx.tree_serialise_leaves(file, integrator)
    file.seek(0)
    empty = lgvi.MoserVeselovIntegrator(0.0, newton_iters=5)
    assert eqx.tree_equal(eqx.tree_deserialise_leaves(file, empty), integrator)
