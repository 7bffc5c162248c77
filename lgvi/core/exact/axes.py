"""The principal axes in the order that the exact motion needs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.finite import times_unless_zero
from ..kernels.vectors import Vec3, matmul


class Axes(NamedTuple):
    """Principal axes h, m, l: right-handed, m that of the middle moment.

    Of the outer two axes h is that of the larger a_l pi_h^2. With the reciprocal moments `beta`,
    a_l = |beta_m - beta_h| and a_h = |beta_l - beta_m| are over their sum.
    """

    swap: Array  # h, m, l are the axes z, -y, x of ascending moments, rather than x, y, z
    beta: Vec3
    scale: Array  # the sum of the two differences, |beta_h - beta_l|
    a_h: Array
    a_l: Array
    pi: Vec3

    @property
    def sign(self) -> Array:
        """The sign of beta_h - beta_m."""
        return jnp.where(self.swap, -1.0, 1.0)

    @property
    def alpha(self) -> Vec3:
        """The coefficients of Euler's equations, over `scale`."""
        return Vec3(-self.sign * self.a_h, self.sign, -self.sign * self.a_l)

    def restored(self, v: Vec3) -> Vec3:
        """Components in the axes x, y, z, from those in h, m, l: the swap undoes itself."""
        return swapped(self.swap, v)


def arranged(moments: Vec3, pi: Vec3) -> Axes:
    """The axes h, m, l, from those of ascending moments and a momentum of about unit size."""
    limits, (m0, m1, m2) = jnp.finfo(pi.x.dtype), moments
    # Nothing is zero, so nothing is divided by zero. A spin about the unstable axis begins to flip
    # by that, as by rounding, but late.
    least = float(limits.tiny) ** 0.35 / jax.lax.stop_gradient(m2)
    a01 = away_from_zero((m1 - m0) / (m0 * m1), least)
    a12 = away_from_zero((m2 - m1) / (m1 * m2), least)
    x, y, z = (away_from_zero(component, float(limits.tiny) ** 0.2) for component in pi)
    swap = a01 * x**2 < a12 * z**2
    h, l = jnp.where(swap, a01, a12), jnp.where(swap, a12, a01)  # noqa: E741
    beta_h, beta_l = jnp.where(swap, 1 / m2, 1 / m0), jnp.where(swap, 1 / m0, 1 / m2)
    beta, pi = Vec3(beta_h, 1 / m1, beta_l), swapped(swap, Vec3(x, y, z))
    return Axes(swap, beta, h + l, h / (h + l), l / (h + l), pi)


def swapped(swap: Array, v: Vec3) -> Vec3:
    """Components along the axes z, -y, x if `swap`, else the same."""
    x, y, z = v
    return Vec3(jnp.where(swap, z, x), jnp.where(swap, -y, y), jnp.where(swap, x, z))


def away_from_zero(x: Array, least: Array | float) -> Array:
    """The same, or plus or minus `least` for |x| < `least`; the derivative is always one."""
    small = jnp.where(jnp.abs(x) < least, jnp.where(x < 0, -least, least) - x, 0)
    return x + jax.lax.stop_gradient(small)


@jax.custom_jvp
def principal_axes(J: Array) -> tuple[Array, Array]:
    """Ascending moments (3,), and the axes (3, 3) as columns of a rotation.

    Axes of two equal moments are not unique: the derivative of what turns one of the two into the
    other is NaN, but zero where all three moments are equal, as then nothing depends on the axes.
    """
    moments, axes = jnp.linalg.eigh(J)
    sign = jnp.where(jnp.linalg.det(axes) < 0, -1, 1).astype(J.dtype)
    return moments, axes * sign


@principal_axes.defjvp
def _(primals, tangents):
    (J,), (dJ,) = primals, tangents
    moments, axes = principal_axes(J)
    change = in_axes(axes, dJ)
    gap = moments[None, :] - moments[:, None]
    equal = (gap == 0) & ~jnp.eye(3, dtype=bool) & (moments[0] != moments[2])
    factor = jnp.where(equal, jnp.nan, 1 / jnp.where(gap == 0, jnp.inf, gap))
    (turn,) = times_unless_zero([factor], [change])
    return (moments, axes), (jnp.diagonal(change), matmul(axes, turn))


@jax.custom_jvp
def inverse(J: Array) -> Array:
    """By the principal axes: for a thin body in other axes, cofactors would cancel."""
    moments, axes = principal_axes(J)
    return matmul(axes / moments[None], axes.T)


@inverse.defjvp
def _(primals, tangents):
    (J,), (dJ,) = primals, tangents
    result = inverse(J)
    return result, -matmul(matmul(result, dJ), result)


def in_axes(axes: Array, tensor: Array) -> Array:
    """The components of a tensor (3, 3) in given axes, the columns of a rotation."""
    return matmul(matmul(axes.T, tensor), axes)
