r"""What is constant along a motion: the numbers in its theta functions.

With the reciprocal moments $\beta$, $\alpha_i = \beta_k - \beta_j$ and $(i, j, k)$ cyclic, the
functions belong to the cubic of the roots $e_i = \bar x - x_i$, $x_i = \alpha_j\alpha_k\pi_i^2$.
Of the axes h, m, l (`axes.py`) the root of h is the largest and that of m the smallest.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.vectors import Vec3
from .axes import Axes
from .sigma import Lattice, lattice_of
from .theta import Angle, Pairs, harmonics, root, sums


class Roots(NamedTuple):
    lattice: Lattice
    first: Array  # the root of h less that of l
    second: Array  # the root of l less that of m
    sizes: Vec3  # the square roots of |x_h|, |x_m|, |x_l|


class Frame(NamedTuple):
    """The frame of a momentum and an axis, which the motion turns about the momentum."""

    about_l: Array  # the axis is l, rather than h
    sign: Array  # of the phase that the frame turns by, beside a constant rate
    rate_at_start: Array
    eta: Array  # the parameter of the third kind, where it is an angle; else zero
    at_eta: Pairs


class Phase(NamedTuple):
    """The angle phi of the theta functions at which the motion starts."""

    side: Array  # its sign; 1 in the circular case
    c: Array  # its cosine and sine in the circular case
    s: Array
    u: Array  # exp(-|phi|) and q exp(|phi|) in the hyperbolic case
    v: Array


def roots_of(axes: Axes) -> Roots:
    a_h, a_l, (h, m, l) = axes.a_h, axes.a_l, axes.pi  # noqa: E741
    first, second = a_l * h**2 - a_h * l**2, a_h * (l**2 + a_l * m**2)
    hyperbolic = first < second
    # A product, so that near the separatrix the difference is as exact as its two factors are.
    size_h, size_l = jnp.sqrt(a_l) * jnp.abs(h), jnp.sqrt(a_h) * jnp.abs(l)
    first = jnp.where(hyperbolic, (size_h - size_l) * (size_h + size_l), first)
    sizes = Vec3(size_h, jnp.sqrt(a_h * a_l) * jnp.abs(m), size_l)
    return Roots(lattice_of(hyperbolic, first, second), first, second, sizes)


def frame_of(axes: Axes, roots: Roots) -> Frame:
    a_h, a_l, (h, m, l) = axes.a_h, axes.a_l, axes.pi  # noqa: E741
    beta_h, beta_m, beta_l = axes.beta
    hyperbolic, q, per_gap, kappa, zero, slope = roots.lattice
    squared = axes.pi.dot(axes.pi)
    # The momentum stays further than 45 degrees away from one of the two axes.
    about_l = l**2 + a_l * m**2 < squared / 2
    of_h, of_l = h**2 + a_h * m**2, l**2 + a_l * m**2
    weight = jnp.where(about_l, a_h, 1)
    weighted = jnp.where(about_l & ~hyperbolic, per_gap * of_l, q)
    ratio = kappa * slope / (zero.third * jnp.sqrt(jnp.where(about_l, squared, of_l)))
    opposite = zero.second * jnp.sqrt(jnp.where(about_l, a_h * of_h, a_l * of_l))

    def angle(x):
        """Of eta, or in the circular case, where it is imaginary, of its hyperbolic sine."""
        eta, sine = jnp.where(hyperbolic, x, 0), jnp.where(hyperbolic, 0, x)
        c = jnp.where(hyperbolic, jnp.cos(eta), jnp.sqrt(weight + sine**2))
        s = jnp.where(hyperbolic, jnp.sin(eta), sine)
        return Angle(c, s, weighted, jnp.where(hyperbolic, 1, -1))

    def equation(x):
        first, second, third, _ = sums(angle(x), q)
        return jnp.where(
            hyperbolic, opposite * first - kappa * slope * second, first - ratio * third
        )

    guess = jnp.where(hyperbolic, jnp.arctan2(kappa * slope, opposite), ratio)
    x = root(equation, guess)
    at = angle(x)
    sign = jnp.where(about_l, axes.sign, -axes.sign)
    other, beta = jnp.where(about_l, h, l) ** 2, jnp.where(about_l, beta_h, beta_l)
    rate = jnp.sqrt(squared) * (beta * other + beta_m * m**2) / (other + m**2)
    scale = jnp.where(hyperbolic, 1, weighted)
    d, f = 2 * scale * (at.c**2 - at.sign * at.s**2), 2 * scale * at.s * at.c
    at_eta = harmonics(d, f, jnp.where(hyperbolic, 1, q))
    return Frame(about_l, sign, rate, jnp.where(hyperbolic, x, 0), at_eta)


def phase_of(axes: Axes, roots: Roots) -> Phase:
    h, m, l = axes.pi  # noqa: E741
    hyperbolic, q, per_gap, _, zero, _ = roots.lattice
    size_h, size_m, size_l = roots.sizes
    across = jnp.sqrt(axes.a_l) * m * axes.sign * jnp.where(h < 0, -1, 1)
    side = jnp.where(hyperbolic & (l * across < 0), -1, 1)
    cosine, sine = l * zero.third, across * zero.fourth
    # u and v to leading order; both vanish on the unstable axis, where phi is infinite.
    high, wide = size_m * zero.second, (size_h + size_l) / 2
    tall = high + jnp.sqrt(high**2 + wide**2)

    def scales(x):
        x = jnp.where(hyperbolic, x, 0)
        return wide / tall * jnp.exp(-x), 2 * per_gap * (size_h - size_l) * tall * jnp.exp(x)

    def equation(x):
        phi = jnp.where(hyperbolic, 0, x)
        first, second, _, _ = sums(Angle(jnp.cos(phi), jnp.sin(phi), q), q)
        u, v = scales(x)
        even = 1 - u**2 - v**2 + q**2 * (u**4 + v**4) - q**6 * (u**6 + v**6)
        odd = u - v - q * (u**3 - v**3) + q**4 * (u**5 - v**5)
        return jnp.where(
            hyperbolic, size_l * zero.third * even - 2 * high * odd, first * cosine - second * sine
        )

    x = root(equation, jnp.where(hyperbolic, 0, jnp.arctan2(sine, cosine)))
    phi = jnp.where(hyperbolic, 0, x)
    return Phase(side, jnp.cos(phi), jnp.sin(phi), *scales(x))
