"""Vectors and 3x3 matrices as tuples of components.

Inside a loop XLA compiles arithmetic on scalars to straight-line code, where operations on
small arrays each cost a dispatch; over many steps or bodies at once, each component is a
long array that vectorises. The same code serves both.
"""

import jax.numpy as jnp
from jaxtyping import Array

Vector = tuple[Array, Array, Array]
Matrix = tuple[Vector, Vector, Vector]  # rows


def split(array: Array) -> Vector:
    """Components of an array (..., 3)."""
    return array[..., 0], array[..., 1], array[..., 2]


def split_matrix(array: Array) -> Matrix:
    """Components of an array (..., 3, 3)."""
    return split(array[..., 0, :]), split(array[..., 1, :]), split(array[..., 2, :])


def join(v: Vector) -> Array:
    """Array (..., 3) of a vector."""
    return jnp.stack(v, axis=-1)


def join_matrix(M: Matrix) -> Array:
    """Array (..., 3, 3) of a matrix."""
    flat = jnp.stack([entry for row in M for entry in row], axis=-1)
    return flat.reshape(*flat.shape[:-1], 3, 3)


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


def multiply(A: Matrix, B: Matrix) -> Matrix:
    columns = transpose(B)
    return transpose((apply(A, columns[0]), apply(A, columns[1]), apply(A, columns[2])))


def scale_matrix(k: Array, M: Matrix) -> Matrix:
    return scale(k, M[0]), scale(k, M[1]), scale(k, M[2])


def add_matrices(A: Matrix, B: Matrix) -> Matrix:
    return add(A[0], B[0]), add(A[1], B[1]), add(A[2], B[2])


def cross_columns(a: Vector, M: Matrix) -> Matrix:
    """hat(a) M: the cross product of `a` with each column."""
    x, y, z = transpose(M)
    return transpose((cross(a, x), cross(a, y), cross(a, z)))


def inverse(M: Matrix) -> Matrix:
    """Cross products of the rows over the determinant (Cramer's rule)."""
    x, y, z = M
    yz = cross(y, z)
    reciprocal = 1 / dot(x, yz)
    columns = scale(reciprocal, yz), scale(reciprocal, cross(z, x)), scale(reciprocal, cross(x, y))
    return transpose(columns)


def solve(M: Matrix, b: Vector) -> Vector:
    """Solution of M x = b by Cramer's rule."""
    x, y, z = transpose(M)
    yz = cross(y, z)
    reciprocal = 1 / dot(x, yz)
    return scale(reciprocal, (dot(yz, b), dot(cross(z, x), b), dot(cross(x, y), b)))
