"""Functions of the squared angle, smooth at zero, where their closed forms divide by zero."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jaxtyping import Array


def sinc_sqrt(x: Array) -> Array:
    """sin(t)/t with t^2 = x."""
    coefficients = alternating(9, lambda k: (2 * k, 2 * k + 1))
    return smooth(x, 0.25, coefficients, lambda t: jnp.sin(t) / t)


def sine_remainder(x: Array) -> Array:
    """(t - sin(t))/t^3 with t^2 = x."""
    coefficients = [c / 6 for c in alternating(14, lambda k: (2 * k + 2, 2 * k + 3))]
    return smooth(x, 4.0, coefficients, lambda t: (t - jnp.sin(t)) / t**3)


def cosine_remainder(x: Array) -> Array:
    """(sin(t) - t cos(t))/t^3 with t^2 = x."""
    ratios = alternating(11, lambda k: (2 * k, 2 * k + 3))
    coefficients = [c / 3 for c in ratios]
    return smooth(x, 1.0, coefficients, lambda t: (jnp.sin(t) - t * jnp.cos(t)) / t**3)


def alternating(count: int, divisors: Callable[[int], tuple[int, int]]) -> list[float]:
    """Numbers from 1 on: each is the last one over minus the product of two divisors."""
    coefficients = [1.0]
    for k in range(1, count):
        first, second = divisors(k)
        coefficients.append(-coefficients[-1] / (first * second))
    return coefficients


def smooth(
    x: Array, limit: float, coefficients: Sequence[float], closed: Callable[[Array], Array]
) -> Array:
    """A power series in x below `limit`, and from there on a closed form in sqrt(x)."""
    small = x < limit
    # Neither a square root of zero nor a division by zero is differentiated.
    root = jnp.sqrt(jnp.where(small, 1, x))
    return jnp.where(small, horner(x, coefficients), closed(root))


def horner(x: Array, coefficients: Sequence[float] | Array) -> Array:
    """The polynomial with the given coefficients, the constant first."""
    value = jnp.zeros_like(x)
    for coefficient in reversed(coefficients):
        value = value * x + coefficient
    return value
