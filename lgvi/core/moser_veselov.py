r"""One step of a free rigid body: the discrete Moser-Veselov equation and its derivative.

The relative rotation $F$ of a step solves $F J_d - J_d F^T = h\,\hat\pi$. Written with the
Rodrigues vector $c$ of $F$ (`F = cayley(c)`) and $p = h\pi$, and divided by a factor that
does not vanish, it is the quadratic

$$r(c) = J c - \tfrac12\bigl(p - c\times p + c\,(c\cdot p)\bigr) = 0,\qquad
  A(c) = \frac{\partial r}{\partial c} = J - \tfrac12\bigl(\hat p + (c\cdot p)\,I + c\,p^T\bigr).$$

Exponential coordinates give the same root: $F = \operatorname{Exp}(g)$ with
$g = 2\arctan|c|\;c/|c|$ solves
$\frac{\sin|g|}{|g|} J g + \frac{1-\cos|g|}{|g|^2}\, g\times J g = p$. The quadratic needs no
trigonometry, no square root and no branch for small angles.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from .checks import as_count, as_floats
from .so3 import cayley

# Factors tried on each Newton step, beside 0, which keeps the iterate.
DAMPING_FACTORS = (1.0, 0.5, 0.25)

# Multiple of the rounding unit at which the scale-aware test calls a step converged.
ROUNDING_MARGIN = 8.0


class SolverInfo(NamedTuple):
    r"""What the Newton solver reports; a failed solve is never silent and never raises.

    Attributes
    ----------
    residual_norm
        Euclidean norm of the discrete Moser-Veselov residual
        $\operatorname{vee}(F J_d - J_d F^T) - h\pi$ after the final Newton iteration,
        kg m². Its derivative is defined as zero.
    converged
        Whether that norm is no greater than the tolerance; False when it is not finite.
    """

    residual_norm: Float[Array, "*steps"]
    converged: Bool[Array, "*steps"]


def solve_F(
    pi: Float[ArrayLike, "3"],
    J: Float[ArrayLike, "3 3"],
    h: Float[ArrayLike, ""],
    newton_iters: int = 8,
) -> Float[Array, "3 3"]:
    """Relative rotation of one free step; see [`solve_F_with_info`][lgvi.solve_F_with_info].

    A failed solve is not visible here: use `solve_F_with_info` to check.

    Parameters
    ----------
    pi
        Body angular momentum (3,), kg m²/s.
    J
        Inertia (3, 3), body frame, kg m².
    h
        Time step, s.
    newton_iters
        Newton budget, static under `jax.jit`.

    Returns
    -------
    Array
        F (3, 3) in SO(3).
    """
    return solve_F_with_info(pi, J, h, newton_iters)[0]


def solve_F_with_info(
    pi: Float[ArrayLike, "3"],
    J: Float[ArrayLike, "3 3"],
    h: Float[ArrayLike, ""],
    newton_iters: int = 8,
    tolerance: Float[ArrayLike, ""] | None = 1e-10,
) -> tuple[Float[Array, "3 3"], SolverInfo]:
    r"""Solve the discrete Moser-Veselov equation $F J_d - J_d F^T = h\,\hat\pi$ for F in SO(3).

    Parameters
    ----------
    pi
        Body angular momentum $\pi$ (3,), kg m²/s.
    J
        Inertia (3, 3), body frame, kg m²: symmetric positive definite, diagonal or not.
        Only its symmetric part enters.
    h
        Time step, s; negative steps backwards.
    newton_iters
        Newton budget, at least 1, static under `jax.jit`. Each iteration tries the full
        Newton step, its half, its quarter and none, and keeps the candidate of least
        residual. An iteration that keeps the iterate would be repeated by all later ones,
        so the loop stops there with the result of the whole budget.
    tolerance
        Bound on the residual norm for `converged`, kg m². `None` is the scale-aware bound
        $8\,\epsilon \operatorname{tr}(J)\,2|c|$ with the rounding unit $\epsilon$ of the
        precision in use.

    Returns
    -------
    F : Array
        Relative rotation (3, 3): $R_{k+1} = R_k F$, $\pi_{k+1} = F^T\pi_k$.
    info : SolverInfo
        Residual norm and whether it is within the tolerance.

    Raises
    ------
    ValueError, TypeError
        While tracing, for a wrong shape, type or Newton budget. Values never raise.

    Notes
    -----
    No solution exists for large rotation per step. A spin about a principal axis can be
    solved up to $h|\omega| = 1$; for physical inertias the measured limit on
    $|h J^{-1}\pi|$ lies between 1.00 and 1.27, for others it can be less. Past it
    `converged` is False.

    The default tolerance is absolute and out of reach in float32 for ordinary bodies; use
    `None` there.

    Derivatives with respect to `pi`, `J` and `h`, forward, reverse and of any order, come
    from the implicit function theorem at the root; no iteration is differentiated. The
    derivative with respect to `J` is symmetric. A step that did not converge has no
    meaningful derivative.

    References
    ----------
    J. Moser, A. P. Veselov, Commun. Math. Phys. 139 (1991), doi:10.1007/BF02352494.
    R. I. McLachlan, A. Zanna, "The discrete Moser-Veselov algorithm for the free rigid
    body, revisited", Found. Comput. Math. 5 (2005), doi:10.1007/s10208-004-0118-6.
    """
    newton_iters = as_count("newton_iters", newton_iters, 1)
    pi, J, h = as_floats(pi=(pi, (3,)), J=(J, (3, 3)), h=(h, ()))
    # c does not change when J and p are divided by the same number. Dividing by the trace
    # keeps the determinant in the closed-form solve away from overflow, in float32 too.
    scale = jax.lax.stop_gradient(jnp.trace(J))
    J, p = (J + J.T) / (2 * scale), h * pi / scale
    c = _rodrigues_vector(J, p, newton_iters)
    return cayley(c), _info(*jax.lax.stop_gradient((c, J, p, scale)), tolerance)


def _info(c: Array, J: Array, p: Array, scale: Array, tolerance: ArrayLike | None) -> SolverInfo:
    if tolerance is None:
        epsilon = jnp.finfo(c.dtype).eps
        bound = ROUNDING_MARGIN * epsilon * jnp.abs(scale) * 2 * jnp.sqrt(c @ c)
    else:
        (bound,) = as_floats(tolerance=(tolerance, ()))
    residual_norm = jnp.abs(scale) * jnp.sqrt(_squared_residual(c, J, p))
    return SolverInfo(residual_norm, residual_norm <= bound.astype(c.dtype))


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _rodrigues_vector(J: Array, p: Array, newton_iters: int) -> Array:
    """Root c of the divided equation by damped Newton from the third-order guess."""

    def improve(state):
        i, c, best, _ = state
        step = -_solve(_jacobian(c, J, p), _divided_residual(c, J, p))
        improved = False
        start = c
        for factor in DAMPING_FACTORS:
            candidate = start + factor * step
            value = _squared_residual(candidate, J, p)
            better = value < best  # False for NaN
            c = jnp.where(better, candidate, c)
            best = jnp.where(better, value, best)
            improved = improved | better
        return i + 1, c, best, improved

    c = _third_order_guess(J, p)
    state = (0, c, _squared_residual(c, J, p), True)
    return jax.lax.while_loop(lambda s: (s[0] < newton_iters) & s[3], improve, state)[1]


@_rodrigues_vector.defjvp
def _rodrigues_vector_jvp(newton_iters, primals, tangents):
    J, p = primals
    dJ, dp = tangents
    c = _rodrigues_vector(J, p, newton_iters)
    dr = dJ @ c - (dp - jnp.cross(c, dp) + c * (c @ dp)) / 2
    return c, -_solve(_jacobian(c, J, p), dr)


def _third_order_guess(J: Array, p: Array) -> Array:
    """Terms of order h, h^2 and h^3 of c."""
    inverse_half = partial(_solve, 2 * J)
    c1 = inverse_half(p)
    c2 = inverse_half(-jnp.cross(c1, p))
    c3 = inverse_half(-jnp.cross(c2, p) + c1 * (c1 @ p))
    return c1 + c2 + c3


def _divided_residual(c: Array, J: Array, p: Array) -> Array:
    return J @ c - (p - jnp.cross(c, p) + c * (c @ p)) / 2


def _squared_residual(c: Array, J: Array, p: Array) -> Array:
    """Square of vee(F Jd - Jd F^T) - p, which is 2 (Jc + c x Jc)/(1 + c.c) - p."""
    Jc = J @ c
    residual = 2 * (Jc + jnp.cross(c, Jc)) / (1 + c @ c) - p
    return residual @ residual


def _jacobian(c: Array, J: Array, p: Array) -> Array:
    """Columns e_j of J - (hat(p) + (c.p) I + c p^T)/2, stacked as rows."""
    identity = jnp.eye(3, dtype=c.dtype)
    p_cross_e = jnp.cross(p[None, :], identity)
    return J - (p_cross_e + (c @ p) * identity + jnp.outer(p, c)) / 2


def _solve(columns: Array, b: Array) -> Array:
    """Solve a 3x3 system, given by its columns, with cross products (Cramer's rule)."""
    x, y, z = columns
    yz, zx, xy = jnp.cross(y, z), jnp.cross(z, x), jnp.cross(x, y)
    return jnp.stack([yz @ b, zx @ b, xy @ b]) / (x @ yz)
