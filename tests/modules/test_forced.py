"""Simulations under torque laws, damping and feedback."""

from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.core import pieces

from ..derivatives import assert_first_derivatives_agree
from ..systems import GENERIC, PI0, R0, euler_equations, order_of, rng

BODY = lgvi.RigidBody(jnp.asarray(GENERIC))
VECTOR, OFFSET = np.array([0.3, -0.2, 0.1]), np.array([0.1, 0.2, 1.0])
DAMPING = np.array([[0.5, 0.2, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 0.3]])
GRAVITY = lgvi.UniformGravity(1.3, OFFSET, 1.0)
SPACE = lgvi.ConstantTorque(VECTOR, "space")
RAISED = (RuntimeError, eqx.EquinoxRuntimeError)
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


def error_of(trajectory, exact):
    pairs = zip(trajectory[:2], exact, strict=True)
    return max(np.max(np.abs(x[-1] - y[-1])) for x, y in pairs)


METHODS = [(2, True, 32), (4, True, 12), (4, False, 12), (6, True, 12), (8, True, 8)]


@pytest.mark.parametrize(("order", "force_gradient", "steps"), METHODS)
def test_the_order(order, force_gradient, steps):
    errors = []
    for count in (steps, 2 * steps):
        method = integrator(count, order=order, force_gradient=force_gradient)
        errors.append(
            error_of(method.simulate(BODY, R0, PI0, steps=count, torque=LAW, t0=T0), EXACT)
        )
    assert order_of(errors) == pytest.approx(order, abs=0.25 if order == 8 else 0.1)


@pytest.mark.parametrize(("order", "steps"), [(2, 32), (4, 12), (8, 8)])
def test_the_order_under_a_torque_of_time(order, steps):
    exact = euler_equations(R0, PI0, GENERIC, [0.0, SPAN], lambda *_: VECTOR)
    law, errors = lgvi.ConstantTorque(VECTOR), []
    for count in (steps, 2 * steps):
        trajectory = integrator(count, order=order).simulate(BODY, R0, PI0, steps=count, torque=law)
        errors.append(error_of(trajectory, exact))
    assert order_of(errors) == pytest.approx(order, abs=0.25)


def test_the_force_gradient_is_the_better_method_of_order_4():
    exact = euler_equations(
        R0, PI0, GENERIC, [0.0, SPAN], lambda t, R, omega: 1.3 * np.cross(R[2], OFFSET)
    )
    errors = [
        error_of(
            integrator(12, order=4, force_gradient=flag).simulate(
                BODY, R0, PI0, steps=12, torque=GRAVITY
            ),
            exact,
        )
        for flag in (True, False)
    ]
    assert errors[0] < errors[1] / 5


def test_a_torque_of_time_alone_is_a_prescribed_one():
    """And to rounding what the loop for other laws gives."""
    times = np.linspace(0.0, SPAN, 21)
    samples = rng(63).normal(size=(21, 3))
    law = 2 * lgvi.SampledTorque(times, samples) + lgvi.ConstantTorque(VECTOR)
    simulate = partial(integrator(20).simulate, BODY, R0, PI0, steps=20)
    for actual, desired in zip(
        simulate(torque=law)[:2], simulate(body_torques=2 * samples + VECTOR)[:2], strict=True
    ):
        np.testing.assert_allclose(actual, desired, rtol=0, atol=1e-14)
    for actual, desired in zip(
        simulate(torque=lambda t, R: law(t, R))[:2], simulate(torque=law)[:2], strict=True
    ):
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
        ({"order": 6}, True),
        ({"order": 4}, False),
    ],
)
def test_which_methods_are_symplectic(settings, strict):
    method = lgvi.MoserVeselovIntegrator(0.5, **settings)

    def after(z):
        R, pi, _ = method.simulate(
            BODY, R0 @ lgvi.so3.exp(z[:3]), PI0 + z[3:], steps=1, torque=GRAVITY
        )
        return R[-1], pi[-1]

    zero = jnp.zeros(6)
    (R, pi), (dR, dpi) = after(zero), jax.jacfwd(after)(zero)
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
    errors = [
        error_of(integrator(n).simulate(BODY, R0, PI0, steps=n, torque=law), exact)
        for n in (32, 64)
    ]
    assert order_of(errors) == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("factor", [0.1, 10.0, 1000.0])
def test_damping_never_increases_the_energy(factor):
    """However stiff: the last is far beyond the step of an explicit method."""
    law = factor * lgvi.LinearDamping(np.diag([1.0, 0.1, 0.0]))
    _, pi, _ = lgvi.MoserVeselovIntegrator(0.3).simulate(BODY, R0, PI0, steps=50, torque=law)
    energy = jax.vmap(BODY.energy)(pi)
    assert np.all(np.diff(energy) <= 4e-16 * energy[0])
    assert energy[-1] < 0.99 * energy[0]


def test_a_controller_is_held_for_each_step():
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
    for order, force_gradient, bound in (
        (2, True, 0.2),
        (4, True, 2e-3),
        (4, False, 2e-2),
        (8, True, 2e-4),
    ):
        method = lgvi.MoserVeselovIntegrator(step, order=order, force_gradient=force_gradient)
        simulate = partial(method.simulate, BODY, R0, PI0, steps=steps, t0=0.2)
        trajectory = simulate(torque=GRAVITY, controller=controller)
        assert error_of(trajectory, ([R], [pi])) < bound
    no_law = lgvi.MoserVeselovIntegrator(step).simulate(
        BODY, R0, PI0, steps=1, controller=lambda t, R, pi: VECTOR
    )
    law = lgvi.ConstantTorque(VECTOR)
    same = lgvi.MoserVeselovIntegrator(step).simulate(BODY, R0, PI0, steps=1, torque=law)
    np.testing.assert_allclose(no_law.pi, same.pi, rtol=0, atol=1e-15)


def final(settings, R0, pi0, J, dt, t0, strength, gain):
    damping = lgvi.LinearDamping(0.2 * DAMPING) if not settings else None
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


def test_first_derivatives():
    arguments = [jnp.asarray(x)[None] for x in POINT]
    assert_first_derivatives_agree(partial(final, {}), *arguments, rtol=1e-10)


@pytest.mark.parametrize("order", [4, 6])
def test_the_gradient_of_a_high_order(order):
    """Along one direction in all arguments at once."""
    random = rng(65)
    point = [jnp.asarray(x) for x in POINT]
    along = [jnp.asarray(random.normal(size=x.shape)) for x in point]
    weights = jnp.asarray(random.normal(size=(2, 3)))

    @jax.jit
    def scalar(*point):
        R, pi = final({"order": order}, *point)
        return jnp.sum(jnp.sin(R @ weights[0])) + jnp.sum((pi @ weights[1]) ** 2)

    def at(step):
        return scalar(*(x + step * d for x, d in zip(point, along, strict=True)))

    gradient = jax.grad(scalar, argnums=range(len(point)))(*point)
    slope = sum(jnp.vdot(g, d) for g, d in zip(gradient, along, strict=True))
    size = 1e-3  # sixth-order central differences
    weights_at = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
    numeric = sum(w * (at(k * size) - at(-k * size)) for k, w in weights_at.items()) / size
    np.testing.assert_allclose(slope, numeric, rtol=1e-10)


def in_many_steps(x, dt, save_every=1):
    """Under a torque that changes with time, of strength x[0] and with steps x[1] dt."""
    law = x[0] * SPACE + changing
    method = lgvi.MoserVeselovIntegrator(x[1] * dt, throw=False)
    given = BODY, R0, PI0
    return method.simulate(*given, steps=16, torque=law, save_every=save_every, t0=0.4)[:2]


def scalar(x):
    R, pi = in_many_steps(x, jnp.full(16, 0.1))
    weights = jnp.asarray(rng(64).normal(size=(2, 3)))
    return jnp.sum(jnp.sin(R[:, 0] @ weights[0])) + jnp.sum((pi @ weights[1]) ** 2)


@pytest.fixture
def short_pieces(monkeypatch):
    def shorten():
        monkeypatch.setattr(pieces, "PIECE", 3)
        monkeypatch.setattr(pieces, "LONG", 5)
        jax.clear_caches()

    yield shorten
    jax.clear_caches()


def test_time_goes_on_from_piece_to_piece(short_pieces):
    x, sizes = jnp.asarray([0.7, 1.1]), (0.1, jnp.linspace(0.05, 0.15, 16))
    whole = [in_many_steps(x, dt) for dt in sizes]
    short_pieces()
    for dt, states in zip(sizes, whole, strict=True):
        for every in (1, 4):
            for actual, desired in zip(in_many_steps(x, dt, every), states, strict=True):
                np.testing.assert_allclose(actual, desired[::every], rtol=0, atol=1e-13)


@pytest.mark.parametrize("in_pieces", [False, True])
def test_second_derivatives(in_pieces, short_pieces):
    if in_pieces:
        short_pieces()
    x, direction, size = jnp.asarray([0.7, 1.1]), jnp.asarray([0.6, -0.8]), 1e-5
    gradient = jax.jit(jax.grad(scalar))
    actual = jax.jit(lambda x: jax.jvp(jax.grad(scalar), (x,), (direction,))[1])(x)
    numeric = (gradient(x + size * direction) - gradient(x - size * direction)) / (2 * size)
    np.testing.assert_allclose(actual, numeric, rtol=1e-7)


def test_a_batch_is_a_loop():
    def final(strength):
        method = lgvi.MoserVeselovIntegrator(0.1, throw=False)
        return method.simulate(BODY, R0, PI0, steps=5, torque=strength * GRAVITY).pi[-1]

    strengths = jnp.asarray([0.5, 1.0, 2.0])
    batch = jax.vmap(final)(strengths)
    gradients = jax.vmap(jax.jacrev(final))(strengths)
    for i, strength in enumerate(strengths):
        np.testing.assert_allclose(batch[i], final(strength), rtol=0, atol=1e-14)
        np.testing.assert_allclose(gradients[i], jax.jacrev(final)(strength), rtol=0, atol=1e-13)


def test_the_gradient_of_gravity_depends_on_the_body():
    """`simulate` takes the body's inertia, and the derivative knows."""

    def final(J, law):
        method = lgvi.MoserVeselovIntegrator(0.1)
        return method.simulate(lgvi.RigidBody(J), R0, PI0, steps=3, torque=law(J)).pi[-1]

    J = jnp.asarray(GENERIC)
    for law in (
        lambda J: -lgvi.GravityGradient(1.1, VECTOR),
        lambda J: -lgvi.GravityGradient(1.1, VECTOR, J),
    ):
        np.testing.assert_allclose(
            final(J, law), final(J, lambda J: -lgvi.GravityGradient(1.1, VECTOR, J)), atol=0
        )
    implicit = jax.jacrev(final)(J, lambda J: lgvi.GravityGradient(1.1, VECTOR))
    explicit = jax.jacrev(final)(J, lambda J: lgvi.GravityGradient(1.1, VECTOR, J))
    fixed = jax.jacrev(final)(J, lambda _: lgvi.GravityGradient(1.1, VECTOR, GENERIC))
    np.testing.assert_allclose(implicit, explicit, rtol=0, atol=1e-14)
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

    gradient = eqx.filter_grad(loss)(network)
    index = eqx.tree_at(
        lambda n: n.layers.layers[0].bias, network, replace_fn=lambda x: x.at[0].add(1e-5)
    )
    slope = (loss(index) - loss(network)) / 1e-5
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

    gradient = jax.jit(jax.grad(final))(jnp.asarray(PI0), 1)
    ends = [final(PI0 + s * 1e-5 * np.eye(3)[0], 1) for s in (1, -1)]
    np.testing.assert_allclose(gradient[0], (ends[0] - ends[1]) / 2e-5, rtol=1e-8)


def test_the_force_gradient_is_for_bodies_without_rotors():
    """Elsewhere order 4 is a composition, whatever is asked for."""
    wheel = lgvi.Gyrostat(GENERIC, VECTOR)
    for body, law in ((wheel, GRAVITY), (BODY, lgvi.ConstantTorque(VECTOR))):
        one, other = (
            lgvi.MoserVeselovIntegrator(0.3, order=4, force_gradient=flag).simulate(
                body, R0, PI0, steps=3, torque=law
            )
            for flag in (True, False)
        )
        np.testing.assert_array_equal(one.pi, other.pi)


def test_a_law_that_cannot_be_hashed():
    @dataclass
    class Law:
        torque: np.ndarray

        def __call__(self, t, R):
            return jnp.asarray(self.torque)

    method = lgvi.MoserVeselovIntegrator(0.1)
    for torque in (VECTOR, 2 * VECTOR):
        actual = method.simulate(BODY, R0, PI0, steps=3, torque=Law(torque))
        desired = method.simulate(BODY, R0, PI0, steps=3, torque=lgvi.ConstantTorque(torque))
        np.testing.assert_allclose(actual.pi, desired.pi, rtol=0, atol=1e-14)


def test_the_precision_is_that_of_all_that_is_given(dtype):
    law = jax.tree.map(lambda x: x.astype(dtype), GRAVITY)
    body = lgvi.RigidBody(jnp.asarray(GENERIC, jnp.float32))
    state = jnp.asarray(R0, jnp.float32), jnp.asarray(PI0, jnp.float32)
    for order in (2, 4, 6):
        method = lgvi.MoserVeselovIntegrator(0.1, order=order)
        with jax.numpy_dtype_promotion("standard"):
            R, pi, info = method.simulate(body, *state, steps=10, torque=law)
        assert R.dtype == pi.dtype == info.residual_norm.dtype == dtype
        exact = lgvi.MoserVeselovIntegrator(0.1, order=order).simulate(
            BODY, R0, PI0, steps=10, torque=GRAVITY
        )
        np.testing.assert_allclose(pi, exact.pi, rtol=0, atol=2e-5)


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
        ({"torque": 1.0}, {}, TypeError, r"`torque` must be a function of \(t, R\), but is 1.0"),
        ({"controller": VECTOR}, {}, TypeError, r"`controller` must be a function of \(t, R, pi\)"),
        ({"controller": GRAVITY}, {}, TypeError, "`controller` must be .*too many positional"),
        ({"torque": lgvi.UniformGravity}, {}, TypeError, "`torque` must be a function.*class"),
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
        ({"torque": SAMPLED}, {"order": 4}, ValueError, "`SampledTorque` `order` must be 2.*kinks"),
        (
            {"torque": GRAVITY + lgvi.LinearDamping(DAMPING)},
            {"order": 4},
            ValueError,
            "`LinearDamping` `order` must be 2.*back in time",
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
    quiet = lgvi.MoserVeselovIntegrator(0.1, throw=False)
    info = quiet.simulate(BODY, R0, PI0, steps=20, torque=SAMPLED).solver_info
    assert not np.any(info.converged)


def test_a_last_impulse_that_is_no_number_is_seen():
    def law(t, R):
        return jnp.where(t > 0.35, jnp.nan, 1.0) * R[0]

    samples = np.where(np.arange(5)[:, None] < 4, VECTOR, np.nan)
    method = lgvi.MoserVeselovIntegrator(0.1, throw=False)
    for given in ({"torque": law, "steps": 4}, {"body_torques": samples}):
        converged = method.simulate(BODY, R0, PI0, **given).solver_info.converged
        np.testing.assert_array_equal(converged, [True, True, True, False])


def test_samples_may_be_left_by_rounding_only():
    method = lgvi.MoserVeselovIntegrator(0.1)
    method.simulate(BODY, R0, PI0, steps=10, torque=SAMPLED)  # 10 x 0.1 is not exactly 1
    method.simulate(BODY, R0, PI0, steps=3, torque=SAMPLED, t0=0.7 + 1e-12)
    backwards = lgvi.MoserVeselovIntegrator(-0.1)
    backwards.simulate(BODY, R0, PI0, steps=10, torque=SAMPLED, t0=1.0)
