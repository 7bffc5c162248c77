r"""The sigma functions of time, of which the motion of the momentum is made.

They belong to the cubic whose roots are $e_h \ge e_l \ge e_m$, and are written in theta functions.
These are circular if $e_l$ is nearer to $e_m$, and hyperbolic if it is nearer to $e_h$. So the nome
is at most 0.044, whatever the roots.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.vectors import Vec3
from .axes import away_from_zero
from .theta import Angle, Sums, slope_of_first, sums


class Lattice(NamedTuple):
    hyperbolic: Array
    q: Array  # the nome
    per_gap: Array  # q over the difference of the two roots that are nearer to each other
    kappa: Array  # the angle of the theta functions is kappa t
    zero: Sums  # at zero
    slope: Array  # of the first one at zero


class Clock(NamedTuple):
    """The angle kappa t at each time: less whole periods in the hyperbolic case."""

    periods: Array
    cosine: Array  # in the circular case, else of zero
    sine: Array
    side: Array | int  # 1 or -1
    growth: Array  # exp(side angle) in the hyperbolic case, else 1


def lattice_of(hyperbolic: Array, first: Array, second: Array) -> Lattice:
    """Of the differences of the roots, `first` = e_h - e_l and `second` = e_l - e_m."""
    limits = jnp.finfo(first.dtype)
    total = away_from_zero(first + second, float(limits.tiny))
    first, second = first / total, second / total
    gap = away_from_zero(jnp.where(hyperbolic, first, second), float(limits.eps) ** 2)
    near = jnp.sqrt(jnp.where(hyperbolic, second, first))
    size = 1 + near + 2 * jnp.sqrt(near)
    half = 1 / (2 * size * (1 + near))  # half of (a - b)/(a + b) over the gap; b^4 = near^2, a = 1
    fourth = (gap * half) ** 4
    factor = half * (1 + fourth * (2 + fourth * (15 + fourth * (150 + fourth * 1707))))
    q, per_gap = gap * factor, factor / total
    kappa = jnp.sqrt(total) * size / (4 * (1 + 2 * q**4 + 2 * q**16) ** 2)
    none = Angle(jnp.ones_like(q), jnp.zeros_like(q), q)
    return Lattice(hyperbolic, q, per_gap, kappa, sums(none, q), slope_of_first(none, q))


def clock_of(lattice: Lattice, t: Array, side: Array | int = 1) -> Clock:
    z, hyperbolic = lattice.kappa * t, lattice.hyperbolic
    period = -jnp.log(jnp.where(hyperbolic, lattice.q, 0.1))
    periods = jnp.where(hyperbolic, jnp.round(z / period), 0)
    growth = jnp.exp(jnp.where(hyperbolic, side * (z - periods * period), 0))
    angle = jnp.where(hyperbolic, 0, z)
    return Clock(periods, jnp.cos(angle), jnp.sin(angle), side, growth)


def sigma_functions(lattice: Lattice, clock: Clock) -> tuple[Array, Vec3]:
    """S = sigma(t) and C = sigma_h(t), sigma_m(t), sigma_l(t), all over the last one."""
    hyperbolic, q, zero, growth = lattice.hyperbolic, lattice.q, lattice.zero, clock.growth
    c = jnp.where(hyperbolic, (growth + 1 / growth) / 2, clock.cosine)
    s = jnp.where(hyperbolic, clock.side * (growth - 1 / growth) / 2, clock.sine)
    at = sums(Angle(c, s, q, jnp.where(hyperbolic, -1, 1)), q)
    flip = 1 - 2 * jnp.abs(jnp.remainder(clock.periods, 2))  # sign after whole periods
    of_l = at.third / zero.third
    S = flip * (at.first / (lattice.kappa * lattice.slope)) / of_l
    second, fourth = (at.second / zero.second) / of_l, flip * (at.fourth / zero.fourth) / of_l
    of_h, of_m = jnp.where(hyperbolic, fourth, second), jnp.where(hyperbolic, second, fourth)
    return S, Vec3(of_h, of_m, jnp.ones_like(S))
