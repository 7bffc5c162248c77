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
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import components as xyz
from .components import Matrix, Vector

# Multiple of the rounding unit at which a residual still counts as rounding.
ROUNDING_MARGIN = 8.0


def divided(c: Vector, p: Vector) -> Vector:
    """p - c x p + c (c.p): multiplication by (1 + c.c) times the inverse of I + hat(c)."""
    return xyz.add(xyz.add(p, xyz.cross(p, c)), xyz.scale(xyz.dot(c, p), c))


def divided_back(c: Vector, p: Vector) -> Vector:
    """p + c x p + c (c.p): multiplication by the transpose of the same matrix."""
    return xyz.add(xyz.add(p, xyz.cross(c, p)), xyz.scale(xyz.dot(c, p), c))


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
    return xyz.split(jax.lax.optimization_barrier(xyz.join(v, axis=0)), axis=0)


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


def rounding(c: Vector, margin: float = ROUNDING_MARGIN) -> Array:
    """Residual norm, for an inertia of unit trace, that rounding alone can leave."""
    return margin * jnp.finfo(c[0].dtype).eps * 2 * jnp.sqrt(xyz.dot(c, c))
