"""Diagnostics: their formulas, and derivatives where they have them."""

import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..derivatives import assert_first_derivatives_agree
from ..systems import GENERIC, PI0, R0, ROD


def eps(dtype):
    return float(jnp.finfo(dtype).eps)


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_energy_is_half_of_momentum_times_angular_velocity(dtype, scale):
    omega = np.array([0.7, -0.4, 0.5])
    desired = scale * omega @ GENERIC @ omega / 2
    value = lgvi.energy(jnp.asarray(scale * PI0, dtype), jnp.asarray(scale * GENERIC, dtype))
    assert value.dtype == dtype
    np.testing.assert_allclose(value, desired, rtol=8 * eps(dtype))


def test_energy_of_a_rod_about_its_own_axis(dtype):
    pi = jnp.asarray([0.0, 0.0, 2e-6], dtype)
    np.testing.assert_allclose(lgvi.energy(pi, jnp.asarray(ROD, dtype)), 2e-6, rtol=4 * eps(dtype))


def test_derivative_of_energy_is_the_angular_velocity():
    jacobian = assert_first_derivatives_agree(
        lgvi.energy, jnp.asarray(PI0)[None], jnp.asarray(GENERIC)[None]
    )
    np.testing.assert_allclose(jacobian[0, 0, :3], [0.7, -0.4, 0.5], rtol=1e-14)


def test_spatial_momentum_maps_body_to_space(dtype):
    # A quarter turn about z takes the body's x axis to the y axis of space.
    R = jnp.asarray([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype)
    value = lgvi.spatial_momentum(R, jnp.asarray([3.0, 0.0, 1.0], dtype))
    assert value.dtype == dtype
    np.testing.assert_array_equal(value, [0.0, 3.0, 1.0])


def test_errors_vanish_on_rotations(dtype):
    R = jnp.asarray(R0, dtype)
    assert lgvi.ortho_error(R) < 4 * eps(dtype)
    assert lgvi.determinant_error(R) < 4 * eps(dtype)
    assert lgvi.ortho_error(R).dtype == lgvi.determinant_error(R).dtype == dtype


def test_errors_measure_the_distance_from_a_rotation(dtype):
    R = jnp.asarray(R0, dtype)
    # (1.1^2 - 1) I has Frobenius norm 0.21 sqrt 3; the determinant is 1.1^3.
    stretched = 1.1 * R
    np.testing.assert_allclose(lgvi.ortho_error(stretched), 0.21 * np.sqrt(3), rtol=16 * eps(dtype))
    np.testing.assert_allclose(lgvi.determinant_error(stretched), 0.331, rtol=16 * eps(dtype))
    np.testing.assert_allclose(lgvi.determinant_error(-R), 2, rtol=4 * eps(dtype))
    assert lgvi.ortho_error(-R) < 4 * eps(dtype)


def test_errors_name_the_argument(unchecked):
    with pytest.raises(ValueError, match=r"`pi` must have shape \(3,\), but its shape is \(2,\)"):
        lgvi.energy(np.ones(2), GENERIC)
    with pytest.raises(ValueError, match=r"`R` must have shape \(3, 3\)"):
        lgvi.spatial_momentum(np.ones(3), np.ones(3))
    with pytest.raises(ValueError, match=r"`R` must have shape \(3, 3\).*jax.vmap"):
        lgvi.ortho_error(np.ones((5, 3, 3)))
