"""Vectors and 3x3 matrices by component, with operators.

Inside a loop XLA compiles arithmetic on scalars to straight-line code, whereas each operation
on a small array costs a dispatch. Over many steps or bodies at once, each component is a
long array that vectorises. The same code serves both cases.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array

Scalar = Array | float | int


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False, slots=True)
class Vec3:
    """A vector, or many of them: three arrays of one shape."""

    x: Array
    y: Array
    z: Array

    __array_ufunc__ = None  # else a number of NumPy on the left would take a vector for an array
    __no_type_check__ = True  # of fields: JAX also makes trees of what are no arrays

    @classmethod
    def of(cls, array: Array, axis: int = -1) -> "Vec3":
        """Components along an axis of length 3."""
        return cls(*(jax.lax.index_in_dim(array, i, axis, keepdims=False) for i in range(3)))

    def array(self, axis: int = -1) -> Array:
        """The inverse of `of`."""
        return jnp.stack([*self], axis=axis)

    def __iter__(self) -> Iterator[Array]:
        return iter((self.x, self.y, self.z))

    def __getitem__(self, i: int) -> Array:
        """The component of an index, for formulas in which it is cyclic."""
        return (self.x, self.y, self.z)[i]

    def __add__(self, other: "Vec3") -> "Vec3":
        return Vec3(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: "Vec3") -> "Vec3":
        return Vec3(self.x - other.x, self.y - other.y, self.z - other.z)

    def __mul__(self, k: Scalar) -> "Vec3":
        return Vec3(k * self.x, k * self.y, k * self.z)

    __rmul__ = __mul__

    def __truediv__(self, k: Scalar) -> "Vec3":
        return Vec3(self.x / k, self.y / k, self.z / k)

    def dot(self, other: "Vec3") -> Array:
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: "Vec3") -> "Vec3":
        return Vec3(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

    def outer(self, other: "Vec3") -> "Mat3":
        """The matrix of this column times the other one as a row."""
        return Mat3(self.x * other, self.y * other, self.z * other)

    def norm(self) -> Array:
        return jnp.sqrt(self.dot(self))


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False, slots=True)
class Mat3:
    """A 3x3 matrix, or many of them: its rows, so `M.x.y` is the entry in row x and column y."""

    x: Vec3
    y: Vec3
    z: Vec3

    __array_ufunc__ = None
    __no_type_check__ = True

    @classmethod
    def of(cls, array: Array, axis: int = -2) -> "Mat3":
        """Rows along an axis, and columns along the next one."""
        columns = axis if axis >= 0 else axis + 1
        return cls(*(Vec3.of(row, columns) for row in Vec3.of(array, axis)))

    def array(self, axis: int = -2) -> Array:
        """The inverse of `of`."""
        entries = [entry for row in self for entry in row]
        axis += (self.x.x.ndim + 2) if axis < 0 else 0
        # One operation: two nested operations would be two passes over memory.
        flat = jnp.stack(entries, axis=axis)
        return flat.reshape(*flat.shape[:axis], 3, 3, *flat.shape[axis + 1 :])

    @classmethod
    def of_six(cls, six: Array, axis: int = -1) -> "Mat3":
        """The symmetric matrix of six numbers along an axis: xx, yy, zz, xy, xz, yz."""
        xx, yy, zz, xy, xz, yz = (
            jax.lax.index_in_dim(six, i, axis, keepdims=False) for i in range(6)
        )
        return cls(Vec3(xx, xy, xz), Vec3(xy, yy, yz), Vec3(xz, yz, zz))

    def six(self, axis: int = -1) -> Array:
        """The inverse of `of_six`."""
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = self
        return jnp.stack([xx, yy, zz, xy, xz, yz], axis=axis)

    def __iter__(self) -> Iterator[Vec3]:
        return iter((self.x, self.y, self.z))

    def __add__(self, other: "Mat3") -> "Mat3":
        return Mat3(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: "Mat3") -> "Mat3":
        return Mat3(self.x - other.x, self.y - other.y, self.z - other.z)

    def __mul__(self, k: Scalar) -> "Mat3":
        return Mat3(k * self.x, k * self.y, k * self.z)

    __rmul__ = __mul__

    def __matmul__(self, v: Vec3) -> Vec3:
        return Vec3(self.x.dot(v), self.y.dot(v), self.z.dot(v))

    def plus_identity(self, k: Scalar) -> "Mat3":
        """M + k I, where nothing is added to the other entries."""
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = self
        return Mat3(Vec3(xx + k, xy, xz), Vec3(yx, yy + k, yz), Vec3(zx, zy, zz + k))

    def plus_hat(self, v: Vec3) -> "Mat3":
        """M + hat(v), where nothing is added to the diagonal."""
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = self
        return Mat3(
            Vec3(xx, xy - v.z, xz + v.y), Vec3(yx + v.z, yy, yz - v.x), Vec3(zx - v.y, zy + v.x, zz)
        )

    def cross(self, v: Vec3) -> "Mat3":
        """M hat(v): the cross product of each row with the vector."""
        return Mat3(self.x.cross(v), self.y.cross(v), self.z.cross(v))

    @property
    def T(self) -> "Mat3":
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = self
        return Mat3(Vec3(xx, yx, zx), Vec3(xy, yy, zy), Vec3(xz, yz, zz))

    def trace(self) -> Array:
        return self.x.x + self.y.y + self.z.z

    def adjugate(self) -> "Mat3":
        """Cross products of the rows, as columns: the inverse times the determinant."""
        x, y, z = self
        return Mat3(y.cross(z), z.cross(x), x.cross(y)).T

    def inverse(self) -> "Mat3":
        """The adjugate over the determinant (Cramer's rule)."""
        adjugate = self.adjugate()
        return 1 / self.x.dot(adjugate.T.x) * adjugate

    def solve(self, b: Vec3) -> Vec3:
        """Solution of M x = b by Cramer's rule."""
        x, y, z = self.T
        yz = y.cross(z)
        return 1 / x.dot(yz) * Vec3(yz.dot(b), z.cross(x).dot(b), x.cross(y).dot(b))


def matmul(A: Array, B: Array) -> Array:
    """A @ B in full precision; by default a GPU would round float32 factors to ten bits."""
    return jnp.matmul(A, B, precision="highest")
