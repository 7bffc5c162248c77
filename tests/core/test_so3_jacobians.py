"""Jacobians of the exponential map agree, with their derivatives, with fifty decimal digits."""

from decimal import Decimal
from itertools import combinations_with_replacement, product

import jax
import jax.numpy as jnp
import numpy as np

from lgvi import so3

from .decimal_motion import digits

AXIS = np.array([2 / 3, -1 / 3, 2 / 3])
# At rest, where the formulas change (|g| = 1, 2), at half a turn and beyond.
ANGLES = [0.0, 1e-8, 1e-3, 0.5, 1 - 1e-9, 1 + 1e-9, 2 - 1e-9, 2 + 1e-9, np.pi, 4.0]
TERMS = 60
STEP = Decimal("1e-14")


def decimal_jacobian(g):
    """The series of the left Jacobian, the sum of hat(g)^k/(k+1)!."""
    x, y, z = g
    hat = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], object)
    term = total = np.array([[Decimal(i == j) for j in range(3)] for i in range(3)], object)
    for k in range(1, TERMS):
        term = term @ hat / (k + 1)
        total = total + term
    return total


def decimal_inverse(M):
    (a, b, c), (d, e, f), (g, h, i) = M
    adjugate = [
        [e * i - f * h, c * h - b * i, b * f - c * e],
        [f * g - d * i, a * i - c * g, c * d - a * f],
        [d * h - e * g, b * g - a * h, a * e - b * d],
    ]
    determinant = a * adjugate[0][0] + b * adjugate[1][0] + c * adjugate[2][0]
    return [[entry / determinant for entry in row] for row in adjugate]


def decimal_values(g):
    """The left Jacobian and its inverse at a rotation vector of decimal numbers (2, 3, 3)."""
    left = decimal_jacobian(g)
    return np.array([left, decimal_inverse(left)], object)


@digits
def oracle(g):
    """Values (2, 3, 3), and derivatives (2, 3, 3, 3) and (2, 3, 3, 3, 3), by differences."""
    g = [Decimal(float(x)) for x in g]

    def at(*steps):
        moved = [x + STEP * sum(s for j, s in steps if j == i) for i, x in enumerate(g)]
        return decimal_values(moved)

    first = [(at((i, 1)) - at((i, -1))) / (2 * STEP) for i in range(3)]
    second = np.zeros((3, 3, 2, 3, 3), object)
    for i, j in combinations_with_replacement(range(3), 2):
        signs = product((1, -1), repeat=2)
        second[i, j] = second[j, i] = sum(s * t * at((i, s), (j, t)) for s, t in signs)
    return (
        decimal_values(g).astype(float),
        np.moveaxis(np.array(first), 0, -1).astype(float),
        (np.moveaxis(second, (0, 1), (-2, -1)) / (4 * STEP**2)).astype(float),
    )


@jax.jit
@jax.vmap
def library(g):
    def values(g):
        return jnp.stack([so3.left_jacobian(g), so3.left_jacobian_inverse(g)])

    def first(g):
        derivative = jax.jacfwd(values)(g)
        return derivative, derivative

    second, derivative = jax.jacrev(first, has_aux=True)(g)
    return values(g), derivative, second


def test_jacobians_and_their_derivatives_at_rest_and_up_to_half_a_turn(dtype):
    g = jnp.asarray(np.outer(ANGLES, AXIS), dtype)
    found, eps = library(g), float(jnp.finfo(dtype).eps)
    desired = [np.stack(column) for column in zip(*map(oracle, np.asarray(g)), strict=True)]
    for actual, wanted, rounding in zip(found, desired, (4, 16, 64), strict=True):
        assert actual.dtype == dtype
        np.testing.assert_allclose(np.asarray(actual, float), wanted, rtol=0, atol=rounding * eps)


def test_a_rotation_changes_with_its_rotation_vector_by_the_jacobians():
    """Exp(g + d) is Exp(J_l d) Exp(g) and Exp(g) Exp(J_r d), to first order in d."""
    g, d = jnp.array([0.7, -1.1, 0.4]), jnp.array([0.3, 0.2, -0.5])

    @jax.jit
    def rates():
        left, right = so3.left_jacobian(g) @ d, so3.right_jacobian(g) @ d
        R = so3.exp(g)
        turned = (
            lambda s: so3.exp(g + s * d),
            lambda s: so3.exp(s * left) @ R,
            lambda s: R @ so3.exp(s * right),
        )
        inverses = so3.left_jacobian_inverse(g) @ left, so3.right_jacobian_inverse(g) @ right
        return [jax.jvp(f, (0.0,), (1.0,))[1] for f in turned], inverses

    (desired, *found), inverses = rates()
    for rate in found:
        np.testing.assert_allclose(rate, desired, rtol=0, atol=1e-15)
    for change in inverses:
        np.testing.assert_allclose(change, d, rtol=0, atol=1e-15)
