"""A whole trajectory as one differentiable operation."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import components as xyz
from . import equation, rotations
from .components import Matrix, Vector
from .reduction import solve_steps, with_empty_step


class Motion(NamedTuple):
    """A trajectory and how its steps were solved."""

    R: Array  # attitudes (steps+1, 3, 3)
    pi: Array  # body momenta at the start of each step's rotation, and the last (steps+1, 3)
    q: Array  # attitudes relative to the initial one, as quaternions wxyz (steps+1, 4)
    c: Array  # Rodrigues vectors of the steps, and zero (steps+1, 3)
    residual_norm: Array  # of the steps, and zero (steps+1,); its tangent is zero


@partial(jax.custom_jvp, nondiff_argnums=(5,))
def motion(
    R0: Array, pi0: Array, J: Array, h: Array, impulses: Array | None, newton_iters: int
) -> Motion:
    """Motion from the attitude `R0` and the momentum `pi0` by steps of sizes `h` (steps,).

    `J` is symmetric; `impulses` (steps, 3) are added to the body momentum after each step.
    """
    q, pi, c, residual_norm = solve_steps(newton_iters)(pi0, J, h, impulses)
    return Motion(rotations.turn_rows(R0[None], q), pi, q, c, residual_norm)


@motion.defjvp
def _motion_jvp(newton_iters, primals, tangents):
    r"""Tangent of all steps at once, but for a linear recurrence and a running sum.

    With $p = h\pi$, $\eta = \operatorname{vee}(F^T dF)$ of each step and $\zeta$ the sum of the
    turns $Q\eta$ of the steps before:

    $dc = A^{-1}[\tfrac12(I-\hat c+cc^T)\,dp - dJ\,c]$, $\eta = \frac{2}{1+c\cdot c}(I+\hat c)\,dc$,
    $d(F^T\pi) = F^T(d\pi + \pi\times\eta)$, $dR = (dR_0 + R_0\hat\zeta)\,Q$.
    """
    R0, _, J, h, _ = primals
    dR0, dpi0, dJ, dh, dimpulses = tangents
    out = motion(*primals, newton_iters)
    # The equation is the same for J and h divided by one number, which need not be differentiated.
    trace = jax.lax.stop_gradient(jnp.trace(J))
    J, dJ = (xyz.split_matrix(matrix[None] / trace) for matrix in (J, dJ))
    g, dg = (with_empty_step(size / trace) for size in (h, dh))
    c, pi, q = xyz.split(out.c), xyz.split(out.pi), rotations.split(out.q)
    inverse = xyz.inverse(equation.jacobian(J, xyz.scale(g, pi), c))

    def eta(right: Vector) -> Vector:
        dc = xyz.apply(inverse, right)
        return xyz.scale(2 / (1 + xyz.dot(c, c)), xyz.add(dc, xyz.cross(c, dc)))

    def from_momentum(dpi: Vector) -> Vector:
        return eta(xyz.scale(0.5 * g, equation.divided(c, dpi)))

    def recurrence(dpi: Vector, step: tuple[Matrix, Vector]):
        M, source = step
        return xyz.add(xyz.apply(M, dpi), source), dpi

    def running_sum(zeta: Vector, turn: Vector):
        return xyz.add(zeta, turn), zeta

    given = eta(xyz.subtract(xyz.scale(0.5 * dg, equation.divided(c, pi)), xyz.apply(dJ, c)))
    source = rotations.turn_back(c, xyz.cross(pi, given))
    if dimpulses is not None:
        source = xyz.add(source, xyz.split(with_empty_step(dimpulses)))
    # The matrix from one momentum to the next, by what it does to the axes.
    axes = xyz.split_matrix(jnp.eye(3, dtype=dpi0.dtype))
    x, y, z = (rotations.turn_back(c, xyz.add(e, xyz.cross(pi, from_momentum(e)))) for e in axes)
    _, dpi = jax.lax.scan(recurrence, xyz.split(dpi0), (xyz.transpose((x, y, z)), source))
    total = xyz.add(from_momentum(dpi), given)
    start = xyz.split(jnp.zeros_like(dpi0))
    _, zeta = jax.lax.scan(running_sum, start, rotations.turn(q, total))
    turning = xyz.join_matrix(xyz.cross_rows(xyz.split_matrix(R0), zeta))
    # The last two serve derivatives of this rule.
    dq, dc = rotations.rate(q, zeta), xyz.scale(0.5, equation.divided(c, total))
    return out, Motion(
        rotations.turn_rows(dR0[None] + turning, out.q),
        xyz.join(dpi),
        dq,
        xyz.join(dc),
        jnp.zeros_like(out.residual_norm),
    )
