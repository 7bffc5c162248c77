r"""What is constant along a motion: the numbers in its theta functions.

With the reciprocal moments $\beta$, $\alpha_i = \beta_k - \beta_j$ and $(i, j, k)$ cyclic, the
functions belong to the cubic of the roots $e_i = \bar x - x_i$, $x_i = \alpha_j\alpha_k\pi_i^2$.
Of the axes h, m, l (`axes.py`) the root of h is the largest and that of m the smallest.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels import vectors as xyz
from .axes import Axes, away_from_zero
from .sigma import Lattice, lattice_of
from .theta import Angle, Pairs, harmonics, root, slope_of_first, sums


class Roots(NamedTuple):
    lattice: Lattice
    first: Array  # root of h less that of l
    second: Array  # root of l less that of m
    x_h: Array  # minus x_h and x_l of the cubic, so that all three are positive
    x_m: Array
    x_l: Array
    margin: Array  # the square root of x_h less that of x_l


class Frame(NamedTuple):
    """The frame of a momentum and an axis, which the motion turns about the momentum."""

    low: Array  # the axis is l, rather than h
    sign: Array  # of what it turns by beyond `beta L t`
    rate: Array
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
    (a_h, a_m, a_l), (h, m, l) = axes.gaps, axes.pi  # noqa: E741
    x_h, x_m, x_l = a_m * a_l * h**2, a_h * a_l * m**2, a_m * a_h * l**2
    first, second = a_m * (a_l * h**2 - a_h * l**2), x_l + x_m
    hyperbolic = first < second
    # A product, so that near the separatrix the difference is as exact as its two factors are.
    root_h, root_l = jnp.sqrt(a_m * a_l) * jnp.abs(h), jnp.sqrt(a_m * a_h) * jnp.abs(l)
    eps = float(jnp.finfo(h.dtype).eps)
    margin = away_from_zero(root_h - root_l, eps**2 * jax.lax.stop_gradient(root_h))
    first = jnp.where(hyperbolic, margin * (root_h + root_l), first)
    return Roots(lattice_of(hyperbolic, first, second), first, second, x_h, x_m, x_l, margin)


def frame_of(axes: Axes, roots: Roots) -> Frame:
    (a_h, a_m, a_l), (h, m, l) = axes.gaps, axes.pi  # noqa: E741
    hyperbolic, q, per_gap, kappa, zero, slope = roots.lattice
    squared = xyz.dot(axes.pi, axes.pi)
    # The momentum stays further than 45 degrees away from one of the two axes.
    low = l**2 + a_l / a_m * m**2 < squared / 2
    of_h, of_l = a_m * h**2 + a_h * m**2, a_m * l**2 + a_l * m**2
    weight = jnp.where(low, a_h / a_m, 1)
    weighted = jnp.where(low & ~hyperbolic, per_gap * a_m * of_l, q)
    ratio = kappa * slope / (zero.third * jnp.sqrt(jnp.where(low, a_m**2 * squared, a_m * of_l)))
    opposite = zero.second * jnp.sqrt(jnp.where(low, a_h * of_h, a_l * of_l))

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
    sign = jnp.where(low, axes.sign, -axes.sign)
    rate = jnp.sqrt(squared) * jnp.where(low, axes.beta[2], axes.beta[0])
    rate = rate + sign * kappa * slope_of_first(at, q) / sums(at, q).first
    scale = jnp.where(hyperbolic, 1, weighted)
    d, f = 2 * scale * (at.c**2 - at.sign * at.s**2), 2 * scale * at.s * at.c
    at_eta = harmonics(d, f, jnp.where(hyperbolic, 1, q))
    return Frame(low, sign, rate, jnp.where(hyperbolic, x, 0), at_eta)


def phase_of(axes: Axes, roots: Roots) -> Phase:
    (_, a_m, a_l), (h, m, l) = axes.gaps, axes.pi  # noqa: E741
    hyperbolic, q, per_gap, _, zero, _ = roots.lattice
    root_h, root_m, root_l = (jnp.sqrt(x) for x in (roots.x_h, roots.x_m, roots.x_l))
    along = jnp.sqrt(a_m) * l
    across = jnp.sqrt(a_l) * m * axes.sign * jnp.where(h < 0, -1, 1)
    side = jnp.where(hyperbolic & (along * across < 0), -1, 1)
    cosine, sine = along * zero.third, across * zero.fourth
    # u and v to leading order; both vanish on the unstable axis, where phi is infinite.
    high, wide = root_m * zero.second, (root_h + root_l) / 2
    tall = high + jnp.sqrt(high**2 + wide**2)

    def scales(x):
        x = jnp.where(hyperbolic, x, 0)
        return wide / tall * jnp.exp(-x), 2 * per_gap * roots.margin * tall * jnp.exp(x)

    def equation(x):
        phi = jnp.where(hyperbolic, 0, x)
        first, second, _, _ = sums(Angle(jnp.cos(phi), jnp.sin(phi), q), q)
        u, v = scales(x)
        even = 1 - u**2 - v**2 + q**2 * (u**4 + v**4) - q**6 * (u**6 + v**6)
        odd = u - v - q * (u**3 - v**3) + q**4 * (u**5 - v**5)
        return jnp.where(
            hyperbolic, root_l * zero.third * even - 2 * high * odd, first * cosine - second * sine
        )

    x = root(equation, jnp.where(hyperbolic, 0, jnp.arctan2(sine, cosine)))
    phi = jnp.where(hyperbolic, 0, x)
    return Phase(side, jnp.cos(phi), jnp.sin(phi), *scales(x))
