r"""The discrete Moser-Veselov equation by component, for one step or many at once.

The relative rotation $F$ of a step solves $F J_d - J_d F^T = h\,\hat\pi$. Written with the
Rodrigues vector $c$ of $F$ (`F = cayley(c)`) and $p = h\pi$, and divided by a factor that
does not vanish, it is the quadratic

$$r(c) = J c - \tfrac12\bigl(p - c\times p + c\,(c\cdot p)\bigr) = 0,\qquad
  A(c) = \frac{\partial r}{\partial c} = J - \tfrac12\bigl(\hat p + (c\cdot p)\,I + c\,p^T\bigr).$$

Exponential coordinates give the same root: $F = \operatorname{Exp}(g)$ with
$g = 2\arctan|c|\;c/|c|$ solves
$\frac{\sin|g|}{|g|} J g + \frac{1-\cos|g|}{|g|^2}\, g\times J g = p$. The quadratic needs no
trigonometry, no square root and no branch for small angles.

For a body with rotors of relative momentum $\rho$, and $r = h\rho$, the equation
$F J_d - J_d F^T + \tfrac12(F\hat r + \hat r F^T) = h\,\hat\pi$ becomes the same quadratic with
$p - r$ for the first $p$ and $p + r$ for the last:

$$r(c) = J c - \tfrac12\bigl((p - r) - c\times p + c\,(c\cdot(p + r))\bigr) = 0.$$

Where an argument `r` of a function is None, the equation is the one without rotors.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels import vectors as xyz
from ..kernels.vectors import Matrix, Vector

# Multiple of the rounding unit at which a residual still counts as rounding.
ROUNDING_MARGIN = 8.0


def materialise(v: Vector) -> Vector:
    """The same vector, computed once and in one place."""
    return xyz.split(jax.lax.optimization_barrier(xyz.join(v, axis=0)), axis=0)


class Momentum(NamedTuple):
    """p, p - r and p + r; without rotors all three are p."""

    p: Vector
    first: Vector
    last: Vector


def with_rotors(p: Vector, r: Vector | None = None) -> Momentum:
    """The vectors of the equation, from p = h pi and r = h rho."""
    if r is None:
        return Momentum(p, p, p)
    # Otherwise XLA would compute each of the six numbers separately.
    six = jax.lax.optimization_barrier(jnp.stack([*xyz.subtract(p, r), *xyz.add(p, r)]))
    first, last = xyz.split(six[:3], axis=0), xyz.split(six[3:], axis=0)
    # Not `p` itself: a loop that reads three more numbers is too large to be compiled as one.
    return Momentum(xyz.scale(0.5, xyz.add(first, last)), first, last)


def right_hand_side(c: Vector, momentum: Momentum) -> Vector:
    """p - r - c x p + c (c.(p + r)); without rotors (1 + c.c) (I + hat(c))^-1 p."""
    p, first, last = momentum
    return xyz.add(xyz.add(first, xyz.cross(p, c)), xyz.scale(xyz.dot(c, last), c))


def right_hand_side_transposed(c: Vector, p: Vector) -> Vector:
    """p + c x p + c (c.p): `right_hand_side` without rotors, with the transposed matrix."""
    return xyz.add(xyz.add(p, xyz.cross(c, p)), xyz.scale(xyz.dot(c, p), c))


def rotor_part(c: Vector, r: Vector) -> Vector:
    """-r + c (c.r), the part of `right_hand_side` that is linear in r; its matrix is symmetric."""
    return xyz.subtract(xyz.scale(xyz.dot(c, r), c), r)


def negative_residual(J: Matrix, momentum: Momentum, c: Vector) -> Vector:
    """Minus the divided residual r(c)."""
    return xyz.subtract(xyz.scale(0.5, right_hand_side(c, momentum)), xyz.apply(J, c))


def jacobian(J: Matrix, momentum: Momentum, c: Vector) -> Matrix:
    """Derivative J - (hat(p) + (c.b) I + c b^T)/2 of the divided residual, with b = p + r."""
    (j00, j01, j02), (j10, j11, j12), (j20, j21, j22) = J
    (p0, p1, p2), _, (b0, b1, b2) = momentum
    (x, y, z), k = c, xyz.dot(c, momentum.last)
    return (
        (j00 - (k + x * b0) / 2, j01 + (p2 - x * b1) / 2, j02 - (p1 + x * b2) / 2),
        (j10 - (p2 + y * b0) / 2, j11 - (k + y * b1) / 2, j12 + (p0 - y * b2) / 2),
        (j20 + (p1 - z * b0) / 2, j21 - (p0 + z * b1) / 2, j22 - (k + z * b2) / 2),
    )


def residual_norm(J: Matrix, p: Vector, c: Vector, r: Vector | None = None) -> Array:
    """Norm of the residual 2 (Jc + c x Jc)/(1 + c.c) - p of the equation for F.

    Rotors add (r + c x r - c (c.r))/(1 + c.c) to the vector.
    """
    Jc = xyz.apply(J, c)
    left = xyz.scale(2.0, xyz.add(Jc, xyz.cross(c, Jc)))
    if r is not None:
        turned = xyz.subtract(xyz.cross(c, r), xyz.scale(xyz.dot(c, r), c))
        left = xyz.add(left, xyz.add(r, turned))
    residual = xyz.subtract(xyz.scale(1 / (1 + xyz.dot(c, c)), left), p)
    return jnp.sqrt(xyz.dot(residual, residual))


def is_on_branch_of_identity(J: Matrix, c: Vector, r: Vector | None = None) -> Array:
    """Whether the root follows from the identity as h grows, for an inertia of unit trace.

    The equation has other roots. For a thin body there is one of about the same p that turns by
    nearly pi about the thin axis.

    With W = F M and M = Jd + hat(r)/2, two roots meet (a fold) where tr(W) I - W is singular. Its
    determinant is tr(W) tr(adj W) - det M, positive at the identity. Beyond two folds it is
    positive again. If det M is not negative, as for every body, tr(W) keeps its sign up to the
    first fold, and was never seen positive beyond the second. Another inertia has the determinant
    alone.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = J
    Jd = (0.5 - xx, -xy, -xz), (-yx, 0.5 - yy, -yz), (-zx, -zy, 0.5 - zz)
    adjugate = xyz.adjugate(Jd)
    w = 2 / (1 + xyz.dot(c, c))
    trace, trace_of_adjugate = (_trace_of_turned(w, c, S) for S in (Jd, adjugate))
    det = xyz.dot(Jd[0], adjugate[0])
    if r is not None:
        Jr, cr = xyz.apply(Jd, r), xyz.dot(c, r)
        trace -= w * cr
        trace_of_adjugate += ((w - 1) * xyz.dot(r, r) + w * cr**2) / 4 - w * xyz.dot(c, Jr)
        det += xyz.dot(r, Jr) / 4
    # For thin bodies and fast rotors the determinant is a small difference.
    size = 1 if r is None else 1 + xyz.dot(r, r)
    rounding = ROUNDING_MARGIN * float(jnp.finfo(w.dtype).eps) * size
    return ((trace > 0) | (det < 0)) & (trace * trace_of_adjugate - det > -rounding)


def _trace_of_turned(w: Array, c: Vector, S: Matrix) -> Array:
    """tr(F S) for a symmetric S, with w = 2/(1 + c.c)."""
    return (w - 1) * xyz.trace(S) + w * xyz.dot(c, xyz.apply(S, c))


def rounding(c: Vector, r: Vector | None = None, margin: float = ROUNDING_MARGIN) -> Array:
    """Residual norm, for an inertia of unit trace, that rounding alone can leave."""
    size = 2 * jnp.sqrt(xyz.dot(c, c))
    if r is not None:
        size += jnp.sqrt(xyz.dot(r, r))
    return margin * jnp.finfo(c[0].dtype).eps * size
