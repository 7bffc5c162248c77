r"""Sums of Jacobi's theta functions, and the zero of a function of one number.

With the nome $q$ they are series in $q^{n^2}$ or $q^{n(n+1)}$. For $q \le 0.044$ four terms are
exact to rounding. The numbers may be arrays of one shape, or scalars.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

NEWTON_ITERATIONS = 5

Pairs = tuple[tuple[Array, Array], ...]


class Angle(NamedTuple):
    """An angle by its cosine and sine: circular for `sign` 1, hyperbolic for `sign` -1.

    Both are times the square root of a weight $w = c^2 \\pm s^2$, and `weighted` is $q/w$. They
    are the cosine and the sine for the weight 1. Another weight keeps them finite where the
    hyperbolic angle is infinite and the nome zero.
    """

    c: Array
    s: Array
    weighted: Array
    sign: Array | int = 1


class Sums(NamedTuple):
    """Theta functions of an angle, the first two over 2 q^(1/4), times the root of the weight."""

    first: Array
    second: Array
    third: Array
    fourth: Array


def sums(angle: Angle, q: Array) -> Sums:
    d, (c, c3, c5, c7), (s, s3, s5, s7) = _multiples(angle, q)
    q2, q4 = q**2, q**4
    q9 = q4 * q4 * q
    e1 = d / 2
    e2 = d * e1 - q2
    e3 = d * e2 - q2 * e1
    even, odd = 1 + 2 * q2 * e2, 2 * (e1 + q4 * q2 * e3)
    first, second = s - q * s3 + q4 * s5 - q9 * s7, c + q * c3 + q4 * c5 + q9 * c7
    return Sums(first, second, even + odd, even - odd)


def slope_of_first(angle: Angle, q: Array) -> Array:
    """The derivative of `sums(angle, q).first` with respect to the angle."""
    _, (c, c3, c5, c7), _ = _multiples(angle, q)
    q4 = q**4
    return c - 3 * q * c3 + 5 * q4 * c5 - 7 * q4 * q4 * q * c7


def _multiples(angle: Angle, q: Array):
    """2 q cos(2x), then q^n cos((2n+1) x) and q^n sin((2n+1) x) for n from 0 to 3."""
    c, s, weighted, sign = angle
    d, q2 = 2 * weighted * (c * c - sign * s * s), q * q
    c3, s3 = d * c - q * c, d * s + q * s
    c5, s5 = d * c3 - q2 * c, d * s3 - q2 * s
    return d, (c, c3, c5, d * c5 - q2 * c3), (s, s3, s5, d * s5 - q2 * s3)


def harmonics(d: Array, f1: Array, p: Array) -> Pairs:
    """The pairs $p^n \\cos 2nx$ and $p^n \\sin 2nx$ from $d = 2p\\cos 2x$ and $f_1 = p\\sin 2x$."""
    e1 = d / 2
    e2, f2 = d * e1 - p * p, d * f1
    return (e1, f1), (e2, f2), (d * e2 - p * p * e1, d * f2 - p * p * f1)


def root(function: Callable[[Array], Array], guess: Array) -> Array:
    """The zero of a function of one number near a good guess; differentiable to any order."""

    def solve(function, x):
        def improve(_, x):
            value, slope = jax.jvp(function, (x,), (jnp.ones_like(x),))
            return x - value / slope

        return jax.lax.fori_loop(0, NEWTON_ITERATIONS, improve, x)

    def divide(linear, value):
        return value / linear(jnp.ones_like(value))

    return jax.lax.custom_root(function, jax.lax.stop_gradient(guess), solve, divide)
