"""The principal axes in the order that the exact motion needs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.primitives import linear
from ..kernels.vectors import Vector, matmul


class Axes(NamedTuple):
    """Principal axes h, m, l: right-handed, m that of the middle moment.

    With the differences `gaps` of the reciprocal moments `beta`, a_h = |beta_l - beta_m| and so
    on, h is the axis of the outer two with the larger a_l pi_h^2.
    """

    swap: Array  # h, m, l are the axes 2, -1, 0 of ascending moments, rather than 0, 1, 2
    beta: Vector
    gaps: Vector
    pi: Vector

    @property
    def sign(self) -> Array:
        """The sign of beta_h - beta_m."""
        return jnp.where(self.swap, -1.0, 1.0)

    def restored(self, v: Vector) -> Vector:
        """A vector in the axes 0, 1, 2, from its components in h, m, l."""
        return swapped(self.swap, v)


def arranged(moments: Vector, pi: Vector) -> Axes:
    """The axes h, m, l, from ascending moments and a momentum of about unit size."""
    eps, (m0, m1, m2) = float(jnp.finfo(pi[0].dtype).eps), moments
    # Nothing is zero, so nothing is divided by zero; the values change by less than rounding.
    least = eps**1.3 / jax.lax.stop_gradient(m0)
    a01 = away_from_zero((m1 - m0) / (m0 * m1), least)
    a12 = away_from_zero((m2 - m1) / (m1 * m2), least)
    x, y, z = (away_from_zero(component, eps**1.2) for component in pi)
    swap = a01 * x**2 < a12 * z**2
    h, l = jnp.where(swap, a01, a12), jnp.where(swap, a12, a01)  # noqa: E741
    outer = jnp.where(swap, 1 / m2, 1 / m0), jnp.where(swap, 1 / m0, 1 / m2)
    beta = outer[0], 1 / m1, outer[1]
    return Axes(swap, beta, (h, h + l, l), swapped(swap, (x, y, z)))


def swapped(swap: Array, v: Vector) -> Vector:
    """Components along the axes 2, -1, 0 if `swap`, else the same."""
    x, y, z = v
    return jnp.where(swap, z, x), jnp.where(swap, -y, y), jnp.where(swap, x, z)


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
    (turn,) = _times([factor], [change])
    return (moments, axes), (jnp.diagonal(change), matmul(axes, turn))


def _product_unless_zero(at, given):
    return [jnp.where(given[0] == 0, 0, at[0] * given[0])]


_times = linear(_product_unless_zero, _product_unless_zero, results=1)


def in_axes(axes: Array, tensor: Array) -> Array:
    """The components of a tensor (3, 3) in given axes, the columns of a rotation."""
    return matmul(matmul(axes.T, tensor), axes)
