"""Linear interpolation against NumPy, and its derivatives where samples are."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from lgvi.core.kernels.interpolation import interpolate, line_at

from ..systems import rng


def test_between_samples_it_is_linear_and_beyond_them_constant():
    t = np.array([0.0, 0.1, 0.4, 0.4, 0.4])  # padded
    values = rng(160).normal(size=(5, 3))
    values[2:] = values[2]
    at = np.array([-1.0, 0.0, 0.05, 0.1, 0.3, 0.4, 2.0])
    found = jax.jit(jax.vmap(interpolate, (None, None, 0)))(t, values, at)
    expected = np.stack([np.interp(at, t, column) for column in values.T], axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-14)


def test_at_a_sample_the_derivative_is_the_slope():
    t, slope = np.array([0.0, 0.1, 0.4, 0.4]), np.array([1.0, -2.0, 3.0])
    values = t[:, None] * slope
    derivative = jax.jit(jax.vmap(jax.jacfwd(interpolate, argnums=2), (None, None, 0)))
    found = derivative(t, values, jnp.asarray(t[:3]))
    np.testing.assert_allclose(found, np.tile(slope, (3, 1)), rtol=1e-12)


def test_a_line_goes_on_beyond_the_samples_and_does_not_depend_on_padding():
    t, values = np.array([0.0, 0.1, 0.4]), rng(161).normal(size=(3, 3))
    at = jnp.array([-1.0, 0.05, 0.1, 0.3, 0.4, 2.0])
    slopes = np.diff(values, axis=0) / np.diff(t)[:, None]
    piece = [0, 0, 0, 1, 1, 1]
    expected = values[piece] + (at - t[piece])[:, None] * slopes[piece]
    for padding in (0, 3):
        padded = [jnp.concatenate([x, *[x[-1:]] * padding]) for x in (t, values)]
        found = jax.vmap(partial(line_at, *padded))(at)
        np.testing.assert_allclose(found, (expected, slopes[piece]), rtol=1e-12)


def test_one_sample_is_constant():
    found = interpolate(jnp.zeros(1), jnp.ones((1, 3)), 0.5)
    np.testing.assert_array_equal(found, np.ones(3))
