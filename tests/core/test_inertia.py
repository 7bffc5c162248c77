"""Inertias: second moments of mass, and coordinates of every physical body."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..derivatives import assert_first_derivatives_agree
from ..systems import BODIES, FLAT, GENERIC, physical_inertias, rng, rotation

SCALES = [1e-8, 1.0, 1e8]


def eps(dtype):
    return float(jnp.finfo(dtype).eps)


def test_discrete_inertia_is_the_second_moment_of_a_cloud_of_masses(dtype):
    masses, points = rng(1).uniform(1, 2, 20), rng(2).normal(size=(20, 3))
    square = np.sum(points**2, axis=1)
    J = np.einsum("n,n,ij->ij", masses, square, np.eye(3))
    second = np.einsum("n,ni,nj->ij", masses, points, points)
    Jd = lgvi.discrete_inertia(jnp.asarray(J - second, dtype))
    assert Jd.dtype == dtype
    np.testing.assert_allclose(Jd, second, rtol=0, atol=4 * eps(dtype) * np.trace(J))


@pytest.mark.parametrize("body", BODIES)
def test_inertia_from_discrete_inverts_discrete_inertia(dtype, body):
    J = jnp.asarray(BODIES[body], dtype)
    back = lgvi.inertia_from_discrete(lgvi.discrete_inertia(J))
    assert back.dtype == dtype
    np.testing.assert_allclose(back, J, rtol=0, atol=4 * eps(dtype) * np.trace(J))


def test_inertia_from_discrete_keeps_the_small_moment_of_a_rod(dtype):
    a = 1e-3 * eps(dtype)
    J = lgvi.inertia_from_discrete(jnp.asarray(np.diag([a, a, 1.0]), dtype))
    np.testing.assert_allclose(J[2, 2], 2 * a, rtol=4 * eps(dtype))


def test_principal_moments_and_axes_are_the_eigenvalues_and_eigenvectors(dtype):
    moments, axes = np.array([1.0, 2.0, 2.5]), rotation(4)
    J = lgvi.inertia_from_principal_moments(jnp.asarray(moments, dtype), jnp.asarray(axes, dtype))
    assert J.dtype == dtype
    np.testing.assert_array_equal(J, J.T)
    np.testing.assert_allclose(
        J @ jnp.asarray(axes, dtype), axes * moments, rtol=0, atol=8 * eps(dtype)
    )
    diagonal = lgvi.inertia_from_principal_moments(jnp.asarray(moments, dtype))
    np.testing.assert_array_equal(diagonal, np.diag(moments))


def test_log_cholesky_is_the_documented_factor_of_the_discrete_inertia():
    theta = rng(3).normal(size=6)
    M = np.eye(3)
    M[1, 0], M[2, 0], M[2, 1] = theta[3:]
    Jd = M @ np.diag(np.exp(2 * theta[:3])) @ M.T
    J = lgvi.inertia_from_log_cholesky(theta)
    np.testing.assert_allclose(J, np.trace(Jd) * np.eye(3) - Jd, rtol=1e-14)


def test_log_cholesky_round_trips_from_the_coordinates():
    theta = rng(4).normal(size=(100, 6))
    back = jax.jit(
        jax.vmap(lambda t: lgvi.log_cholesky_from_inertia(lgvi.inertia_from_log_cholesky(t)))
    )(theta)
    # Rounding of J is amplified by the condition number of Jd, up to about 1e4 here.
    np.testing.assert_allclose(back, theta, rtol=0, atol=1e-10)


@pytest.mark.parametrize("scale", SCALES)
def test_log_cholesky_round_trips_from_the_inertia(dtype, scale):
    J = jnp.asarray(scale * physical_inertias(100, 1), dtype)
    there = jax.jit(jax.vmap(lgvi.log_cholesky_from_inertia))(J)
    back = jax.jit(jax.vmap(lgvi.inertia_from_log_cholesky))(there)
    assert back.dtype == dtype
    trace = np.trace(J, axis1=1, axis2=2)[:, None, None]
    # A logarithm of size log(scale)/2 is stored with that many units of rounding.
    np.testing.assert_allclose(back / trace, J / trace, rtol=0, atol=16 * eps(dtype))


def test_a_change_of_unit_adds_one_constant_to_the_first_three_coordinates():
    theta = lgvi.log_cholesky_from_inertia(GENERIC)
    change = lgvi.log_cholesky_from_inertia(1e6 * GENERIC) - theta
    np.testing.assert_allclose(
        change, np.log(1e3) * np.array([1, 1, 1, 0, 0, 0]), rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("spread", [1.0, 3.0])
def test_every_coordinate_gives_a_physical_inertia(dtype, spread):
    theta = jnp.asarray(spread * rng(5).normal(size=(2000, 6)), dtype)
    J = np.asarray(jax.jit(jax.vmap(lgvi.inertia_from_log_cholesky))(theta), float)
    small, middle, large = np.linalg.eigvalsh(J).T
    assert np.all(np.isfinite(J))
    # The sums cannot be resolved below the rounding of J in its own precision.
    rounding = 4 * eps(dtype) * large
    assert np.all(small > -rounding)
    assert np.all(small + middle > large - rounding)
    if spread == 1 and dtype == jnp.float64:
        assert np.all((small > 0) & (small + middle > large))


def test_unphysical_inertias_have_no_coordinates():
    impossible = np.diag([1.0, 1.0, 2.5])
    assert np.any(np.isnan(lgvi.log_cholesky_from_inertia(impossible)))


def test_derivatives_of_the_coordinates():
    theta = jnp.asarray(rng(6).normal(size=(3, 6)) / 2)
    jacobian = assert_first_derivatives_agree(lgvi.inertia_from_log_cholesky, theta)
    inverse = jax.jit(jax.vmap(jax.jacrev(lgvi.log_cholesky_from_inertia)))(
        jax.vmap(lgvi.inertia_from_log_cholesky)(theta)
    ).reshape(3, 6, 9)
    identity = np.broadcast_to(np.eye(6), (3, 6, 6))
    np.testing.assert_allclose(inverse @ jacobian, identity, rtol=0, atol=1e-12)


def test_a_flat_body_is_the_boundary_of_the_physical_ones():
    assert not np.any(np.isnan(lgvi.log_cholesky_from_inertia(FLAT + 1e-6 * np.eye(3))))
    assert np.any(np.isnan(lgvi.log_cholesky_from_inertia(FLAT - 1e-6 * np.eye(3))))


@pytest.mark.parametrize(
    ("function", "name"),
    [
        (lgvi.discrete_inertia, "J"),
        (lgvi.inertia_from_discrete, "Jd"),
        (lgvi.inertia_from_log_cholesky, "coordinates"),
        (lgvi.log_cholesky_from_inertia, "J"),
        (lgvi.inertia_from_principal_moments, "moments"),
    ],
)
def test_errors_name_the_argument(unchecked, function, name):
    with pytest.raises(ValueError, match=rf"`{name}` must have shape .* its shape is \(2,\)"):
        function(np.ones(2))
    with pytest.raises(TypeError, match=rf"`{name}` must be real, but its dtype is complex128"):
        function(np.ones(2) * 1j)
    with pytest.raises(TypeError, match=rf"`{name}` must be an array or a number, but is 'text'"):
        function("text")


def test_integers_and_lists_become_floats(unchecked):
    values: Any = [[1, 0, 0], [0, 2, 0], [0, 0, 2]]
    J = lgvi.discrete_inertia(values)
    assert jnp.issubdtype(J.dtype, jnp.floating)
    np.testing.assert_array_equal(J, np.diag([1.5, 0.5, 0.5]))
