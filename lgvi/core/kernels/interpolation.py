"""Linear interpolation between samples, some of which may have the same time."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike


def _interval(t: Array, at: ArrayLike) -> tuple[Array, Array]:
    """Index of the interval of increasing times that contains `at` or ends there, and its length.

    The length is 1 instead of zero. Beyond the times the interval is the first one, or the last one
    that is longer than zero.
    """
    i = jnp.clip(jnp.searchsorted(t, jnp.minimum(at, t[-1])) - 1, 0, max(len(t) - 2, 0))
    length = t[jnp.minimum(i + 1, len(t) - 1)] - t[i]
    return i, jnp.where(length != 0, length, 1)


def interpolate(t: Array, values: Array, at: ArrayLike) -> Array:
    """The vector (...) at a time, linear between `values` (samples, ...); constant beyond.

    At a sample the derivative with respect to `at` is the slope of the interval before.
    """
    i, length = _interval(t, at)
    part = (at - t[i]) / length
    part = jnp.where(part < 0, 0, jnp.where(part > 1, 1, part))
    return values[i] + part * (values[jnp.minimum(i + 1, len(t) - 1)] - values[i])


def line_at(t: Array, values: Array, at: ArrayLike) -> tuple[Array, Array]:
    """The vector (...) and the slope of the line between two `values`, extended beyond the samples.

    At a sample the line is the one that ends there.
    """
    i, length = _interval(t, at)
    slope = (values[jnp.minimum(i + 1, len(t) - 1)] - values[i]) / length
    return values[i] + (at - t[i]) * slope, slope
