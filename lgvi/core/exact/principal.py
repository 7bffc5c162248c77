r"""The exact motion by theta functions.

With $S = \sigma(t)$ and $C_i = \sigma_i(t)$, the sigma functions of the roots (`constants.py`)
less a common factor, the momentum in principal axes is

$$\pi_i(t) = \frac{C_j C_k\,\pi_i + \alpha_i\,S\,C_i\,\pi_j\pi_k}{C_i^2 - x_i S^2}.$$

The attitude turns a frame of the momentum and a principal axis about the momentum, by an angle
that grows at a constant rate but for the phase of a theta function. After Jacobi, van Zon and
Schofield 2007, and Celledoni, Fasso, Saefstroem and Zanna 2008; the form here has no case in which
something cancels.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ..kernels import vectors as xyz
from ..kernels.vectors import Matrix, Vector
from .axes import arranged
from .constants import Frame, Phase, Roots, frame_of, phase_of, roots_of
from .theta import Angle, Pairs, harmonics, sums

# XLA stores the results of a division, a root or a sine once. It would compute cheaper results
# anew for each use; so what is used often is made to end in a division.


class Clock(NamedTuple):
    """The angle kappa t, for each time: less whole periods in the hyperbolic case."""

    periods: Array
    cosine: Array  # in the circular case, else of zero
    sine: Array
    growth: Array  # exp of the angle times the sign of phi in the hyperbolic case, else 1


def principal_motion(
    moments: Vector, axes: Matrix, pi0: Vector, t: Array
) -> tuple[Matrix, Vector, Vector]:
    """Attitudes relative to the first and momenta at times `t`, in the body frame, and integrals.

    For ascending moments, principal axes as columns, and a momentum in these axes. Component k of
    the integrals is that of pi_i pi_j over time, in the principal axes, with i, j, k cyclic.
    """
    order = arranged(moments, pi0)
    roots = roots_of(order)
    frame, phase = frame_of(order, roots), phase_of(order, roots)
    clock = _clock(roots, phase, t)
    S, C = _sigma(roots, phase, clock)
    alpha = xyz.scale(order.sign, (-order.gaps[0], order.gaps[1], -order.gaps[2]))
    pi = xyz.apply(axes, order.restored(_momentum(order.pi, alpha, S, C)))
    integrals = _integrals(order.pi, alpha, S, C, C[0] * C[0] + roots.x_h * S * S)
    angle, phases = _turn(roots, frame, phase, clock, t)
    first, _, last = xyz.transpose(axes)
    x, y, z = (jnp.where(frame.low ^ order.swap, *pair) for pair in zip(last, first, strict=True))
    R, pi = _attitudes((x, y, z), xyz.apply(axes, pi0), pi, angle, phases)
    return R, pi, xyz.scale(order.sign, order.restored(integrals))


def _clock(roots: Roots, phase: Phase, t: Array) -> Clock:
    z, hyperbolic = roots.kappa * t, roots.hyperbolic
    period = -jnp.log(jnp.where(hyperbolic, roots.q, 0.1))
    periods = jnp.where(hyperbolic, jnp.round(z / period), 0)
    growth = jnp.exp(jnp.where(hyperbolic, phase.side * (z - periods * period), 0))
    angle = jnp.where(hyperbolic, 0, z)
    return Clock(periods, jnp.cos(angle), jnp.sin(angle), growth)


def _sigma(roots: Roots, phase: Phase, clock: Clock) -> tuple[Array, Vector]:
    """S, C_h, C_m and C_l, all over C_l."""
    hyperbolic, zero, growth = roots.hyperbolic, roots.zero, clock.growth
    c = jnp.where(hyperbolic, (growth + 1 / growth) / 2, clock.cosine)
    s = jnp.where(hyperbolic, phase.side * (growth - 1 / growth) / 2, clock.sine)
    at = sums(Angle(c, s, roots.q, jnp.where(hyperbolic, -1, 1)), roots.q)
    flip = 1 - 2 * jnp.abs(jnp.remainder(clock.periods, 2))  # sign after whole periods
    of_l = at.third / zero.third
    S = (flip * (at.first / (roots.kappa * roots.slope))) / of_l
    second, fourth = (at.second / zero.second) / of_l, flip * (at.fourth / zero.fourth) / of_l
    of_h, of_m = jnp.where(hyperbolic, fourth, second), jnp.where(hyperbolic, second, fourth)
    return S, (of_h, of_m, jnp.ones_like(S))


def _momentum(pi: Vector, alpha: Vector, S: Array, C: Vector) -> Vector:
    """The momentum, but for a factor that its components share."""

    def component(k, i, j):
        return C[i] * C[j] * pi[k] + S * C[k] * (alpha[k] * pi[i] * pi[j])

    return component(0, 1, 2), component(1, 2, 0), component(2, 0, 1)


def _integrals(pi: Vector, alpha: Vector, S: Array, C: Vector, D: Array) -> Vector:
    """Of pi_i pi_j over time: (pi_k(t) - pi_k(0)) / alpha_k, also where alpha_k is small."""
    square, product_of_alpha = S * S / D, alpha[0] * alpha[1] * alpha[2]

    def integral(k, i, j):
        x, y, product = pi[i] ** 2, pi[j] ** 2, C[i] * C[j] / D
        # (product^2 - 1) / alpha_k; where the product is negative, alpha_k is not small.
        rest = square * (alpha[j] * x + alpha[i] * y) + square**2 * (product_of_alpha * x * y)
        plus = product > 0
        rest = jnp.where(plus, rest / jnp.where(plus, product + 1, 1), (product - 1) / alpha[k])
        return pi[k] * rest + S * C[k] / D * (pi[i] * pi[j])

    return integral(0, 1, 2), integral(1, 2, 0), integral(2, 0, 1)


def _turn(
    roots: Roots, frame: Frame, phase: Phase, clock: Clock, t: Array
) -> tuple[Array, tuple[Array, Array]]:
    """The angle by which the frame has turned, and a complex number whose phase adds to it.

    The phase is that of theta4(z + phi - i eta), circular, or of theta2(i (z + phi) - eta), which
    is written about half a period, where it is a third theta function.
    """
    hyperbolic, q, growth, (u, v) = roots.hyperbolic, roots.q, clock.growth, (phase.u, phase.v)
    before = hyperbolic & (growth < u)  # z + phi is negative: one more period
    up, down = jnp.where(before, growth / u, growth * v), jnp.where(before, q * u, u) / growth
    c = clock.cosine * phase.c - clock.sine * phase.s
    s = clock.sine * phase.c + clock.cosine * phase.s

    def theta(c, s, up, down):
        d = jnp.where(hyperbolic, up * up + down * down, 2 * (c * c - s * s))
        f = jnp.where(hyperbolic, (up * up - down * down) / 2, 2 * s * c)
        at_z = harmonics(d, f, jnp.where(hyperbolic, q, 1))
        return _third(at_z, frame.at_eta, q, jnp.where(hyperbolic, 1, -1))

    (x, y), (x0, y0) = theta(c, s, up, down), theta(phase.c, phase.s, v, u)
    periods = phase.side * clock.periods - jnp.where(before, 1, 0)
    way = frame.sign * jnp.where(hyperbolic, phase.side, -1)
    angle = frame.rate * t + way * 2 * frame.eta * periods
    return angle, (x * x0 + y * y0, way * (y * x0 - x * y0))


def _third(at_x: Pairs, at_y: Pairs, q: Array, sign: Array) -> tuple[Array, Array]:
    """Real and imaginary part of theta3(x + iy) (`sign` 1) or theta4(x + iy) (-1)."""
    weights = 2 * sign, 2 * q**2, 2 * sign * q**6
    real, imaginary = jnp.ones_like(at_x[0][0]), jnp.zeros_like(at_x[0][0])
    for weight, (e, f), (E, F) in zip(weights, at_x, at_y, strict=True):
        real, imaginary = real + weight * e * E, imaginary + weight * f * F
    return real, imaginary


def _attitudes(
    axis: Vector, pi0: Vector, pi: Vector, angle: Array, phases: tuple[Array, Array]
) -> tuple[Matrix, Vector]:
    """Attitudes and momenta of length |pi0|, from momenta of any length."""
    x, y, z = _frame(axis, pi0)
    size = jnp.sqrt(xyz.dot(pi, pi))
    of_pi = pi[0] / size, pi[1] / size, pi[2] / size
    along, (real, imaginary) = xyz.dot(axis, of_pi), phases
    size = jnp.sqrt((1 - along * along) * (real * real + imaginary * imaginary))
    c, s = jnp.cos(angle), jnp.sin(angle)
    c, s = (c * real - s * imaginary) / size, (s * real + c * imaginary) / size
    first, second = xyz.subtract(axis, xyz.scale(along, of_pi)), xyz.cross(of_pi, axis)
    first, second = (
        xyz.subtract(xyz.scale(c, first), xyz.scale(s, second)),
        xyz.add(xyz.scale(s, first), xyz.scale(c, second)),
    )
    # Rows: the columns x, y, z of the first frame times the rows of the turned one.
    columns = (
        xyz.add(xyz.scale(a, x), xyz.add(xyz.scale(b, y), xyz.scale(c, z)))
        for a, b, c in zip(first, second, of_pi, strict=True)
    )
    a, b, c = columns
    return xyz.transpose((a, b, c)), xyz.scale(jnp.sqrt(xyz.dot(pi0, pi0)), of_pi)


def _frame(axis: Vector, pi: Vector) -> Matrix:
    """The unit vectors along `axis` less its part along `pi`, across both, and along `pi`."""
    z = xyz.scale(1 / jnp.sqrt(xyz.dot(pi, pi)), pi)
    along = xyz.dot(axis, z)
    reciprocal = 1 / jnp.sqrt(1 - along * along)
    x = xyz.scale(reciprocal, xyz.subtract(axis, xyz.scale(along, z)))
    return x, xyz.cross(z, x), z
