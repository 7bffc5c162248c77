r"""The exact motion by theta functions.

With $S = \sigma(t)$ and $C_i = \sigma_i(t)$, the sigma functions of the roots (`constants.py`)
less a common factor, the momentum in principal axes is

$$\pi_i(t) = \frac{C_j C_k\,\pi_i + \alpha_i\,S\,C_i\,\pi_j\pi_k}{C_i^2 - x_i S^2}.$$

The attitude turns a frame of the momentum and a principal axis about the momentum, by an angle
that grows at a constant rate but for the phase of a theta function. After Jacobi, van Zon and
Schofield 2007, and Celledoni, Fasso, Saefstroem and Zanna 2008; the form here has no case in which
something cancels.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.vectors import Mat3, Vec3
from .axes import arranged
from .constants import Frame, Phase, frame_of, phase_of, roots_of
from .sigma import Clock, Lattice, clock_of, sigma_functions
from .theta import Pairs, harmonics

# XLA stores the results of a division, a root or a sine once. It would compute cheaper results
# anew for each use; so what is used often is made to end in a division.


def principal_motion(moments: Vec3, axes: Mat3, pi0: Vec3, t: Array) -> tuple[Mat3, Vec3]:
    """Attitudes relative to the first and momenta at times `t`, in the body frame.

    For ascending moments, principal axes as columns, and a momentum in these axes.
    """
    order = arranged(moments, pi0)
    roots = roots_of(order)
    frame, phase = frame_of(order, roots), phase_of(order, roots)
    time = order.scale * t  # that of differences over `scale`
    clock = clock_of(roots.lattice, time, phase.side)
    S, C = sigma_functions(roots.lattice, clock)
    pi = axes @ order.restored(_momentum(order.pi, order.alpha, S, C))
    angle, phases = _turn(roots.lattice, frame, phase, clock, (t, time))
    first, _, last = axes.T
    axis = jax.tree.map(partial(jnp.where, frame.about_l ^ order.swap), last, first)
    return _attitudes(axis, axes @ pi0, pi, angle, phases)


def _momentum(pi: Vec3, alpha: Vec3, S: Array, C: Vec3) -> Vec3:
    """The momentum, but for a factor that its components share."""

    def component(k, i, j):
        return C[i] * C[j] * pi[k] + S * C[k] * (alpha[k] * pi[i] * pi[j])

    return Vec3(component(0, 1, 2), component(1, 2, 0), component(2, 0, 1))


def _turn(
    lattice: Lattice, frame: Frame, phase: Phase, clock: Clock, times: tuple[Array, Array]
) -> tuple[Array, tuple[Array, Array]]:
    """The angle by which the frame has turned, and a complex number whose phase adds to it.

    The phase is that of theta4(z + phi - i eta), circular, or of theta2(i (z + phi) - eta), which
    is written about half a period, where it is a third theta function.
    """
    hyperbolic, q, growth = lattice.hyperbolic, lattice.q, clock.growth
    u, v = phase.u, phase.v
    before = hyperbolic & (growth < u)  # z + phi is negative: one more period
    up, down = jnp.where(before, growth / u, growth * v), jnp.where(before, q * u, u) / growth
    c = clock.cosine * phase.c - clock.sine * phase.s
    s = clock.sine * phase.c + clock.cosine * phase.s

    def turned(z):
        """What is moved by a small angle from the start."""
        turn, growth = (jnp.cos(z), jnp.sin(z)), jnp.exp(z)
        c = turn[0] * phase.c - turn[1] * phase.s
        return c, turn[1] * phase.c + turn[0] * phase.s, v * growth, u / growth

    def theta(c, s, up, down):
        d = jnp.where(hyperbolic, up * up + down * down, 2 * (c * c - s * s))
        f = jnp.where(hyperbolic, (up * up - down * down) / 2, 2 * s * c)
        at_z = harmonics(d, f, jnp.where(hyperbolic, q, 1))
        return _third(at_z, frame.at_eta, q, jnp.where(hyperbolic, 1, -1))

    (x, y), (x0, y0) = theta(c, s, up, down), theta(phase.c, phase.s, v, u)
    # The rate is that of the start less that of the phase: for a thin body both are moderate, where
    # the usual sum of two rates cancels.
    _, (dx, dy) = jax.jvp(lambda z: theta(*turned(z)), (jnp.zeros_like(q),), (jnp.ones_like(q),))
    of_phase = lattice.kappa * (x0 * dy - y0 * dx) / (x0 * x0 + y0 * y0)
    sign = jnp.where(hyperbolic, 1, -1)
    way, periods = frame.sign * sign * phase.side, phase.side * clock.periods
    angle = frame.rate_at_start * times[0] - frame.sign * sign * of_phase * times[1]
    angle = angle + way * 2 * frame.eta * (periods - jnp.where(before, 1, 0))
    return angle, (x * x0 + y * y0, way * (y * x0 - x * y0))


def _third(at_x: Pairs, at_y: Pairs, q: Array, sign: Array) -> tuple[Array, Array]:
    """Real and imaginary part of theta3(x + iy) (`sign` 1) or theta4(x + iy) (-1)."""
    weights = 2 * sign, 2 * q**2, 2 * sign * q**6
    real, imaginary = jnp.ones_like(at_x[0][0]), jnp.zeros_like(at_x[0][0])
    for weight, (e, f), (E, F) in zip(weights, at_x, at_y, strict=True):
        real, imaginary = real + weight * e * E, imaginary + weight * f * F
    return real, imaginary


def _attitudes(
    axis: Vec3, pi0: Vec3, pi: Vec3, angle: Array, phases: tuple[Array, Array]
) -> tuple[Mat3, Vec3]:
    """Attitudes and momenta of length |pi0|, from momenta of any length."""
    x, y, z = _frame(axis, pi0)
    of_pi = pi / pi.norm()
    along, (real, imaginary) = axis.dot(of_pi), phases
    size = jnp.sqrt((1 - along * along) * (real * real + imaginary * imaginary))
    c, s = jnp.cos(angle), jnp.sin(angle)
    c, s = (c * real - s * imaginary) / size, (s * real + c * imaginary) / size
    first, second = axis - along * of_pi, of_pi.cross(axis)
    first, second = c * first - s * second, s * first + c * second
    # The columns x, y, z of the first frame times the rows of the turned one.
    columns = (a * x + (b * y + c * z) for a, b, c in Mat3(first, second, of_pi).T)
    return Mat3(*columns).T, pi0.norm() * of_pi


def _frame(axis: Vec3, pi: Vec3) -> Mat3:
    """The unit vectors along `axis` less its part along `pi`, across both, and along `pi`."""
    z = 1 / pi.norm() * pi
    along = axis.dot(z)
    x = 1 / jnp.sqrt(1 - along * along) * (axis - along * z)
    return Mat3(x, z.cross(x), z)
