"""The exact motion of a body of any inertia, and its derivative."""

from functools import partial

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from ..kernels import vectors as xyz
from ..kernels.vectors import Matrix, Vector, matmul
from .axes import in_axes, principal_axes
from .perturbation import turn_by_products
from .principal import principal_motion
from .slow import LIMIT, slow_motion


@jax.jit
def free_motion(R0: Array, pi0: Array, J: Array, times: Array) -> tuple[Array, Array]:
    """Attitudes (times, 3, 3) and momenta (times, 3) at `times` (times,)."""
    # In units of powers of two, so that nothing overflows and nothing is rounded.
    trace, size = map(_power_of_two, jax.lax.stop_gradient((jnp.trace(J), jnp.max(jnp.abs(pi0)))))
    J, pi0, t = (J + J.T) / (2 * trace), pi0 / size, times * (size / trace)

    inverse = xyz.join_matrix(xyz.inverse(xyz.split_matrix(J)))
    c, K, rate = _slow_part(J, inverse, pi0)
    slow = rate * jnp.abs(t) < LIMIT
    series = slow_motion(K, c, pi0, rate, jnp.where(slow, t, 0))
    # A body at rest is slow. Its momentum has no direction, so theta functions get another one.
    moving = jnp.where(jnp.all(pi0 == 0), jnp.array([1, 0, 0], J.dtype), pi0)
    theta = _by_theta_functions(J, moving, t)
    M, pi = jax.tree.map(partial(jnp.where, slow), series, theta)
    columns = (xyz.apply(xyz.split_matrix(R0), column) for column in xyz.transpose(M))
    x, y, z = columns
    return xyz.join_matrix(xyz.transpose((x, y, z))), size * xyz.join(pi)


def _power_of_two(x: Array) -> Array:
    """The least one that is larger than a positive number, else one."""
    _, exponent = jnp.frexp(jnp.where(jnp.isfinite(x) & (x > 0), x, 0.5))
    return jnp.ldexp(jnp.ones_like(x), exponent)


def _slow_part(J: Array, inverse: Array, pi0: Array) -> tuple[Array, Array, Array]:
    """The middle reciprocal moment c, J^-1 - cI, and a bound on the rate of the motion for it."""
    moments, axes = jax.lax.stop_gradient(principal_axes(J))
    beta, p = 1 / moments, matmul(axes.T, jax.lax.stop_gradient(pi0))
    K = inverse - beta[1] * jnp.eye(3, dtype=J.dtype)
    alpha = jnp.roll(beta, -2) - jnp.roll(beta, -1)
    x = jnp.roll(alpha, -1) * jnp.roll(alpha, -2) * p**2
    omega = jax.lax.stop_gradient(matmul(K, pi0))
    # Rounding of K splits equal moments, and with them equal x, by as much.
    eps, (largest, c, least) = jnp.finfo(J.dtype).eps, beta
    split = eps * largest * (largest - least + eps * c)
    squares = jnp.stack([jnp.max(x) - jnp.min(x), jnp.sum(omega**2), split])
    return c, K, jnp.sqrt(jnp.max(squares))


@jax.custom_jvp
def _by_theta_functions(J: Array, pi0: Array, t: Array) -> tuple[Matrix, Vector]:
    """Attitudes relative to the first, and momenta."""
    moments, axes = principal_axes(J)
    pi0 = matmul(axes.T, pi0)
    return principal_motion(xyz.split(moments), xyz.split_matrix(axes), xyz.split(pi0), t)


def _tangents(primals, tangents):
    """By the code for moments, momentum and times; in closed form for what turns the axes."""
    (J, pi0, t), (dJ, dpi0, dt) = primals, tangents
    fixed = isinstance(dJ, SymbolicZero)
    dJ, dpi0, dt = (
        jnp.zeros_like(x) if isinstance(dx, SymbolicZero) else dx
        for x, dx in zip(primals, tangents, strict=True)
    )
    moments, axes = principal_axes(J)
    basis, change, p = xyz.split_matrix(axes), in_axes(axes, dJ), matmul(axes.T, pi0)

    def of(moments, p, t):
        return principal_motion(xyz.split(moments), basis, xyz.split(p), t)

    along = jnp.diagonal(change), matmul(axes.T, dpi0), dt
    (R, pi), (dR, dpi) = jax.jvp(of, (moments, p, t), along)
    if fixed:
        return (R, pi), (dR, dpi)
    b = -change / (moments[:, None] * moments[None, :])
    now = xyz.apply(xyz.transpose(basis), pi)
    entries = b[1, 2], b[2, 0], b[0, 1]
    xi = turn_by_products(xyz.split(moments), xyz.split(p), now, t, entries)
    xi = xyz.apply(basis, xi)
    x, y, z = map(xyz.add, dR, xyz.cross_rows(R, xi))
    return (R, pi), ((x, y, z), xyz.add(dpi, xyz.cross(pi, xi)))


_by_theta_functions.defjvp(_tangents, symbolic_zeros=True)
