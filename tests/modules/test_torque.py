"""Torque laws, one by one and in sums."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.modules.torques.law import ScaledTorque, TorqueSum

from ..systems import GENERIC, PI0, R0, rng, rotation

ANY: Any = lgvi  # whose arguments a type checker does not know
ANY_SUM: Any = TorqueSum
ANY_MULTIPLE: Any = ScaledTorque
VECTOR, OTHER = np.array([0.3, -0.2, 0.1]), np.array([0.1, 0.4, -0.2])
POSITION = np.array([1.0, 0.5, -0.7])
TIMES = np.linspace(0.0, 2.0, 5)
SAMPLES = rng(61).normal(size=(5, 3))


def orbit(t):
    return jnp.stack([jnp.cos(t), jnp.sin(t), 0.3 * t])


def orbit_numpy(t):
    return np.array([np.cos(t), np.sin(t), 0.3 * t])


def gravity_gradient(mu, r, R, J):
    return 3 * mu / np.linalg.norm(r) ** 5 * np.cross(R.T @ r, J @ (R.T @ r))


def interpolated(t):
    return np.array([np.interp(t, TIMES, column) for column in SAMPLES.T])


GRAVITY = lgvi.UniformGravity(1.3, VECTOR, 2.0)
SOME: Any = GRAVITY
LAWS = {
    "body": (lgvi.ConstantTorque(VECTOR), lambda t, R: VECTOR),
    "space": (lgvi.ConstantTorque(VECTOR, "space"), lambda t, R: R.T @ VECTOR),
    "samples": (lgvi.SampledTorque(TIMES, SAMPLES), lambda t, R: interpolated(t)),
    "samples in space": (
        lgvi.SampledTorque(TIMES, SAMPLES, frame="space"),
        lambda t, R: R.T @ interpolated(t),
    ),
    "gravity": (GRAVITY, lambda t, R: 2.6 * np.cross(R[2], VECTOR)),
    "potential": (
        lgvi.PotentialTorque(lambda R: 2.6 * R[2] @ jnp.asarray(VECTOR)),
        lambda t, R: 2.6 * np.cross(R[2], VECTOR),
    ),
    "gravity gradient": (
        lgvi.GravityGradient(1.7, POSITION, GENERIC),
        lambda t, R: gravity_gradient(1.7, POSITION, R, GENERIC),
    ),
    "on an orbit": (
        lgvi.GravityGradient(1.7, orbit, GENERIC),
        lambda t, R: gravity_gradient(1.7, orbit_numpy(t), R, GENERIC),
    ),
    "scaled": (-2 * GRAVITY, lambda t, R: -5.2 * np.cross(R[2], VECTOR)),
    "sum": (
        GRAVITY + lgvi.ConstantTorque(OTHER),
        lambda t, R: 2.6 * np.cross(R[2], VECTOR) + OTHER,
    ),
    "difference": (
        GRAVITY - lgvi.ConstantTorque(OTHER) * 3.0,
        lambda t, R: 2.6 * np.cross(R[2], VECTOR) - 3 * OTHER,
    ),
    "with a function": (
        (lambda t, R: t * R[0]) + GRAVITY,
        lambda t, R: t * R[0] + 2.6 * np.cross(R[2], VECTOR),
    ),
    "less than a function": (
        (lambda t, R: t * R[0]) - GRAVITY / 2,
        lambda t, R: t * R[0] - 1.3 * np.cross(R[2], VECTOR),
    ),
    "sum of many": (
        sum([GRAVITY, lgvi.ConstantTorque(OTHER), GRAVITY]),
        lambda t, R: 5.2 * np.cross(R[2], VECTOR) + OTHER,
    ),
}


@pytest.mark.parametrize("name", LAWS)
def test_the_law_is_its_formula(name):
    law, formula = LAWS[name]
    for i, t in enumerate([0.3, 1.7]):
        R = rotation(61, i)
        np.testing.assert_allclose(law(t, R), formula(t, R), rtol=0, atol=1e-14)


MATRIX = np.array([[0.5, 0.2, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 0.3]])
LINEAR, QUADRATIC = lgvi.LinearDamping(MATRIX), lgvi.QuadraticDamping(np.diag(MATRIX))


def lifted(t, R, omega):
    return t * jnp.cross(omega, R[0])


def test_laws_of_the_rate_are_their_formulas():
    t, R, omega = 0.3, rotation(63), OTHER
    speed, lift = np.linalg.norm(omega), 0.3 * np.cross(omega, R[0])
    braking = -MATRIX @ omega, -speed * np.diag(MATRIX) * omega
    for law, formula in (
        (LINEAR, braking[0]),
        (QUADRATIC, braking[1]),
        (2 * (LINEAR - QUADRATIC), 2 * (braking[0] - braking[1])),
        (GRAVITY + LINEAR + lifted, 2.6 * np.cross(R[2], VECTOR) + braking[0] + lift),
    ):
        np.testing.assert_allclose(law(t, R, omega), formula, rtol=0, atol=1e-15)


def test_what_laws_say_of_themselves():
    of_time = lgvi.ConstantTorque(VECTOR) + lgvi.SampledTorque(TIMES, SAMPLES) / 2
    assert not of_time.depends_on_attitude
    assert not of_time.depends_on_rate
    assert of_time.highest_order == 2
    assert lgvi.ConstantTorque(VECTOR, "space").depends_on_attitude
    for law in (GRAVITY, 2 * GRAVITY, of_time + GRAVITY):
        assert law.depends_on_attitude
        assert not law.depends_on_rate
    assert (GRAVITY + (lambda t, R: R[0])).highest_order == 8
    for law in (LINEAR, 3 * QUADRATIC, GRAVITY + lifted):
        assert law.depends_on_rate
        assert law.highest_order == 2
    np.testing.assert_array_equal(LINEAR.linear_damping, MATRIX)
    np.testing.assert_array_equal(QUADRATIC.quadratic_damping, np.diag(np.diag(MATRIX)))
    assert LINEAR.quadratic_damping is None
    assert QUADRATIC.linear_damping is None


@pytest.mark.parametrize("name", ["gravity", "potential", "gravity gradient", "on an orbit"])
def test_the_torque_is_minus_the_gradient_of_the_energy(name):
    law: Any = LAWS[name][0]
    R, t, s = rotation(62), 0.8, 1e-5

    def energy(e, s):
        return law.potential_energy(t, R @ lgvi.so3.exp(jnp.asarray(s * e)))

    slopes = [(energy(e, s) - energy(e, -s)) / (2 * s) for e in np.eye(3)]
    np.testing.assert_allclose(law(t, R), -np.array(slopes), rtol=0, atol=1e-9)


def test_the_laws_keep_the_precision(dtype):
    for name, (law, _) in LAWS.items():
        law = jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, law)
        if name not in ("potential", "with a function"):
            assert law(jnp.asarray(0.3, dtype), jnp.eye(3, dtype=dtype)).dtype == dtype


def test_the_leaves_are_learnable():
    integers = np.arange(3)
    laws = {
        1: [lgvi.ConstantTorque(integers), lgvi.LinearDamping(np.eye(3, dtype=int))],
        2: [lgvi.SampledTorque(np.arange(2), SAMPLES[:2]), lgvi.GravityGradient(1, integers)],
        3: [lgvi.UniformGravity(1, integers)],
    }
    for count, given in laws.items():
        for law in given:
            leaves = jax.tree.leaves(law)
            assert len(leaves) == count
            assert all(eqx.is_inexact_array(leaf) for leaf in leaves)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (
            lambda: ANY.ConstantTorque([1.0, 2.0]),
            ValueError,
            r"`torque` must have shape \(3,\)",
        ),
        (lambda: ANY.ConstantTorque("x"), TypeError, "`torque` must be"),
        (lambda: ANY.ConstantTorque(VECTOR, "inertial"), ValueError, "`frame` must be .body."),
        (
            lambda: ANY.SampledTorque(TIMES, SAMPLES[1:]),
            ValueError,
            r"`torque` must .* \(5, 3\)",
        ),
        (
            lambda: ANY.SampledTorque(1.0, SAMPLES),
            ValueError,
            r"`t` must have shape \(samples,\)",
        ),
        (lambda: ANY.SampledTorque([], np.zeros((0, 3))), ValueError, "`t` must have shape"),
        (lambda: ANY.UniformGravity([1.0], VECTOR), ValueError, r"`mass` must have shape \(\)"),
        (lambda: ANY.UniformGravity(1.0, 2.0), ValueError, r"`offset` must have shape \(3,\)"),
        (
            lambda: ANY.GravityGradient(1.0, [1.0]),
            ValueError,
            r"`position` must have shape \(3,\)",
        ),
        (lambda: ANY.QuadraticDamping(1.0), ValueError, r"`matrix` .* \(3,\) or \(3, 3\).* \(\)"),
        (lambda: ANY.QuadraticDamping(VECTOR)(0.0, np.eye(3)), TypeError, "omega"),
        (lambda: ANY.LinearDamping(VECTOR), ValueError, r"`matrix` must have shape \(3, 3\)"),
        (lambda: GRAVITY * VECTOR, ValueError, r"`factor` must have shape \(\)"),
        (lambda: SOME + 1.0, TypeError, "unsupported operand"),
        (lambda: ANY_SUM(()), TypeError, "`terms` must be a tuple of laws"),
        (lambda: ANY_SUM((SOME, 1.0)), TypeError, r"`terms\[1\]` must be a function"),
        (lambda: ANY_MULTIPLE(1.0, 3.0), TypeError, "`torque` must be a function"),
        (lambda: ANY.PotentialTorque(3.0), TypeError, "`potential` must be a function"),
        (lambda: ANY.PotentialTorque(SOME), TypeError, "`potential` .*missing .* 'R'"),
        (lambda: ANY.GravityGradient(1.0, SOME), TypeError, "`position` .*missing .* 'R'"),
        (lambda: 1.0 + SOME, TypeError, "unsupported operand"),
        (
            lambda: ANY.GravityGradient(1.0, POSITION)(0.0, np.eye(3)),
            ValueError,
            "`inertia` of",
        ),
        (lambda: ANY.LinearDamping(np.eye(3))(0.0, np.eye(3)), TypeError, "omega"),
        (
            lambda: ANY.PotentialTorque(lambda R: R[0])(0.0, np.eye(3)),
            ValueError,
            r"`potential\(R\)` must have shape \(\)",
        ),
        (
            lambda: (GRAVITY + (lambda t, R: R))(0.0, np.eye(3)),
            ValueError,
            r"`terms\[1\]\(t, R\)` must have shape \(3,\)",
        ),
    ],
)
def test_bad_input_is_named(make, error, message, unchecked):
    with pytest.raises(error, match=message):
        make()


class Forgotten(lgvi.AbstractTorque):
    def __call__(self, t, R, omega):
        return -omega


class Method(Forgotten):
    def depends_on_rate(self):  # pyright: ignore[reportIncompatibleMethodOverride]
        return True


class OfHighOrder(Forgotten):
    @property
    def depends_on_rate(self):
        return True

    @property
    def highest_order(self):
        return 4


@pytest.mark.parametrize(
    ("law", "order", "error", "message"),
    [
        (Forgotten(), 2, TypeError, "`depends_on_rate` of `Forgotten` is False"),
        (Method(), 2, TypeError, "`depends_on_rate` of `Method` must be True or False"),
        (2 * OfHighOrder() + GRAVITY, 4, ValueError, "`order` must be at most 2, but is 4"),
    ],
)
def test_what_a_law_says_of_itself_is_checked(law, order, error, message):
    method = lgvi.MoserVeselovIntegrator(0.1, order=order)
    with pytest.raises(error, match=message):
        method.simulate(lgvi.RigidBody(GENERIC), R0, PI0, steps=2, torque=law)


def test_a_third_argument_named_omega_is_the_rate_though_it_has_a_default():
    method = lgvi.MoserVeselovIntegrator(0.1)
    laws = lambda t, R, omega=OTHER: -0.1 * omega, lambda t, R, omega: -0.1 * omega
    with_default, without = (
        method.simulate(lgvi.RigidBody(GENERIC), R0, PI0, steps=2, torque=law).pi for law in laws
    )
    np.testing.assert_array_equal(with_default, without)
