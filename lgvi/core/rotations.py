"""Rotations by component, for one step or many at once."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import components as xyz
from .components import Vector

Quaternion = tuple[Array | float, Vector]  # scalar and vector part, of any norm but zero


def split(q: Array, axis: int = -1) -> Quaternion:
    """Parts of quaternions wxyz with their four entries along `axis`."""
    w, x, y, z = (jax.lax.index_in_dim(q, i, axis, keepdims=False) for i in range(4))
    return w, (x, y, z)


def conjugate(q: Quaternion) -> Quaternion:
    """The inverse rotation; the minus sign is on the scalar part."""
    return -q[0], q[1]


def turn(q: Quaternion, x: Vector) -> Vector:
    """Vector in the frame that the quaternion's rotation maps to."""
    w, v = q
    turned = xyz.cross(v, x)
    turned = xyz.add(xyz.scale(w, turned), xyz.cross(v, turned))
    return xyz.add(x, xyz.scale(2 / (w * w + xyz.dot(v, v)), turned))


def turn_back(c: Vector, x: Vector) -> Vector:
    """F^T x for the rotation F of a Rodrigues vector."""
    return turn((-1.0, c), x)


def turn_rows(R: Array, q: Array) -> Array:
    """R Q for many quaternions (..., 4), all rows of R in one pass."""
    return xyz.join(turn(conjugate(split(q[..., None, :])), xyz.split(R)))


def rate(q: Quaternion, zeta: Vector) -> Array:
    """Tangent (..., 4) of quaternions that turn by `zeta` in the frame on their left."""
    w, v = q
    vector = xyz.scale(0.5, xyz.add(xyz.scale(w, zeta), xyz.cross(zeta, v)))
    return jnp.stack([-0.5 * xyz.dot(zeta, v), *vector], axis=-1)
