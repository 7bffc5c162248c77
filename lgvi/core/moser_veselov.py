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

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from . import components as xyz
from .checks import as_count, as_floats
from .components import Matrix, Vector
from .so3 import cayley

# Factors tried on each Newton step, beside 0, which keeps the iterate.
DAMPING_FACTORS = (1.0, 0.5, 0.25)

# Multiple of the rounding unit at which the scale-aware test calls a step converged.
ROUNDING_MARGIN = 8.0


class SolverInfo(NamedTuple):
    r"""What the Newton solver reports. A failed solve does not raise: look here.

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
        $8\,\epsilon \operatorname{tr}(J)\,2|c|$ with the machine epsilon $\epsilon$ of
        the precision in use.

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
    c = rodrigues_vector(J, p, newton_iters)
    c_, J_, p_ = jax.lax.stop_gradient((c, J, p))
    residual = residual_norm(xyz.split_matrix(J_), xyz.split(p_), xyz.split(c_))
    return cayley(c), solver_info(jnp.abs(scale) * residual, scale, c_, tolerance)


def solver_info(
    residual_norm: Array, scale: Array, c: Array, tolerance: ArrayLike | None
) -> SolverInfo:
    """Compare residual norms (...) of steps c (..., 3) with the tolerance."""
    if tolerance is None:
        bound = jnp.abs(scale) * rounding(c)
    else:
        (bound,) = as_floats(tolerance=(tolerance, ()))
    return SolverInfo(residual_norm, residual_norm <= bound.astype(c.dtype))


def rounding(c: Array) -> Array:
    """Residual norm, for an inertia of unit trace, that rounding alone can leave."""
    return ROUNDING_MARGIN * jnp.finfo(c.dtype).eps * 2 * jnp.sqrt(jnp.sum(c * c, axis=-1))


# Compiled here, so that calls outside of `jax.jit` compile once.
@partial(jax.jit, static_argnames="newton_iters", inline=True)
def rodrigues_vector(J: Array, p: Array, newton_iters: int) -> Array:
    """Root c (3,) of the divided equation by damped Newton, for an inertia of about unit trace."""
    return _rodrigues_vector(J, p, newton_iters)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _rodrigues_vector(J: Array, p: Array, newton_iters: int) -> Array:
    J_, p_ = xyz.split_matrix(J), xyz.split(p)

    def improve(state):
        i, c, best, _ = state
        start = xyz.split(c)
        # Materialised: components that XLA computes apart, each from its own rounding of the
        # residual, would not be the solution for any one residual, and thin bodies would stall.
        right = materialise(negative_residual(J_, p_, start))
        step = materialise(xyz.solve(jacobian(J_, p_, start), right))
        improved = False
        for factor in DAMPING_FACTORS:
            candidate = xyz.add(start, xyz.scale(factor, step))
            value = residual_norm(J_, p_, candidate)
            better = value < best  # False for NaN
            c = jnp.where(better, xyz.join(candidate), c)
            best = jnp.where(better, value, best)
            improved = improved | better
        return i + 1, c, best, improved

    def divide(v):
        # Refined twice: in float32 the determinant of a thin rod has no correct digit to spare.
        v = materialise(v)
        x = materialise(xyz.solve(J_, v))
        for _ in range(2):
            x = materialise(xyz.add(x, xyz.solve(J_, xyz.subtract(v, xyz.apply(J_, x)))))
        return x

    c = third_order_guess(divide, p_)
    state = (0, xyz.join(c), residual_norm(J_, p_, c), True)
    return jax.lax.while_loop(lambda s: (s[0] < newton_iters) & s[3], improve, state)[1]


@_rodrigues_vector.defjvp
def _rodrigues_vector_jvp(newton_iters, primals, tangents):
    J, p = primals
    dJ, dp = xyz.split_matrix(tangents[0]), xyz.split(tangents[1])
    c = _rodrigues_vector(J, p, newton_iters)
    c_ = xyz.split(c)
    A = jacobian(xyz.split_matrix(J), xyz.split(p), c_)
    right = xyz.subtract(xyz.scale(0.5, divided(c_, dp)), xyz.apply(dJ, c_))
    return c, xyz.join(xyz.solve(A, right))


def divided(c: Vector, p: Vector) -> Vector:
    """p - c x p + c (c.p): multiplication by (1 + c.c) times the inverse of I + hat(c)."""
    return xyz.add(xyz.add(p, xyz.cross(p, c)), xyz.scale(xyz.dot(c, p), c))


def third_order_guess(divide: Callable[[Vector], Vector], p: Vector) -> Vector:
    """Terms of order h, h^2 and h^3 of c; `divide` multiplies by the inverse of the inertia."""
    c1 = xyz.scale(0.5, divide(p))
    c2 = xyz.scale(0.5, divide(xyz.cross(p, c1)))
    right = xyz.add(xyz.cross(p, c2), xyz.scale(xyz.dot(c1, p), c1))
    return xyz.add(xyz.add(c1, c2), xyz.scale(0.5, divide(right)))


def negative_residual(J: Matrix, p: Vector, c: Vector) -> Vector:
    """Minus the divided residual r(c)."""
    return xyz.subtract(xyz.scale(0.5, divided(c, p)), xyz.apply(J, c))


def materialise(v: Vector) -> Vector:
    """The same vector, computed once and in one place."""
    return xyz.split(jax.lax.optimization_barrier(xyz.join(v)))


def jacobian(J: Matrix, p: Vector, c: Vector) -> Matrix:
    """Derivative J - (hat(p) + (c.p) I + c p^T)/2 of the divided residual."""
    (j00, j01, j02), (j10, j11, j12), (j20, j21, j22) = J
    (p0, p1, p2), (x, y, z), k = p, c, xyz.dot(c, p)
    return (
        (j00 - (k + x * p0) / 2, j01 + (p2 - x * p1) / 2, j02 - (p1 + x * p2) / 2),
        (j10 - (p2 + y * p0) / 2, j11 - (k + y * p1) / 2, j12 + (p0 - y * p2) / 2),
        (j20 + (p1 - z * p0) / 2, j21 - (p0 + z * p1) / 2, j22 - (k + z * p2) / 2),
    )


def residual_norm(J: Matrix, p: Vector, c: Vector) -> Array:
    """Norm of vee(F Jd - Jd F^T) - p, which is 2 (Jc + c x Jc)/(1 + c.c) - p."""
    Jc = xyz.apply(J, c)
    left = xyz.scale(2 / (1 + xyz.dot(c, c)), xyz.add(Jc, xyz.cross(c, Jc)))
    residual = xyz.subtract(left, p)
    return jnp.sqrt(xyz.dot(residual, residual))
