"""Vectors and 3x3 matrices as tuples of components.

Inside a loop XLA compiles arithmetic on scalars to straight-line code, whereas each operation
on a small array costs a dispatch. Over many steps or bodies at once, each component is a
long array that vectorises. The same code serves both cases.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array

Vector = tuple[Array, Array, Array]
Matrix = tuple[Vector, Vector, Vector]  # rows


def split(array: Array, axis: int = -1) -> Vector:
    """Components of an array with one axis of length 3."""
    x, y, z = (jax.lax.index_in_dim(array, i, axis, keepdims=False) for i in range(3))
    return x, y, z


def split_matrix(array: Array, axis: int = -2) -> Matrix:
    """Components of an array with rows along `axis` and columns along the next one."""
    x, y, z = (split(row, axis if axis >= 0 else axis + 1) for row in split(array, axis))
    return x, y, z


def join(v: Vector, axis: int = -1) -> Array:
    """Array of a vector, the inverse of `split`."""
    return jnp.stack(v, axis=axis)


def join_matrix(M: Matrix, axis: int = -2) -> Array:
    """Array of a matrix, the inverse of `split_matrix`."""
    entries = [entry for row in M for entry in row]
    axis += (entries[0].ndim + 2) if axis < 0 else 0
    # One operation: two nested operations would be two passes over memory.
    flat = jnp.stack(entries, axis=axis)
    return flat.reshape(*flat.shape[:axis], 3, 3, *flat.shape[axis + 1 :])


def six(S: Matrix, axis: int = 1) -> Array:
    """Array of the six numbers of a symmetric matrix, the inverse of `symmetric`."""
    (a, d, e), (_, b, f), (_, _, c) = S
    return jnp.stack([a, b, c, d, e, f], axis=axis)


def symmetric(six: Array) -> Matrix:
    """Symmetric matrix of six numbers along the first axis."""
    a, b, c, d, e, f = six
    return (a, d, e), (d, b, f), (e, f, c)


def matmul(A: Array, B: Array) -> Array:
    """A @ B in full precision; by default a GPU would round float32 factors to ten bits."""
    return jnp.matmul(A, B, precision="highest")


def dot(a: Vector, b: Vector) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def scale(k: Array | float, a: Vector) -> Vector:
    return k * a[0], k * a[1], k * a[2]


def add(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def subtract(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def apply(M: Matrix, v: Vector) -> Vector:
    return dot(M[0], v), dot(M[1], v), dot(M[2], v)


def transpose(M: Matrix) -> Matrix:
    (a, b, c), (d, e, f), (g, h, i) = M
    return (a, d, g), (b, e, h), (c, f, i)


def cross_rows(M: Matrix, a: Vector) -> Matrix:
    """M hat(a): the cross product of each row with `a`."""
    return cross(M[0], a), cross(M[1], a), cross(M[2], a)


def trace(M: Matrix) -> Array:
    return M[0][0] + M[1][1] + M[2][2]


def adjugate(M: Matrix) -> Matrix:
    """Cross products of the rows, as columns: the inverse times the determinant."""
    x, y, z = M
    return transpose((cross(y, z), cross(z, x), cross(x, y)))


def inverse(M: Matrix) -> Matrix:
    """The adjugate over the determinant (Cramer's rule)."""
    x, y, z = adjugate(M)
    reciprocal = 1 / dot(M[0], (x[0], y[0], z[0]))
    return scale(reciprocal, x), scale(reciprocal, y), scale(reciprocal, z)


def solve(M: Matrix, b: Vector) -> Vector:
    """Solution of M x = b by Cramer's rule."""
    x, y, z = transpose(M)
    yz = cross(y, z)
    reciprocal = 1 / dot(x, yz)
    return scale(reciprocal, (dot(yz, b), dot(cross(z, x), b), dot(cross(x, y), b)))
