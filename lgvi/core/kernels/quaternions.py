"""Rotations by component, for one step or many at once."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .vectors import Scalar, Vec3


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False, slots=True)
class Quaternion:
    """Rotations by quaternions of any norm but zero.

    The rotation F of a Rodrigues vector c is that of `Quaternion(1.0, c)`.
    """

    w: Scalar  # scalar part
    v: Vec3  # vector part

    __no_type_check__ = True  # as in `Vec3`

    @classmethod
    def of(cls, wxyz: Array, axis: int = -1) -> "Quaternion":
        """Parts of quaternions with their four entries along an axis."""
        w, x, y, z = (jax.lax.index_in_dim(wxyz, i, axis, keepdims=False) for i in range(4))
        return cls(w, Vec3(x, y, z))

    def array(self, axis: int = -1) -> Array:
        """The inverse of `of`."""
        return jnp.stack([self.w, *self.v], axis=axis)

    def __mul__(self, other: "Quaternion") -> "Quaternion":
        """The rotation of the other one, then this rotation."""
        (w, v), (a, b) = (self.w, self.v), (other.w, other.v)
        return Quaternion(w * a - v.dot(b), w * b + a * v + v.cross(b))

    def conjugate(self) -> "Quaternion":
        """The inverse rotation; the minus sign is on the scalar part."""
        return Quaternion(-self.w, self.v)

    def rotate(self, x: Vec3) -> Vec3:
        """R x for the rotation R of the quaternion."""
        w, v = self.w, self.v
        turned = v.cross(x)
        turned = w * turned + v.cross(turned)
        return x + 2 / (w * w + v.dot(v)) * turned

    def rotate_back(self, x: Vec3) -> Vec3:
        """R^T x."""
        return self.conjugate().rotate(x)


def rotate_rows(R: Array, q: Quaternion) -> Array:
    """R Q for R (steps, 3, 3, *batch) and q (steps, *batch), all rows of R in one pass."""
    of_rows = jax.tree.map(lambda component: component[:, None], q)
    return of_rows.rotate_back(Vec3.of(R, axis=2)).array(axis=2)


def rotated_attitude(R: Array, q: Array) -> Array:
    """R Q for one attitude R (3, 3) and one quaternion wxyz (4,)."""
    return rotate_rows(R[None], Quaternion.of(q[None]))[0]


def tangent_of_turn(q: Array, xi: Array) -> Array:
    """Tangents of quaternions (steps, 4, ...) for small rotation vectors `xi`, body frame."""
    turned = Quaternion.of(q, axis=1) * Quaternion(0.0, Vec3.of(xi, axis=1))
    return 0.5 * turned.array(axis=1)
