"""Rotations: the charts invert each other, agree with SciPy, and have all derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lgvi import so3

from ..derivatives import assert_first_derivatives_agree, assert_second_derivatives_agree
from ..systems import hat, rng

COUNT = 200
AXES = {
    "x": [1.0, 0.0, 0.0],
    "y": [0.0, 1.0, 0.0],
    "z": [0.0, 0.0, -1.0],
    "oblique": [2 / 3, -1 / 3, 2 / 3],
}
# Where the formulas change: |g| = 1/2 and 1 in exp, 0.2 and 2 pi/3 in log.
CUTOFFS = [0.2, 2 * np.arctan(0.1), 0.5, 1.0, 2 * np.pi / 3]
ANGLES = [0.0, 1e-8, 1e-3, *CUTOFFS, np.pi - 1e-6]


def rotation_vectors(dtype, largest=np.pi - 1e-2):
    axes = rng(1).normal(size=(COUNT, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return jnp.asarray(axes * rng(2).uniform(0, largest, (COUNT, 1)), dtype)


def eps(dtype):
    return float(jnp.finfo(dtype).eps)


def assert_close(actual, desired, atol):
    np.testing.assert_allclose(np.asarray(actual, float), np.asarray(desired), rtol=0, atol=atol)


def test_hat_is_the_cross_product(dtype):
    v, w = jnp.asarray(rng(3).normal(size=(2, 3)), dtype)
    S = so3.hat(v)
    assert S.dtype == dtype
    assert_close(S @ w, np.cross(v, w), 4 * eps(dtype))
    np.testing.assert_array_equal(S, -S.T)


def test_vee_inverts_hat_and_ignores_the_symmetric_part(dtype):
    v = jnp.asarray(rng(4).normal(size=3), dtype)
    A = jnp.asarray(rng(5).integers(-9, 9, (3, 3)), dtype)
    np.testing.assert_array_equal(so3.vee(so3.hat(v)), v)
    np.testing.assert_array_equal(so3.vee(A + A.T), np.zeros(3))
    np.testing.assert_array_equal(so3.hat(so3.vee(A)), (A - A.T) / 2)


def test_exp_agrees_with_scipy_beyond_half_turns(dtype):
    g = rotation_vectors(dtype, largest=6.0)
    R = jax.jit(jax.vmap(so3.exp))(g)
    assert R.dtype == dtype
    assert_close(R, Rotation.from_rotvec(np.array(g, float)).as_matrix(), 8 * eps(dtype))


def test_log_inverts_exp(dtype):
    g = rotation_vectors(dtype)
    back = jax.jit(jax.vmap(there_and_back))(g)
    assert back.dtype == dtype
    assert_close(back, g, 8 * eps(dtype))


def test_the_distance_is_the_angle_up_to_half_a_turn(dtype):
    angles = np.append(rng(61).uniform(0, np.pi, COUNT), [*ANGLES, np.pi])
    axes = rng(62).normal(size=(len(angles), 3))
    turns = Rotation.from_rotvec(axes * (angles / np.linalg.norm(axes, axis=1))[:, None])
    first = Rotation.from_quat(rng(63).normal(size=(len(angles), 4)))
    R1, R2 = (jnp.asarray(R.as_matrix(), dtype) for R in (first, first * turns))
    values, derivatives = jax.jit(jax.vmap(jax.value_and_grad(so3.distance, argnums=1)))(R1, R2)
    assert values.dtype == dtype
    assert_close(values, angles, 16 * eps(dtype))
    # Along a turn about the axis the angle grows as the turn does.
    turning = np.array([R @ hat(g) for R, g in zip(np.asarray(R2), turns.as_rotvec(), strict=True)])
    along = np.einsum("nij,nij->n", derivatives, turning)
    known = (angles > 0.1) & (angles < np.pi)
    assert_close(along[known], angles[known], 1e3 * eps(dtype))
    assert np.all(np.isfinite(derivatives))


def test_at_no_distance_the_derivative_is_zero_and_second_ones_are_finite():
    eye = jnp.eye(3)
    np.testing.assert_array_equal(jax.grad(so3.distance)(eye, eye), np.zeros((3, 3)))
    assert np.all(np.isfinite(jax.hessian(so3.distance)(eye, eye)))
    assert np.isnan(so3.distance(eye, 2 * eye))


there_and_back = jax.jit(lambda g: so3.log(so3.exp(g)))


@pytest.mark.parametrize("angle", [1e-3, 1e-8, 1e-15])
def test_log_inverts_exp_with_relative_accuracy_at_tiny_angles(dtype, angle):
    g = jnp.asarray(angle * np.array(AXES["oblique"]), dtype)
    assert_close(there_and_back(g), g, 4 * eps(dtype) * angle)


def test_log_agrees_with_scipy(dtype):
    R = jnp.asarray(Rotation.random(COUNT, rng=rng(6)).as_matrix(), dtype)
    desired = Rotation.from_matrix(np.array(R, float)).as_rotvec()
    # Near half a turn the sign of the vector may differ: compare rotations.
    g = np.array(jax.jit(jax.vmap(so3.log))(R), float)
    assert_close(Rotation.from_rotvec(g).as_matrix(), np.asarray(R), 16 * eps(dtype))
    assert_close(np.linalg.norm(g, axis=1), np.linalg.norm(desired, axis=1), 16 * eps(dtype))


exp, log = jax.jit(so3.exp), jax.jit(so3.log)


@pytest.mark.parametrize("axis", AXES)
def test_log_of_half_a_turn_has_length_pi_and_is_a_logarithm(dtype, axis):
    n = np.array(AXES[axis])
    R = jnp.asarray(2 * np.outer(n, n) - np.eye(3), dtype)
    g = log(R)
    assert_close(np.linalg.norm(g), np.pi, 4 * eps(dtype))
    assert_close(exp(g), R, 8 * eps(dtype))


def test_cayley_is_its_matrix_formula_and_the_exponential_of_twice_the_arctangent(dtype):
    c = rotation_vectors(dtype)
    F = jax.jit(jax.vmap(so3.cayley))(c)
    assert F.dtype == dtype
    c = np.asarray(c, float)
    length = np.linalg.norm(c, axis=1, keepdims=True)
    g = 2 * np.arctan(length) * c / length
    assert_close(F, Rotation.from_rotvec(g).as_matrix(), 8 * eps(dtype))
    solved = [np.linalg.solve(np.eye(3) - hat(c_i), np.eye(3) + hat(c_i)) for c_i in c]
    assert_close(F, solved, 16 * eps(dtype))


def test_cayley_inverse_inverts_cayley(dtype):
    # The relative error grows as 1 + c.c towards half a turn.
    c = jnp.asarray(rng(8).normal(size=(COUNT, 3)), dtype)
    back = jax.jit(jax.vmap(lambda c: so3.cayley_inverse(so3.cayley(c))))(c)
    assert back.dtype == dtype
    error = jnp.linalg.norm(back - c, axis=1) / (1 + jnp.sum(c * c, axis=1)) ** 1.5
    assert jnp.max(error) < 4 * eps(dtype)


@pytest.mark.parametrize("chart", [so3.exp, so3.cayley])
def test_charts_give_rotations(dtype, chart):
    R = np.asarray(jax.jit(jax.vmap(chart))(rotation_vectors(dtype, largest=6.0)), float)
    assert_close(np.swapaxes(R, 1, 2) @ R, np.broadcast_to(np.eye(3), R.shape), 16 * eps(dtype))
    assert_close(np.linalg.det(R), np.ones(COUNT), 16 * eps(dtype))


def test_quaternions_agree_with_scipy(dtype):
    rotations = Rotation.random(COUNT, rng=rng(9))
    R = jnp.asarray(rotations.as_matrix(), dtype)
    wxyz = jax.jit(jax.vmap(so3.matrix_to_wxyz))(R)
    assert wxyz.dtype == dtype
    assert_close(wxyz, rotations.as_quat(canonical=True, scalar_first=True), 4 * eps(dtype))
    assert_close(jax.jit(jax.vmap(so3.wxyz_to_matrix))(wxyz), R, 8 * eps(dtype))


def test_wxyz_to_matrix_ignores_length_and_sign(dtype):
    wxyz = jnp.asarray(rng(10).normal(size=4), dtype)
    R = so3.wxyz_to_matrix(wxyz)
    desired = Rotation.from_quat(np.array(wxyz, float), scalar_first=True).as_matrix()
    assert_close(R, desired, 4 * eps(dtype))
    largest = float(np.sqrt(np.finfo(dtype).max))  # the square of a length overflows
    for length in (-1000, 10 * largest, 0.1 / largest):
        assert_close(so3.wxyz_to_matrix(length * wxyz), desired, 4 * eps(dtype))


@pytest.mark.parametrize("largest", range(4))
def test_matrix_to_wxyz_has_a_nonnegative_scalar_part_whichever_part_is_largest(dtype, largest):
    wxyz = np.full(4, -0.1)
    wxyz[largest] = 1
    wxyz /= np.linalg.norm(wxyz)
    R = so3.wxyz_to_matrix(jnp.asarray(wxyz, dtype))
    back = so3.matrix_to_wxyz(R)
    assert back[0] >= 0
    assert_close(back, wxyz if wxyz[0] > 0 else -wxyz, 4 * eps(dtype))


NO_ROTATIONS = {
    "zero": np.zeros((3, 3)),
    "a reflection": np.diag([1.0, 1.0, -1.0]),
    "minus one": -np.eye(3),
    "too long": 1.001 * np.eye(3),
    "sheared": np.eye(3) + 0.01 * np.eye(3, k=1),
    "not a number": np.full((3, 3), np.nan),
}


def test_a_rotation_is_told_from_other_matrices(dtype):
    rotations = Rotation.random(COUNT, rng=rng(11)).as_matrix()
    R = jnp.asarray([*rotations, *NO_ROTATIONS.values()], dtype)
    found = jax.jit(jax.vmap(so3.is_rotation))(R)
    np.testing.assert_array_equal(found, [True] * COUNT + [False] * len(NO_ROTATIONS))
    nearly = jnp.asarray(rotations[0] * 1.0001, dtype)
    assert so3.is_rotation(nearly)
    assert not so3.is_rotation(nearly, tolerance=1e-4)


def test_a_matrix_that_is_no_rotation_has_no_chart(dtype):
    R = jnp.asarray([np.eye(3), *NO_ROTATIONS.values()], dtype)

    @jax.jit
    @jax.vmap
    def charts(R):
        return jnp.concatenate([so3.log(R), so3.matrix_to_wxyz(R), so3.cayley_inverse(R)])

    found = charts(R)
    assert found.dtype == dtype
    assert_close(found[0], [0.0, 0.0, 0.0, 1.0, *[0.0] * 6], 0)
    assert jnp.all(jnp.isnan(found[1:]))


def points(angles, dtype):
    """Every angle about every axis."""
    vectors = np.array(angles)[:, None, None] * np.array(list(AXES.values()))
    return jnp.asarray(vectors.reshape(-1, 3), dtype)


def all_derivatives(f, x):
    """First derivatives forward and reverse, and second ones, at a batch of points."""

    def each(x):
        def reverse(x):
            return (jax.jacrev(f)(x),) * 2

        second, first = jax.jacfwd(reverse, has_aux=True)(x)
        return jax.jacfwd(f)(x), first, second

    return jax.jit(jax.vmap(each))(x)


def test_derivatives_of_exp():
    g = points([*ANGLES, np.pi, 5.0], float)
    assert_first_derivatives_agree(so3.exp, g)
    assert_second_derivatives_agree(so3.exp, g)


def test_second_derivative_of_exp_at_zero_is_the_symmetric_product_of_generators(dtype):
    hessian = jax.jit(jax.jacfwd(jax.jacrev(so3.exp)))(jnp.zeros(3, dtype))
    generators = np.stack([hat(e) for e in np.eye(3)])
    products = np.einsum("iab,jbc->acij", generators, generators)
    assert_close(hessian, (products + np.swapaxes(products, 2, 3)) / 2, 4 * eps(dtype))


def test_log_after_exp_has_the_derivatives_of_the_identity(dtype):
    # In single precision the last angle rounds to beyond half a turn.
    g = points(ANGLES if dtype == jnp.float64 else ANGLES[:-1], dtype)
    forward, reverse, hessian = all_derivatives(there_and_back, g)
    assert_close(forward, np.broadcast_to(np.eye(3), forward.shape), 8 * eps(dtype))
    assert_close(reverse, np.broadcast_to(np.eye(3), reverse.shape), 8 * eps(dtype))
    assert_close(hessian, np.zeros(hessian.shape), 32 * eps(dtype))


@pytest.mark.parametrize("dtype", [pytest.param(jnp.float32, marks=pytest.mark.slow), jnp.float64])
def test_log_has_the_derivatives_of_a_logarithm_at_half_a_turn(dtype):
    """Whichever branch is returned there, exp after log is the identity on rotations."""
    g = points([np.pi - 1e-6, np.pi, np.pi + 1e-6], dtype)
    turned_back = all_derivatives(lambda g: so3.exp(so3.log(so3.exp(g))), g)
    for actual, desired in zip(turned_back, all_derivatives(so3.exp, g), strict=True):
        assert_close(actual, desired, 32 * eps(dtype))


def test_derivatives_of_quaternions():
    """Wherever each of the four parts is the largest."""
    wxyz = jnp.asarray(0.3 + 0.8 * np.eye(4))
    assert_first_derivatives_agree(so3.wxyz_to_matrix, wxyz)

    def back(q):
        return so3.matrix_to_wxyz(so3.wxyz_to_matrix(q))

    def normalised(q):
        return q / jnp.linalg.norm(q)

    derivatives = zip(all_derivatives(back, wxyz), all_derivatives(normalised, wxyz), strict=True)
    for actual, desired in derivatives:
        assert_close(actual, desired, 1e-14)


def test_derivatives_of_cayley():
    c = jnp.array([[0.3, -0.5, 0.2], [0.0, 0.0, 0.0]])
    assert_first_derivatives_agree(so3.cayley, c)
    assert_second_derivatives_agree(so3.cayley, c)
    round_trip = jax.jit(jax.vmap(jax.jacfwd(lambda c: so3.cayley_inverse(so3.cayley(c)))))(c)
    assert_close(round_trip, np.broadcast_to(np.eye(3), (2, 3, 3)), 1e-14)
