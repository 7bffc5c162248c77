r"""The discrete Moser-Veselov equation by component, for one step or many at once.

The relative rotation $F$ of a step solves $F J_d - J_d F^T = h\,\hat\pi$. Written with the
Rodrigues vector $c$ of $F$ (`F = cayley(c)`) and $p = h\pi$, and times a factor that
does not vanish, it is the quadratic

$$r(c) = 2 J c - \bigl(p - c\times p + c\,(c\cdot p)\bigr) = 0,\qquad
  A(c) = \frac{\partial r}{\partial c} = 2 J - \bigl(\hat p + (c\cdot p)\,I + c\,p^T\bigr).$$

Exponential coordinates give the same root: $F = \operatorname{Exp}(g)$ with
$g = 2\arctan|c|\;c/|c|$ solves
$\frac{\sin|g|}{|g|} J g + \frac{1-\cos|g|}{|g|^2}\, g\times J g = p$. The quadratic needs no
trigonometry, no square root and no branch for small angles.

For a body with rotors of relative momentum $\rho$, and $r = h\rho$, the equation
$F J_d - J_d F^T + \tfrac12(F\hat r + \hat r F^T) = h\,\hat\pi$ becomes the same quadratic with
$p - r$ for the first $p$ and $p + r$ for the last:

$$r(c) = 2 J c - \bigl((p - r) - c\times p + c\,(c\cdot(p + r))\bigr) = 0.$$

Where an argument `r` of a function is None, the equation is the one without rotors.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.vectors import Mat3, Vec3

# Multiple of the rounding unit at which a residual still counts as rounding.
ROUNDING_MARGIN = 8.0


def materialise(v: Vec3) -> Vec3:
    """The same vector, computed once and in one place."""
    return Vec3.of(jax.lax.optimization_barrier(v.array(axis=0)), axis=0)


class Momentum(NamedTuple):
    """p, p - r and p + r; without rotors all three are p."""

    p: Vec3
    first: Vec3
    last: Vec3


def with_rotors(p: Vec3, r: Vec3 | None = None) -> Momentum:
    """The vectors of the equation, from p = h pi and r = h rho."""
    if r is None:
        return Momentum(p, p, p)
    # Otherwise XLA would compute each of the six numbers separately.
    six = jax.lax.optimization_barrier(jnp.stack([*(p - r), *(p + r)]))
    first, last = Vec3.of(six[:3], axis=0), Vec3.of(six[3:], axis=0)
    # Not `p` itself: a loop that reads three more numbers is too large to be compiled as one.
    return Momentum(0.5 * (first + last), first, last)


def right_hand_side(c: Vec3, momentum: Momentum) -> Vec3:
    """p - r - c x p + c (c.(p + r)); without rotors (1 + c.c) (I + hat(c))^-1 p."""
    p, first, last = momentum
    return first + p.cross(c) + c.dot(last) * c


def right_hand_side_transposed(c: Vec3, p: Vec3) -> Vec3:
    """p + c x p + c (c.p): `right_hand_side` without rotors, with the transposed matrix."""
    return p + c.cross(p) + c.dot(p) * c


def rotor_part(c: Vec3, r: Vec3) -> Vec3:
    """c (c.r) - r, the part of `right_hand_side` that is linear in r; its matrix is symmetric."""
    return c.dot(r) * c - r


def negative_residual(twice_J: Mat3, momentum: Momentum, c: Vec3) -> Vec3:
    """Minus the residual r(c)."""
    return right_hand_side(c, momentum) - twice_J @ c


def jacobian(twice_J: Mat3, momentum: Momentum, c: Vec3) -> Mat3:
    """Derivative 2 J - (hat(p) + (c.b) I + c b^T) of the residual r(c), with b = p + r."""
    p, _, b = momentum
    return twice_J - c.outer(b).plus_hat(p).plus_identity(c.dot(b))


def residual_norm(twice_J: Mat3, p: Vec3, c: Vec3, r: Vec3 | None = None) -> Array:
    """Norm of the residual 2 (Jc + c x Jc)/(1 + c.c) - p of the equation for F.

    Rotors add (r + c x r - c (c.r))/(1 + c.c) to the vector.
    """
    left = twice_J @ c
    left += c.cross(left)
    if r is not None:
        left += r + (c.cross(r) - c.dot(r) * c)
    return (1 / (1 + c.dot(c)) * left - p).norm()


def is_on_branch_of_identity(J: Mat3, c: Vec3, r: Vec3 | None = None) -> Array:
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
    Jd = Mat3(Vec3(0.5 - xx, -xy, -xz), Vec3(-yx, 0.5 - yy, -yz), Vec3(-zx, -zy, 0.5 - zz))
    adjugate = Jd.adjugate()
    w = 2 / (1 + c.dot(c))
    trace, trace_of_adjugate = (_trace_of_turned(w, c, S) for S in (Jd, adjugate))
    det = Jd.x.dot(adjugate.x)
    if r is not None:
        Jr, cr = Jd @ r, c.dot(r)
        trace -= w * cr
        trace_of_adjugate += ((w - 1) * r.dot(r) + w * cr**2) / 4 - w * c.dot(Jr)
        det += r.dot(Jr) / 4
    # For thin bodies and fast rotors the determinant is a small difference.
    size = 1 if r is None else 1 + r.dot(r)
    rounding = ROUNDING_MARGIN * float(jnp.finfo(w.dtype).eps) * size
    return ((trace > 0) | (det < 0)) & (trace * trace_of_adjugate - det > -rounding)


def _trace_of_turned(w: Array, c: Vec3, S: Mat3) -> Array:
    """tr(F S) for a symmetric S, with w = 2/(1 + c.c)."""
    return (w - 1) * S.trace() + w * c.dot(S @ c)


def rounding(c: Vec3, r: Vec3 | None = None, margin: float = ROUNDING_MARGIN) -> Array:
    """Residual norm, for an inertia of unit trace, that rounding alone can leave."""
    size = 2 * c.norm()
    if r is not None:
        size += r.norm()
    return margin * jnp.finfo(size.dtype).eps * size
