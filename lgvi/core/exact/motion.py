"""The exact motion of a body of any inertia, and its derivative."""

from functools import partial

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from ..kernels.vectors import Mat3, Vec3, matmul
from .axes import in_axes, inverse, principal_axes
from .perturbation import turn_by_products
from .principal import principal_motion
from .slow import LIMIT, slow_motion


@jax.jit
def free_motion(R0: Array, pi0: Array, J: Array, times: Array) -> tuple[Array, Array]:
    """Attitudes (times, 3, 3) and momenta (times, 3) at `times` (times,)."""
    # In units of powers of two, so that nothing overflows and nothing is rounded.
    trace, size = map(_power_of_two, jax.lax.stop_gradient((jnp.trace(J), jnp.max(jnp.abs(pi0)))))
    J, pi0, t = (J + J.T) / (2 * trace), pi0 / size, times * (size / trace)

    series, slow = _by_series(J, pi0, t)
    # The momentum of a body at rest has no direction, so theta functions get another one.
    moving = jnp.where(jnp.all(pi0 == 0), jnp.array([1, 0, 0], J.dtype), pi0)
    theta = _by_theta_functions(J, moving, t)
    M, pi = jax.tree.map(partial(jnp.where, slow), series, theta)
    columns = (Mat3.of(R0) @ column for column in M.T)
    return Mat3(*columns).T.array(), size * pi.array()


def _power_of_two(x: Array) -> Array:
    """The least one that is larger than a positive number, else one."""
    _, exponent = jnp.frexp(jnp.where(jnp.isfinite(x) & (x > 0), x, 0.5))
    return jnp.ldexp(jnp.ones_like(x), exponent)


def _by_series(J: Array, pi0: Array, t: Array) -> tuple[tuple[Mat3, Vec3], Array]:
    """Attitudes relative to the first and momenta, and for which times they are good."""
    moments, axes = jax.lax.stop_gradient(principal_axes(J))
    p = matmul(axes.T, pi0)
    # J^-1 - cI with c of the middle moment, in the principal axes: exact where differences of
    # moments are small, for thin bodies too. The axes stay where they are while J changes, so the
    # derivative has all entries.
    (m0, m1, m2), c = moments, 1 / moments[1]
    differences = jnp.stack([(m1 - m0) / (m0 * m1), jnp.zeros_like(c), (m1 - m2) / (m1 * m2)])
    K = in_axes(axes, inverse(J))
    K = jnp.diag(differences) + (K - jax.lax.stop_gradient(K))

    squares = jax.lax.stop_gradient(p) ** 2
    alpha = jnp.roll(differences, -2) - jnp.roll(differences, -1)
    x = jnp.roll(alpha, -1) * jnp.roll(alpha, -2) * squares
    # Rounding of J splits equal moments, and with them equal x.
    eps = jnp.finfo(J.dtype).eps
    split = eps / m0 * (differences[0] - differences[2] + eps * c)
    bounds = jnp.max(x) - jnp.min(x), jnp.sum(differences**2 * squares), split
    rate = jnp.sqrt(jnp.max(jnp.stack(bounds)))
    # At rest the coefficients are zero; in their derivatives all but the first, which is exact.
    slow = (rate * jnp.abs(t) < LIMIT) | jnp.all(p == 0)
    times = jnp.where(slow, t, 0)
    return slow_motion(K, c, p, Mat3.of(axes), rate, times), slow


@jax.custom_jvp
def _by_theta_functions(J: Array, pi0: Array, t: Array) -> tuple[Mat3, Vec3]:
    """Attitudes relative to the first, and momenta."""
    moments, axes = principal_axes(J)
    pi0 = matmul(axes.T, pi0)
    return principal_motion(Vec3.of(moments), Mat3.of(axes), Vec3.of(pi0), t)


def _tangents(primals, tangents):
    """By the code for moments, momentum and times; in closed form for what turns the axes."""
    (J, pi0, t), (dJ, dpi0, dt) = primals, tangents
    fixed = isinstance(dJ, SymbolicZero)
    dJ, dpi0, dt = (
        jnp.zeros_like(x) if isinstance(dx, SymbolicZero) else dx
        for x, dx in zip(primals, tangents, strict=True)
    )
    moments, axes = principal_axes(J)
    basis, change, p = Mat3.of(axes), in_axes(axes, dJ), matmul(axes.T, pi0)

    def of(moments, p, t):
        return principal_motion(Vec3.of(moments), basis, Vec3.of(p), t)

    along = jnp.diagonal(change), matmul(axes.T, dpi0), dt
    (R, pi), (dR, dpi) = jax.jvp(of, (moments, p, t), along)
    if fixed:
        return (R, pi), (dR, dpi)
    b = -change / (moments[:, None] * moments[None, :])
    entries = Vec3(b[1, 2], b[2, 0], b[0, 1])
    xi = basis @ turn_by_products(Vec3.of(moments), Vec3.of(p), basis.T @ pi, t, entries)
    return (R, pi), (dR + R.cross(xi), dpi + pi.cross(xi))


_by_theta_functions.defjvp(_tangents, symbolic_zeros=True)
