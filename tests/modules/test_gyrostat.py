"""Bodies with rotors."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..derivatives import (
    assert_first_derivatives_agree,
    assert_gradient_agrees,
    assert_second_derivatives_agree,
)
from ..systems import (
    GENERIC,
    PI0,
    R0,
    discrete_inertia,
    euler_equations,
    hat,
    momenta,
    order_of,
    physical_inertias,
    rng,
    vee,
)

ROTOR, OFFSET = np.array([0.4, -0.3, 0.8]), np.array([0.1, 0.2, 1.0])
BODY = lgvi.Gyrostat(jnp.asarray(GENERIC), ROTOR)
GRAVITY = lgvi.UniformGravity(1.3, OFFSET, 1.0)
SPAN = 2.0
# Of free motion: one compiled program serves all tests that look at some of them.
MANY, STEPS = 2000, 80
RAISED = (RuntimeError, eqx.EquinoxRuntimeError)


def changing(t):
    """Momentum of rotors at one time or at many."""
    t = np.asarray(t)
    return np.stack([0.4 * np.cos(2 * t), 0 * t - 0.3, 0.8 * np.sin(t)], axis=-1)


def gravity(t, R, omega):
    return 1.3 * np.cross(R[2], OFFSET)


def error_of(trajectory, exact, at):
    pairs = zip(trajectory[:2], exact, strict=True)
    return max(np.max(np.abs(x[at] - y[-1])) for x, y in pairs)


def test_the_solution_is_that_of_the_matrix_equation():
    Js, h = physical_inertias(50, 71), 0.1
    pis, rotors = momenta(Js, 0.7, 71), rng(71).normal(scale=0.3, size=(50, 3))
    solve = jax.vmap(
        lambda pi, J, rotor: lgvi.solve_F_with_info(pi + rotor, J, h, rotor_momentum=rotor)
    )
    Fs, info = jax.jit(solve)(pis, Js, rotors)
    assert np.all(info.converged)
    for F, pi, J, rotor in zip(np.asarray(Fs), pis, Js, rotors, strict=True):
        Jd, turned = discrete_inertia(J), F @ hat(rotor)
        left = vee(F @ Jd - Jd @ F.T + h / 2 * (turned - turned.T))
        np.testing.assert_allclose(left, h * (pi + rotor), rtol=0, atol=1e-15)


def test_without_momentum_of_the_rotors_it_is_a_rigid_body():
    method = lgvi.MoserVeselovIntegrator(0.1)
    still = lgvi.Gyrostat(jnp.asarray(GENERIC), np.zeros(3))
    actual = method.simulate(still, R0, PI0, steps=MANY)
    desired = method.simulate(lgvi.RigidBody(jnp.asarray(GENERIC)), R0, PI0, steps=20)
    for a, d in zip(actual[:2], desired[:2], strict=True):
        np.testing.assert_allclose(a[:21], d, rtol=0, atol=1e-14)


@pytest.mark.parametrize("law", [None, GRAVITY], ids=["free", "gravity"])
def test_rotors_that_change_speed(law):
    exact = euler_equations(R0, PI0, GENERIC, [0.0, SPAN], law and gravity, changing)
    errors = []
    for steps in (STEPS // 2, STEPS):  # of one program, which goes on where half are enough
        dt = SPAN / steps
        body = lgvi.Gyrostat(GENERIC, changing(dt * (np.arange(STEPS) + 0.5)))
        R, pi, info = lgvi.MoserVeselovIntegrator(dt).simulate(body, R0, PI0, torque=law)
        assert np.all(info.converged)
        errors.append(error_of((R, pi), exact, at=steps))
        if law is None:
            L = np.einsum("nij,nj->ni", R, pi)
            np.testing.assert_allclose(L, np.broadcast_to(L[0], L.shape), rtol=0, atol=4e-15)
    assert order_of(errors) == pytest.approx(2.0, abs=0.05)


def test_an_initial_velocity_is_that_of_the_body_with_its_first_rotors():
    omega = np.array([0.3, -0.2, 0.5])
    body = lgvi.Gyrostat(GENERIC, changing(0.1 * (np.arange(STEPS) + 0.5)))
    trajectory = lgvi.MoserVeselovIntegrator(0.1).simulate(body, R0, omega0=omega)
    first = GENERIC @ omega + body.rotor_momentum[0]
    np.testing.assert_allclose(trajectory.pi[0], first, rtol=1e-15)


@pytest.mark.parametrize(
    ("order", "steps", "law"),
    [
        pytest.param(4, 12, None, id="4 free"),
        pytest.param(6, 12, None, id="6 free", marks=pytest.mark.slow),
        pytest.param(8, 8, None, id="8 free", marks=pytest.mark.slow),
        pytest.param(4, 12, GRAVITY, id="4 gravity", marks=pytest.mark.slow),
        pytest.param(6, 12, GRAVITY, id="6 gravity", marks=pytest.mark.slow),
        pytest.param(8, 8, GRAVITY, id="8 gravity"),
    ],
)
def test_high_order_with_constant_rotors(order, steps, law):
    exact = euler_equations(R0, PI0, GENERIC, [0.0, SPAN], law and gravity, lambda t: ROTOR)
    errors = []
    for count in (steps, 2 * steps):
        method = lgvi.MoserVeselovIntegrator(SPAN / count, order=order)
        trajectory = method.simulate(BODY, R0, PI0, steps=2 * steps, torque=law)
        errors.append(error_of(trajectory, exact, at=count))
    assert order_of(errors) == pytest.approx(order, abs=0.3)


def test_energy_does_not_drift_without_torque(dtype):
    body = lgvi.Gyrostat(jnp.asarray(GENERIC, dtype), jnp.asarray(ROTOR, dtype))
    state = jnp.asarray(R0, dtype), jnp.asarray(PI0, dtype)
    R, pi, info = lgvi.MoserVeselovIntegrator(0.1).simulate(body, *state, steps=MANY)
    assert R.dtype == pi.dtype == dtype
    assert np.all(info.converged)
    of_body = np.asarray(pi, float) - ROTOR
    energy = np.einsum("ni,ni->n", of_body, np.linalg.solve(GENERIC, of_body.T).T) / 2
    # The discrete energy is another one, close by: it does not drift.
    assert np.ptp(energy) < 1e-2 * energy[0]
    assert abs(np.mean(energy[-500:]) - np.mean(energy[:500])) < 1e-3 * energy[0]


def test_velocity_and_momentum():
    omega = jnp.asarray([0.3, -0.2, 0.5])
    pi = BODY.angular_momentum(omega)
    np.testing.assert_allclose(pi, GENERIC @ omega + ROTOR, rtol=1e-15)
    np.testing.assert_allclose(BODY.angular_velocity(pi), omega, rtol=1e-14)
    np.testing.assert_allclose(BODY.energy(pi), omega @ GENERIC @ omega / 2, rtol=1e-14)


def test_damping_acts_on_the_velocity():
    """Not on the momentum of the rotors: a body that has come to rest stays there."""
    law = lgvi.LinearDamping(2 * np.eye(3))
    R, pi, _ = lgvi.MoserVeselovIntegrator(0.1).simulate(BODY, R0, PI0, steps=400, torque=law)
    np.testing.assert_allclose(pi[-1], ROTOR, rtol=0, atol=1e-9)
    np.testing.assert_allclose(R[-1], R[-2], rtol=0, atol=1e-9)


def final(pi0, J, rotor, dt):
    method = lgvi.MoserVeselovIntegrator(0.1 * dt, throw=False)
    return method.simulate(lgvi.Gyrostat(J, rotor), R0, pi0, steps=4)[:2]


def test_first_derivatives_along_one_direction():
    given = PI0, GENERIC, rng(72).normal(size=(4, 3)), np.linspace(0.8, 1.4, 4)
    assert_gradient_agrees(final, *given, rtol=1e-10, forward=True)


@pytest.mark.slow
@pytest.mark.parametrize("rotors", ["changing", "steady"])
def test_first_derivatives(rotors):
    steps = 4
    rotor = rng(72).normal(size=(steps, 3))
    given = PI0, GENERIC, rotor if rotors == "changing" else rotor[0], np.linspace(0.8, 1.4, steps)
    assert_first_derivatives_agree(final, *[jnp.asarray(x)[None] for x in given], rtol=1e-10)


@pytest.mark.slow
def test_second_derivatives():
    weights = rng(73).normal(size=(2, 5, 3))

    def scalar(pi0, J, rotor, dt):
        R, pi = final(pi0, J, rotor, dt)
        return jnp.sum(weights[0] * R[:, 1]) + jnp.sum(jnp.sin(weights[1] + pi))

    given = PI0, GENERIC, ROTOR, np.array(1.1)
    assert_second_derivatives_agree(scalar, *[jnp.asarray(x)[None] for x in given], rtol=1e-9)


@pytest.mark.parametrize("modes", ["reverse", pytest.param("all", marks=pytest.mark.slow)])
def test_derivatives_under_a_torque_law(modes):
    def forced(pi0, J, rotor, dt):
        method = lgvi.MoserVeselovIntegrator(0.1 * dt, throw=False)
        law = GRAVITY + lgvi.LinearDamping(0.1 * np.eye(3))
        return method.simulate(lgvi.Gyrostat(J, rotor), R0, pi0, steps=4, torque=law)[:2]

    given = PI0, GENERIC, rng(74).normal(size=(4, 3)), np.array(1.1)
    if modes == "reverse":
        assert_gradient_agrees(forced, *given, rtol=1e-10)
    else:
        assert_first_derivatives_agree(forced, *[jnp.asarray(x)[None] for x in given], rtol=1e-10)


def test_a_known_rotor_shows_the_scale_of_the_inertia():
    """Without it a body of twice the inertia and momentum moves alike."""
    method = lgvi.MoserVeselovIntegrator(0.1)

    def attitudes(scale, rotor):
        body = lgvi.Gyrostat(scale * GENERIC, rotor)
        omega = np.array([0.7, -0.4, 0.5])
        pi0 = scale * GENERIC @ omega + rotor
        return method.simulate(body, R0, pi0, steps=MANY).R[:21]

    np.testing.assert_allclose(
        attitudes(2.0, np.zeros(3)), attitudes(1.0, np.zeros(3)), rtol=0, atol=1e-13
    )
    assert np.max(np.abs(attitudes(2.0, ROTOR) - attitudes(1.0, ROTOR))) > 0.1


def test_a_step_is_that_of_a_simulation():
    method = lgvi.MoserVeselovIntegrator(0.1)
    torques = rng(75).normal(size=(2, 3))
    R, pi, _ = eqx.filter_jit(method.step)(BODY, R0, PI0, *torques)
    Rs, pis, _ = method.simulate(BODY, R0, PI0, body_torques=torques)
    np.testing.assert_allclose(R, Rs[1], rtol=0, atol=1e-15)
    np.testing.assert_allclose(pi, pis[1], rtol=0, atol=1e-15)


@pytest.mark.parametrize("rotors", ["changing", pytest.param("steady", marks=pytest.mark.slow)])
def test_some_states_of_a_trajectory_in_pieces(rotors, set_chunk_sizes):
    set_chunk_sizes(chunk=15)
    every, dt = 40, 0.1
    method = lgvi.MoserVeselovIntegrator(dt)
    body = lgvi.Gyrostat(
        GENERIC, changing(dt * np.arange(STEPS)) if rotors == "changing" else ROTOR
    )
    whole = method.simulate(body, R0, PI0, steps=STEPS)
    some = method.simulate(body, R0, PI0, steps=STEPS, save_every=every)
    for a, d in zip(some[:2], whole[:2], strict=True):
        np.testing.assert_allclose(a, d[::every], rtol=0, atol=1e-12)


OF_FIVE_STEPS = lgvi.Gyrostat(jnp.asarray(GENERIC), np.zeros((5, 3)))
ANY: Any = lgvi


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: ANY.Gyrostat(GENERIC, [1.0]), ValueError, r"`rotor_momentum` must have shape"),
        (lambda: ANY.Gyrostat(GENERIC, np.zeros((0, 3))), ValueError, "at least one step"),
        (lambda: ANY.Gyrostat(ROTOR, ROTOR), ValueError, r"`inertia` must have shape \(3, 3\)"),
        (lambda: OF_FIVE_STEPS.angular_velocity(PI0), ValueError, r"shape is \(5, 3\): make a"),
        (
            lambda: lgvi.MoserVeselovIntegrator(0.1).simulate(OF_FIVE_STEPS, R0, PI0, steps=4),
            ValueError,
            "`steps` is 4, the length of `rotor_momentum` is 5",
        ),
        (
            lambda: lgvi.MoserVeselovIntegrator(0.1, order=4).simulate(OF_FIVE_STEPS, R0, PI0),
            ValueError,
            "`rotor_momentum` needs an integrator of order 2",
        ),
        (
            lambda: lgvi.MoserVeselovIntegrator(0.1, order=10).simulate(BODY, R0, PI0, steps=1),
            ValueError,
            r"rotors `order` must be one of \(2, 4, 6, 8\)",
        ),
        (
            lambda: lgvi.MoserVeselovIntegrator(4.0).simulate(BODY, R0, PI0, steps=MANY),
            RAISED,
            "Step 0 did not converge",
        ),
        (
            lambda: lgvi.solve_F_with_info(PI0, GENERIC, 0.1, rotor_momentum=GENERIC),
            ValueError,
            r"`rotor_momentum` must have shape \(3,\)",
        ),
    ],
)
def test_bad_input_is_named(call, error, message, unchecked):
    with pytest.raises(error, match=message):
        call()


def test_a_body_of_your_own_with_rotors_has_their_momentum():
    class Own(lgvi.AbstractRigidBody):
        inertia: jax.Array  # pyright: ignore[reportIncompatibleMethodOverride]
        rotor_momentum: jax.Array  # pyright: ignore[reportIncompatibleMethodOverride]

    given = jnp.asarray(GENERIC), jnp.array([0.1, 0.5, -0.2])
    own, desired = Own(*given), lgvi.Gyrostat(*given)
    omega = np.array([1.0, 2.0, 0.5])
    pi = own.angular_momentum(omega)
    np.testing.assert_array_equal(pi, desired.angular_momentum(omega))
    np.testing.assert_array_equal(own.angular_velocity(pi), desired.angular_velocity(pi))
    np.testing.assert_allclose(own.angular_velocity(pi), omega, rtol=1e-14)
    np.testing.assert_array_equal(own.energy(pi), desired.energy(pi))
