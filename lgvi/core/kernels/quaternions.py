"""Rotations by component, for one step or many at once."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import vectors as xyz
from .vectors import Vector

Quaternion = tuple[Array | float, Vector]  # scalar and vector part, of any norm but zero


def split(q: Array, axis: int = -1) -> Quaternion:
    """Parts of quaternions wxyz with their four entries along `axis`."""
    w, x, y, z = (jax.lax.index_in_dim(q, i, axis, keepdims=False) for i in range(4))
    return w, (x, y, z)


def join(q: Quaternion, axis: int = -1) -> Array:
    """Array of a quaternion, the inverse of `split`."""
    return jnp.stack([q[0], *q[1]], axis=axis)


def conjugate(q: Quaternion) -> Quaternion:
    """The inverse rotation; the minus sign is on the scalar part."""
    return -q[0], q[1]


def rotate(q: Quaternion, x: Vector) -> Vector:
    """R x for the rotation R of a quaternion."""
    w, v = q
    turned = xyz.cross(v, x)
    turned = xyz.add(xyz.scale(w, turned), xyz.cross(v, turned))
    return xyz.add(x, xyz.scale(2 / (w * w + xyz.dot(v, v)), turned))


def rotate_back(c: Vector, x: Vector) -> Vector:
    """F^T x for the rotation F of a Rodrigues vector."""
    return rotate((-1.0, c), x)


def rotate_rows(R: Array, q: Quaternion) -> Array:
    """R Q for R (steps, 3, 3, *batch) and q (steps, *batch), all rows of R in one pass."""
    w, v = q
    x, y, z = (component[:, None] for component in v)
    back = conjugate((jnp.expand_dims(w, 1), (x, y, z)))
    return xyz.join(rotate(back, xyz.split(R, axis=2)), axis=2)


def rotated_attitude(R: Array, q: Array) -> Array:
    """R Q for one attitude R (3, 3) and one quaternion wxyz (4,)."""
    return rotate_rows(R[None], split(q[None]))[0]


def multiply(q: Quaternion, r: Quaternion) -> Quaternion:
    """The rotation of `r`, then the rotation of `q`."""
    (w, v), (a, b) = q, r
    return w * a - xyz.dot(v, b), xyz.add(
        xyz.add(xyz.scale(w, b), xyz.scale(a, v)), xyz.cross(v, b)
    )


def scale(k: Array | float, q: Quaternion) -> Quaternion:
    return k * q[0], xyz.scale(k, q[1])


def tangent_of_turn(q: Array, xi: Array) -> Array:
    """Tangents of quaternions (steps, 4, ...) for small rotation vectors `xi`, body frame."""
    turned = multiply(split(q, axis=1), (0.0, xyz.split(xi, axis=1)))
    return join(scale(0.5, turned), axis=1)
