"""One step of a free rigid body: Newton solver and implicit derivative."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from ..kernels.finite import multiply, with_finite_coefficients
from ..kernels.vectors import Mat3, Vec3
from ..so3 import cayley
from ..typed_arrays import as_count, as_floats, as_tolerance
from .equation import is_on_branch_of_identity, residual_norm, rounding
from .newton import rodrigues_vector


class SolverInfo(NamedTuple):
    r"""Report of the Newton solver. A failed solve does not raise: check `converged`.

    Attributes
    ----------
    residual_norm
        Euclidean norm of the discrete Moser-Veselov residual
        $\operatorname{vee}(F J_d - J_d F^T) - h\pi$ after the final Newton iteration (with
        rotors, of the equation with rotors), kg m². Its derivative is defined as zero.
    converged
        Whether the norm is at most the tolerance; False for a norm that is not finite, and for a
        root of the equation that does not follow from the identity as the step grows. For free
        motion of an order above 2, also False if the step turns by a right angle or more.
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
    *,
    rotor_momentum: Float[ArrayLike, "3"] | None = None,
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
        Newton budget, at least 1, static under `jax.jit`. Up to three iterations without
        damping are tried first, and kept if they reach rounding. Else damped iterations start
        from no rotation, two more than the budget: each tries the full Newton step, its half, its
        quarter and none, and keeps the candidate of least residual. An iteration that keeps the
        iterate would be repeated by all later iterations, so the loop stops there with the
        result of the whole budget.
    tolerance
        Bound on the residual norm for `converged`, kg m². `None` is the scale-aware bound
        $8\,\epsilon \operatorname{tr}(J)\,2|c|$ with the machine epsilon $\epsilon$ of
        the precision in use (rotors add $8\,\epsilon\,h|\rho|$).
    rotor_momentum
        Momentum $\rho$ (3,) of spinning rotors relative to the body, body frame, kg m²/s. Then
        $\pi = J\omega + \rho$, with `J` the inertia of the body with the rotors locked, and the
        equation is $F J_d - J_d F^T + \tfrac h2(F\hat\rho + \hat\rho F^T) = h\,\hat\pi$.

    Returns
    -------
    F : Array
        Relative rotation (3, 3): $R_{k+1} = R_k F$, $\pi_{k+1} = F^T\pi_k$.
    info : SolverInfo
        Residual norm and whether it is within the tolerance.

    Raises
    ------
    ValueError, TypeError
        While tracing, for a wrong shape, type, Newton budget or tolerance. Other
        values never raise.

    Notes
    -----
    No solution exists for large rotation per step. A spin about a principal axis can be
    solved up to $h|\omega| = 1$; for physical inertias the measured limit on
    $|h J^{-1}\pi|$ lies between 1.00 and 1.27, for other matrices the limit can be lower.
    Beyond the limit `converged` is False.

    The default tolerance is absolute and out of reach in float32 for ordinary bodies; use
    `None` there.

    Derivatives with respect to `pi`, `J`, `h` and `rotor_momentum`, forward, reverse and of
    any order, come from the implicit function theorem at the root; no iteration is
    differentiated. The derivative with respect to `J` is symmetric. A step that did not
    converge has no meaningful derivative.

    References
    ----------
    J. Moser, A. P. Veselov, Commun. Math. Phys. 139 (1991), doi:10.1007/BF02352494.
    R. I. McLachlan, A. Zanna, "The discrete Moser-Veselov algorithm for the free rigid
    body, revisited", Found. Comput. Math. 5 (2005), doi:10.1007/s10208-004-0118-6.
    """
    newton_iters = as_count("newton_iters", newton_iters, 1)
    rotor = {} if rotor_momentum is None else {"rotor_momentum": (rotor_momentum, (3,))}
    pi, J, h, *rotor = as_floats(pi=(pi, (3,)), J=(J, (3, 3)), h=(h, ()), **rotor)
    # c does not change when J and p are divided by the same number. Dividing by the trace
    # keeps the determinant in the closed-form solve away from overflow, in float32 too.
    scale = jax.lax.stop_gradient(jnp.trace(J))
    scale = jnp.where(jnp.isfinite(scale) & (scale != 0), scale, 1)
    J, p = (J + J.T) / (2 * scale), multiply(h / scale, pi)
    r = multiply(h / scale, rotor[0]) if rotor else None
    c = rodrigues_vector(J, p, newton_iters, r)
    c_, J_, p_ = jax.lax.stop_gradient((Vec3.of(c), Mat3.of(J), Vec3.of(p)))
    r_ = None if r is None else jax.lax.stop_gradient(Vec3.of(r))
    size = jnp.abs(scale)
    residual = size * residual_norm(2 * J_, p_, c_, r_)
    info = solver_info(residual, size * rounding(c_, r_), tolerance)
    usable = is_on_branch_of_identity(J_, c_, r_)
    return _rotation(c), info._replace(converged=info.converged & usable)


_rotation = with_finite_coefficients(cayley)


def solver_info(residual_norm: Array, rounding: Array, tolerance: ArrayLike | None) -> SolverInfo:
    """Compare residual norms with the tolerance, or with `rounding` if it is None."""
    bound = as_tolerance(tolerance)
    bound = rounding if bound is None else bound.astype(residual_norm.dtype)
    return SolverInfo(residual_norm, residual_norm <= bound)
