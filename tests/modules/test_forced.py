"""Simulations under torque laws, damping and feedback."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import GENERIC, PI0, R0, euler_equations, order_of, rng

BODY = lgvi.RigidBody(jnp.asarray(GENERIC))
VECTOR, OFFSET = np.array([0.3, -0.2, 0.1]), np.array([0.1, 0.2, 1.0])
DAMPING = np.array([[0.5, 0.2, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 0.3]])
GRAVITY = lgvi.UniformGravity(1.3, OFFSET, 1.0)
SPACE = lgvi.ConstantTorque(VECTOR, "space")
T0, SPAN = 0.5, 2.0


def changing(t, R):
    """A torque without a potential, of time and attitude."""
    return jnp.stack([jnp.sin(2 * t), R[0, 1], R[1, 2] * t])


def all_of_them(t, R, omega):
    gravity = 1.3 * np.cross(R[2], OFFSET)
    return np.array([np.sin(2 * t), R[0, 1], R[1, 2] * t]) + gravity - R.T @ VECTOR


LAW = GRAVITY + changing - SPACE
EXACT = euler_equations(R0, PI0, GENERIC, [T0, T0 + SPAN], all_of_them)


def integrator(steps, **settings):
    return lgvi.MoserVeselovIntegrator(SPAN / steps, **settings)


def error_of(trajectory, exact, at=-1):
    pairs = zip(trajectory[:2], exact, strict=True)
    return max(np.max(np.abs(x[at] - y[-1])) for x, y in pairs)


def order_shown(steps, exact, law, t0=0.0, **settings):
    """By errors after `SPAN` in that many steps and twice as many, of one compiled program."""
    errors = []
    for count in (steps, 2 * steps):
        method = integrator(count, **settings)
        trajectory = method.simulate(BODY, R0, PI0, steps=2 * steps, torque=law, t0=t0)
        errors.append(error_of(trajectory, exact, at=count))
    return order_of(errors)


METHODS = [(2, True, 32), (4, True, 12), (4, False, 12), (6, True, 12), (8, True, 8)]


@pytest.mark.parametrize(("order", "force_gradient", "steps"), METHODS)
def test_the_order(order, force_gradient, steps):
    shown = order_shown(steps, EXACT, LAW, T0, order=order, force_gradient=force_gradient)
    assert shown == pytest.approx(order, abs=0.25 if order == 8 else 0.1)


@pytest.mark.parametrize(
    ("order", "steps"), [(2, 32), pytest.param(4, 12, marks=pytest.mark.slow), (8, 8)]
)
def test_the_order_under_a_torque_of_time(order, steps):
    exact = euler_equations(R0, PI0, GENERIC, [0.0, SPAN], lambda *_: VECTOR)
    shown = order_shown(steps, exact, lgvi.ConstantTorque(VECTOR), order=order)
    assert shown == pytest.approx(order, abs=0.25)


def test_the_force_gradient_is_the_better_method_of_order_4():
    errors = []
    for flag in (True, False):  # the programs are those that show the order
        method = integrator(12, order=4, force_gradient=flag)
        trajectory = method.simulate(BODY, R0, PI0, steps=24, torque=LAW, t0=T0)
        errors.append(error_of(trajectory, EXACT, at=12))
    assert errors[0] < errors[1] / 5


def test_a_torque_of_time_alone_is_a_prescribed_one():
    """And to rounding what the loop for other laws gives."""
    times = np.linspace(0.0, SPAN, 21)
    samples = rng(63).normal(size=(21, 3))
    law = 2 * lgvi.SampledTorque(times, samples) + lgvi.ConstantTorque(VECTOR)
    simulate = partial(integrator(20).simulate, BODY, R0, PI0, steps=20)

    @jax.jit
    def motions(law):
        return [
            simulate(torque=law)[:2],
            simulate(body_torques=2 * samples + VECTOR)[:2],
            simulate(torque=lambda t, R: law(t, R))[:2],
        ]

    of_law, *others = motions(law)
    for other in others:
        for actual, desired in zip(of_law, other, strict=True):
            np.testing.assert_allclose(actual, desired, rtol=0, atol=1e-14)


def test_a_torque_in_space_changes_the_momentum_by_its_impulse():
    steps, dt = 2000, 0.01
    method = lgvi.MoserVeselovIntegrator(dt)
    R, pi, _ = method.simulate(BODY, R0, PI0, steps=steps, torque=SPACE)
    L = np.einsum("nij,nj->ni", R, pi)
    desired = L[0] + dt * np.arange(steps + 1)[:, None] * VECTOR
    np.testing.assert_allclose(L, desired, rtol=0, atol=2e-13)


def form(pi, one, other):
    """The symplectic form of the rotation group in body variations (xi, dpi)."""
    (xi, dpi), (eta, drho) = one, other
    return xi @ drho - eta @ dpi + pi @ np.cross(xi, eta)


@pytest.mark.parametrize(
    ("settings", "strict"),
    [
        ({"order": 2}, True),
        ({"order": 4, "force_gradient": False}, True),
        pytest.param({"order": 6}, True, marks=pytest.mark.slow),
        pytest.param({"order": 4}, False, marks=pytest.mark.slow),
    ],
)
def test_which_methods_are_symplectic(settings, strict):
    method = lgvi.MoserVeselovIntegrator(0.5, **settings)

    def after(z):
        R, pi, _ = method.simulate(
            BODY, R0 @ lgvi.so3.exp(z[:3]), PI0 + z[3:], steps=1, torque=GRAVITY
        )
        return (R[-1], pi[-1]), (R[-1], pi[-1])

    (dR, dpi), (R, pi) = jax.jit(jax.jacfwd(after, has_aux=True))(jnp.zeros(6))
    after_step = [(lgvi.so3.vee(R.T @ dR[..., i]), dpi[:, i]) for i in range(6)]
    before = [(e[:3], e[3:]) for e in np.eye(6)]
    defect = max(
        abs(form(pi, after_step[i], after_step[j]) - form(PI0, before[i], before[j]))
        for i in range(6)
        for j in range(6)
    )
    assert (defect < 1e-14) == strict
    assert defect < 1e-5


def test_damping_is_of_order_2():
    exact = euler_equations(
        R0,
        PI0,
        GENERIC,
        [0.0, SPAN],
        lambda t, R, omega: 1.3 * np.cross(R[2], OFFSET) - DAMPING @ omega,
    )
    law = GRAVITY + 0.5 * lgvi.LinearDamping(DAMPING) + lgvi.LinearDamping(DAMPING / 2)
    assert order_shown(32, exact, law) == pytest.approx(2.0, abs=0.05)


def test_quadratic_damping_is_of_order_2():
    coefficients = np.array([0.1, 0.3, 0.2])
    exact = euler_equations(
        R0,
        PI0,
        GENERIC,
        [0.0, SPAN],
        lambda t, R, omega: (
            1.3 * np.cross(R[2], OFFSET)
            - DAMPING @ omega
            - 1.5 * np.linalg.norm(omega) * coefficients * omega
        ),
    )
    law = GRAVITY + lgvi.LinearDamping(DAMPING) + lgvi.QuadraticDamping(coefficients)
    law += 0.5 * lgvi.QuadraticDamping(np.diag(coefficients))
    assert order_shown(32, exact, law) == pytest.approx(2.0, abs=0.05)


def lifted(t, R, omega):
    """A torque of time, attitude and angular velocity that has no matrix."""
    return t**2 * R[1] + 0.5 * (1 + t) * omega[::-1] - 0.3 * omega**3


def test_any_law_of_the_rate_is_of_order_2():
    """With damping and rotors, whose momentum is not of the angular velocity."""
    rotor = np.array([0.4, -0.2, 0.3])
    exact = euler_equations(
        R0,
        PI0,
        GENERIC,
        [T0, T0 + SPAN],
        lambda t, R, omega: lifted(t, R, omega) - DAMPING @ omega + VECTOR,
        lambda t: rotor,
    )
    law = lgvi.LinearDamping(DAMPING) + 2 * lgvi.ConstantTorque(VECTOR / 2)
    law += lambda t, R, omega: jnp.asarray(lifted(t, R, omega))
    body, errors = lgvi.Gyrostat(jnp.asarray(GENERIC), rotor), []
    for count in (32, 64):
        method = integrator(count)
        trajectory = method.simulate(body, R0, PI0, steps=64, torque=law, t0=T0)
        errors.append(error_of(trajectory, exact, at=count))
    assert order_of(errors) == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("factor", [0.1, 10.0, 1000.0])
@pytest.mark.parametrize("kind", [lgvi.LinearDamping, lgvi.QuadraticDamping])
def test_damping_never_increases_the_energy(kind, factor):
    """However stiff: the last is far beyond the step of an explicit method."""
    law = factor * kind(np.diag([1.0, 0.1, 0.0]))
    _, pi, _ = lgvi.MoserVeselovIntegrator(0.3).simulate(BODY, R0, PI0, steps=50, torque=law)
    energy = jax.vmap(BODY.energy)(pi)
    assert np.all(np.diff(energy) <= 4e-16 * energy[0])
    assert energy[-1] < 0.99 * energy[0]


CONTROLLED = {
    (2, True): (0.2, ()),
    (4, True): (2e-3, ()),
    (4, False): (2e-2, pytest.mark.slow),
    (8, True): (2e-4, pytest.mark.slow),
}


@pytest.mark.parametrize(
    ("order", "force_gradient", "bound"),
    [pytest.param(*method, bound, marks=m) for method, (bound, m) in CONTROLLED.items()],
)
def test_a_controller_is_held_for_each_step(order, force_gradient, bound):
    """As a continuous body with the torque that flight software would hold."""
    gain, step, steps = 0.7, 0.5, 4

    def controller(t, R, pi):
        return -gain * jnp.stack([R[2, 1] + t, R[0, 2], R[1, 0]]) - 0.3 * pi

    R, pi, t = R0, PI0, 0.2
    for _ in range(steps):
        held = np.asarray(controller(t, R, pi))

        def torque(t, R, omega, held=held):
            return 1.3 * np.cross(R[2], OFFSET) + held

        Rs, pis = euler_equations(R, pi, GENERIC, [t, t + step], torque)
        R, pi, t = Rs[-1], pis[-1], t + step
    method = lgvi.MoserVeselovIntegrator(step, order=order, force_gradient=force_gradient)
    simulate = partial(method.simulate, BODY, R0, PI0, steps=steps, t0=0.2)
    trajectory = simulate(torque=GRAVITY, controller=controller)
    assert error_of(trajectory, ([R], [pi])) < bound


def test_a_controller_needs_no_law():
    simulate = partial(lgvi.MoserVeselovIntegrator(0.5).simulate, BODY, R0, PI0, steps=1)
    no_law = simulate(controller=lambda t, R, pi: VECTOR)
    same = simulate(body_torques=np.stack([VECTOR, VECTOR]))
    np.testing.assert_allclose(no_law.pi, same.pi, rtol=0, atol=1e-15)


@pytest.mark.parametrize("by", ["torque", "controller"])
def test_a_step_that_stops_the_body_converges(by):
    """The momentum that is left is less than the rounding of what the torque takes away."""
    step = lgvi.MoserVeselovIntegrator(0.1, throw=False)

    def converged(pi, left):
        stop = (left - pi) * 2 / step.dt
        law = {"torque": lambda t, R: R @ stop, "controller": lambda *_: stop}[by]
        return step.simulate(BODY, np.eye(3), pi, steps=1, **{by: law}).solver_info.converged

    pi, left = rng(49).normal(size=(2, 64, 3))
    left *= np.logspace(-8, 0, 64)[:, None]
    assert jnp.all(jax.jit(jax.vmap(converged))(pi, left))


def test_the_force_gradient_is_for_bodies_without_rotors():
    """Elsewhere order 4 is a composition, whatever is asked for."""
    wheel = lgvi.Gyrostat(GENERIC, VECTOR)

    def program(body, law, flag):
        method = lgvi.MoserVeselovIntegrator(0.3, order=4, force_gradient=flag)
        simulate = partial(method.simulate, steps=3, torque=law)
        return jax.jit(simulate).lower(body, R0, PI0).as_text()

    for body, law in ((wheel, GRAVITY), (BODY, lgvi.ConstantTorque(VECTOR))):
        assert program(body, law, True) == program(body, law, False)
    assert program(BODY, GRAVITY, True) != program(BODY, GRAVITY, False)


@pytest.mark.parametrize("order", [2, 4])
def test_steps_of_a_loop_are_those_of_a_simulation(order):
    method = lgvi.MoserVeselovIntegrator(0.05, order=order)
    gyrostat = lgvi.Gyrostat(jnp.asarray(GENERIC), VECTOR)
    for body, law in ((BODY, LAW), (gyrostat, LAW), (gyrostat, None)):
        whole = method.simulate(body, R0, PI0, steps=4, torque=law, t0=T0)
        R, pi = jnp.asarray(R0), jnp.asarray(PI0)
        for k in range(4):
            R, pi, info = method.step(body, R, pi, torque=law, t=T0 + 0.05 * k)
            assert info.converged
        np.testing.assert_allclose(R, whole.R[-1], rtol=0, atol=1e-13)
        np.testing.assert_allclose(pi, whole.pi[-1], rtol=0, atol=1e-12)
