"""Bodies as modules: formulas, physical leaves, errors, and life as a pytree."""

import io
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import lgvi

from ..systems import GENERIC, PI0, R0, ROD, inertia, physical_inertias, rng, rotation

KINDS = [lgvi.RigidBody, lgvi.PhysicalRigidBody.from_inertia]
MOMENTS = np.array([1.0, 2.0, 2.5])


def eps(dtype):
    return float(jnp.finfo(dtype).eps)


@pytest.mark.parametrize("make", KINDS)
def test_methods_are_their_formulas(dtype, make):
    body = make(jnp.asarray(GENERIC, dtype))
    omega = np.linalg.solve(GENERIC, PI0)

    @eqx.filter_jit
    def values(body, pi, omega):
        return [
            body.inertia,
            body.energy(pi),
            body.angular_velocity(pi),
            body.angular_momentum(omega),
            body.discrete_inertia(),
        ]

    formulas = [
        GENERIC,
        PI0 @ omega / 2,
        omega,
        PI0,
        np.trace(GENERIC) / 2 * np.eye(3) - GENERIC,
    ]
    given = jnp.asarray(PI0, dtype), jnp.asarray(omega, dtype)
    for actual, desired in zip(values(body, *given), formulas, strict=True):
        assert actual.dtype == dtype
        np.testing.assert_allclose(actual, desired, rtol=0, atol=8 * eps(dtype))


@pytest.mark.parametrize(
    ("kind", "field"),
    [
        (lgvi.PhysicalRigidBody, "log_cholesky"),
        (lgvi.KnownAxesRigidBody, "log_second_moments"),
    ],
)
def test_what_is_computed_says_so_where_it_is_to_be_replaced(kind, field):
    body = kind.from_principal_moments(MOMENTS)
    words = f"`inertia` of a `{kind.__name__}` is computed from `{field}`, .*: take `{field}`, "
    with pytest.raises(TypeError, match=words):
        eqx.tree_at(lambda body: body.inertia, body, jnp.eye(3))
    with pytest.raises(ValueError, match=words):
        lgvi.freeze(body, lambda body: body.inertia)


@pytest.mark.parametrize("kind", [lgvi.RigidBody, lgvi.PhysicalRigidBody])
def test_principal_moments_may_be_a_list_also_where_they_are_traced(kind):
    def middle(x):
        return kind.from_principal_moments([x, 2 * x, 2.5 * x]).inertia[1, 1]

    np.testing.assert_allclose(jax.jit(jax.grad(middle))(1.0), 2, rtol=1e-12)


@pytest.mark.parametrize("kind", [lgvi.RigidBody, lgvi.PhysicalRigidBody])
def test_principal_moments_and_axes_make_the_same_body(dtype, kind):
    axes = rotation(40)
    body = kind.from_principal_moments(jnp.asarray(MOMENTS, dtype), jnp.asarray(axes, dtype))
    assert type(body) is kind
    np.testing.assert_allclose(body.inertia, inertia(MOMENTS, axes), rtol=0, atol=8 * eps(dtype))
    plain = kind.from_principal_moments(jnp.asarray(MOMENTS, dtype))
    np.testing.assert_allclose(plain.inertia, np.diag(MOMENTS), rtol=0, atol=8 * eps(dtype))


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_from_inertia_keeps_the_inertia(dtype, scale):
    J = jnp.asarray(scale * physical_inertias(50, 40), dtype)
    back = eqx.filter_jit(eqx.filter_vmap(lambda J: lgvi.PhysicalRigidBody.from_inertia(J).inertia))
    unit = eps(dtype) * np.trace(J, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(back(J) / unit, J / unit, rtol=0, atol=16)


@pytest.mark.parametrize("spread", [1.0, 3.0])
def test_every_leaf_is_a_physical_body_with_a_finite_gradient(spread):
    def angular_velocity(leaf):
        body = lgvi.PhysicalRigidBody(leaf)
        return jnp.sum(body.angular_momentum(jnp.array([0.3, -0.2, 0.5]))), body.inertia

    leaves = spread * rng(41).normal(size=(500, 6))
    gradients, J = jax.jit(jax.vmap(jax.grad(angular_velocity, has_aux=True)))(leaves)
    assert np.all(np.isfinite(gradients))
    small, middle, large = np.linalg.eigvalsh(J).T
    # The inequality is strict; its margin can be below the rounding of the largest moment.
    margin = 4 * np.finfo(float).eps * large if spread > 1 else 0
    assert np.all(small + margin > 0)
    assert np.all(small + middle + margin > large)


UNPHYSICAL = {
    "triangle": (np.diag([1.0, 1.25, 3.0]), r"triangle.* 1, 1.25, 3: 1 \+ 1.25 = 2.25 .* 3"),
    "negative": (np.diag([-1.0, 2.0, 2.5]), r"positive definite.* -1, 2, 2.5: -1 is not"),
    "asymmetric": (GENERIC + np.triu(np.full((3, 3), 1e-3), 1), r"`inertia` must be symmetric"),
    "nan": (np.full((3, 3), np.nan), r"`inertia` must be finite"),
}


@pytest.mark.parametrize("problem", UNPHYSICAL)
def test_unphysical_inertias_are_refused_by_name(problem):
    J, message = UNPHYSICAL[problem]
    with pytest.raises(RuntimeError, match=message):
        lgvi.PhysicalRigidBody.from_inertia(J)
    plain = "an inertia is not that of a body"
    with pytest.raises(RuntimeError, match=plain):
        eqx.filter_jit(lgvi.PhysicalRigidBody.from_inertia)(jnp.asarray(J))
    with pytest.raises(RuntimeError, match=plain):
        eqx.filter_vmap(lgvi.PhysicalRigidBody.from_inertia)(jnp.stack([GENERIC, J, 2 * J]))


def test_a_flat_body_is_refused_because_the_inequality_is_strict():
    with pytest.raises(RuntimeError, match=r"1, 2, 3: 1 \+ 2 = 3 does not exceed 3"):
        lgvi.PhysicalRigidBody.from_principal_moments(np.array([1.0, 2.0, 3.0]))


@pytest.mark.parametrize("kind", [lgvi.RigidBody, lgvi.PhysicalRigidBody])
def test_wrong_moments_and_axes_are_refused(kind):
    for bad in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(RuntimeError, match=r"`moments` must be positive and finite"):
            kind.from_principal_moments(jnp.array([2.0, bad, 2.5]))
    with pytest.raises(RuntimeError, match=r"`axes` must be orthogonal"):
        kind.from_principal_moments(MOMENTS, 1.01 * rotation(41))


def test_an_almost_impossible_body_is_accepted(dtype):
    body = lgvi.PhysicalRigidBody.from_inertia(jnp.asarray(ROD, dtype))
    np.testing.assert_allclose(body.inertia, ROD, rtol=0, atol=4 * eps(dtype))


def test_leaves_are_floating_point_arrays(unchecked):
    matrix: Any = [[1, 0, 0], [0, 2, 0], [0, 0, 2]]
    coordinates: Any = [0, 0, 0, 0, 0, 0]
    moments: Any = [2, 2, 3]
    bodies = [
        lgvi.RigidBody(matrix),
        lgvi.RigidBody(np.diag([1, 2, 2])),
        lgvi.PhysicalRigidBody(coordinates),
        lgvi.PhysicalRigidBody.from_principal_moments(moments),
    ]
    for body in bodies:
        (leaf,) = jax.tree.leaves(body)
        assert eqx.is_inexact_array(leaf)
    np.testing.assert_array_equal(bodies[2].inertia, 2 * np.eye(3))


def test_wrong_shapes_are_refused(unchecked):
    with pytest.raises(ValueError, match=r"`inertia` must have shape \(3, 3\).* is \(3,\)"):
        lgvi.RigidBody(np.ones(3))
    with pytest.raises(ValueError, match=r"`log_cholesky` must have shape \(6,\).* is \(5,\)"):
        lgvi.PhysicalRigidBody(np.ones(5))
    with pytest.raises(ValueError, match=r"`inertia` must have shape \(3, 3\)"):
        lgvi.PhysicalRigidBody.from_inertia(np.ones(3))
    with pytest.raises(ValueError, match=r"`moments` must have shape \(3,\)"):
        lgvi.RigidBody.from_principal_moments(np.ones(2))


@pytest.mark.parametrize("make", KINDS)
def test_bodies_are_immutable(make):
    body = make(jnp.asarray(GENERIC))
    with pytest.raises(AttributeError):
        body.inertia = jnp.eye(3)


@pytest.mark.parametrize("make", KINDS)
def test_bodies_are_pytrees_of_one_leaf(make):
    body = make(jnp.asarray(GENERIC))
    learnable, static = eqx.partition(body, eqx.is_inexact_array)
    assert len(jax.tree.leaves(learnable)) == 1
    assert jax.tree.leaves(static) == []
    assert eqx.tree_equal(eqx.combine(learnable, static), body)


@pytest.mark.parametrize("make", KINDS)
def test_bodies_are_saved_and_loaded(make):
    body, other = make(jnp.asarray(GENERIC)), make(jnp.asarray(2 * GENERIC))
    file = io.BytesIO()
    eqx.tree_serialise_leaves(file, body)
    file.seek(0)
    assert eqx.tree_equal(eqx.tree_deserialise_leaves(file, other), body)
    assert not eqx.tree_equal(other, body)


@pytest.mark.parametrize("make", KINDS)
def test_many_bodies_in_one_module(make):
    Js = physical_inertias(4, 42)
    fleet = eqx.filter_jit(eqx.filter_vmap(make))(jnp.asarray(Js))
    energies = eqx.filter_jit(eqx.filter_vmap(lambda body: body.energy(PI0)))(fleet)
    desired = [PI0 @ np.linalg.solve(J, PI0) / 2 for J in Js]
    np.testing.assert_allclose(energies, desired, rtol=1e-12)


class Satellite(eqx.Module):
    """A larger model that holds a body."""

    body: lgvi.AbstractRigidBody
    gain: jax.Array

    def rate(self, pi):
        return self.gain * self.body.angular_velocity(pi)[0]


@pytest.mark.parametrize("make", KINDS)
def test_a_body_learns_inside_a_larger_model(make):
    model = Satellite(make(jnp.asarray(GENERIC)), jnp.asarray(2.0))
    value_and_gradient = eqx.filter_value_and_grad(lambda model: model.rate(PI0))
    value, gradient = eqx.filter_jit(value_and_gradient)(model)
    np.testing.assert_allclose(value, 2 * np.linalg.solve(GENERIC, PI0)[0], rtol=1e-13)
    np.testing.assert_allclose(gradient.gain, value / 2, rtol=1e-13)
    (leaf,) = jax.tree.leaves(gradient.body)
    assert np.any(leaf)


@pytest.mark.parametrize(
    ("dtype", "make"),
    [
        pytest.param(jnp.float32, KINDS[0], marks=pytest.mark.slow),
        (jnp.float64, KINDS[0]),
        (jnp.float32, KINDS[1]),
        pytest.param(jnp.float64, KINDS[1], marks=pytest.mark.slow),
    ],
)
def test_gradient_steps_keep_the_inertia_symmetric(dtype, make):
    body = make(jnp.asarray(GENERIC, dtype))
    R, pi = jnp.asarray(R0, dtype), jnp.asarray(PI0, dtype)
    optimiser = optax.adam(1e-2)

    @eqx.filter_jit
    def step(body, state):
        @eqx.filter_grad
        def gradient(body):
            Rs, _, _ = lgvi.simulate_free_rigid_body(R, pi, body.inertia, 0.1, 5)
            return jnp.sum(Rs[-1, 0])

        with jax.numpy_dtype_promotion("standard"):  # which optax relies on
            updates, state = optimiser.update(gradient(body), state)
        return eqx.apply_updates(body, updates), state

    state = optimiser.init(eqx.filter(body, eqx.is_inexact_array))
    learned = body
    for _ in range(3):
        learned, state = step(learned, state)
    J = np.asarray(learned.inertia)
    assert J.dtype == dtype
    assert np.max(np.abs(J - np.asarray(body.inertia))) > 1e-2
    np.testing.assert_allclose(J, J.T, rtol=0, atol=8 * eps(dtype))
