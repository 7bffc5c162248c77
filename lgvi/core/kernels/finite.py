"""Derivatives where a value is not finite: a cotangent of zero stays zero.

A product with NaN turns a zero into NaN. So the gradient of what a mask leaves out would be NaN, if
coefficients of derivatives were taken where values are NaN.
"""

from collections.abc import Callable
from functools import wraps
from operator import mul
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .primitives import linear
from .vectors import matmul

Tree = TypeVar("Tree")


def finite(x: Array) -> Array:
    """The array, with zero for what is not finite."""
    return jnp.where(jnp.isfinite(x), x, 0)


def finite_matrix(J: Array, axis: int = -2) -> Array:
    """Inertias along two axes from `axis` on, with the identity for those not finite, or zero."""
    axes = axis % J.ndim, axis % J.ndim + 1
    others = [i for i in range(J.ndim) if i not in axes]
    valid = jnp.all(jnp.isfinite(J), axis=axes, keepdims=True)
    valid &= jnp.any(J != 0, axis=axes, keepdims=True)
    return jnp.where(valid, J, jnp.expand_dims(jnp.eye(3, dtype=J.dtype), others))


def without_nan(valid: Array, tree: Tree) -> Tree:
    """The same if `valid`; else the floats that are NaN are one."""

    def replace(x):
        floats = jnp.issubdtype(x.dtype, jnp.floating)
        return jnp.where(valid | ~jnp.isnan(x), x, 1) if floats else x

    return jax.tree.map(replace, tree)


def _times(at, vectors):
    return [at[0] * vectors[0]]


def _times_unless_zero(at, cotangents):
    return [jnp.where(cotangents[0] == 0, 0, at[0] * cotangents[0])]


_multiply = linear(_times, _times_unless_zero, results=1)
times_unless_zero = linear(_times_unless_zero, _times_unless_zero, results=1)


def nan_unless(valid: Array, tangent: Array) -> Array:
    """The tangent if `valid`, else NaN; its transpose takes a cotangent of zero to zero."""
    factor = jnp.broadcast_to(jnp.where(valid, 1, jnp.nan), tangent.shape).astype(tangent.dtype)
    return _multiply([factor], [tangent])[0]


def with_finite_coefficients(function: Callable[..., Array]) -> Callable[..., Array]:
    """The same function, with the derivative at zero for arguments that are not finite.

    Where its value is not finite its tangents are NaN, and take a cotangent of zero to zero.
    """

    @jax.custom_jvp
    @wraps(function)
    def call(*arguments):
        return function(*arguments)

    @call.defjvp
    def _(primals, tangents):
        value, at = function(*primals), tuple(map(finite, primals))
        _, tangent = jax.jvp(function, at, tangents)
        return value, nan_unless(jnp.isfinite(value), tangent)

    return call


multiply = with_finite_coefficients(mul)
product = with_finite_coefficients(matmul)  # of matrices
