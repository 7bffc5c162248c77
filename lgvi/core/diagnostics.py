"""Quantities that a free rigid body conserves, and distances of a matrix from a rotation."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .kernels.vectors import matmul
from .typed_arrays import as_floats, as_one_program


@as_one_program
def energy(pi: Float[ArrayLike, "3"], J: Float[ArrayLike, "3 3"]) -> Float[Array, ""]:
    r"""Kinetic energy of rotation $\tfrac12\,\pi\cdot J^{-1}\pi$.

    Parameters
    ----------
    pi
        Body angular momentum (3,), kg m²/s.
    J
        Inertia (3, 3), body frame, kg m².

    Returns
    -------
    Array
        Energy, scalar, J.
    """
    pi, J = as_floats(pi=(pi, (3,)), J=(J, (3, 3)))
    return pi @ jnp.linalg.solve(J, pi) / 2


@as_one_program
def spatial_momentum(R: Float[ArrayLike, "3 3"], pi: Float[ArrayLike, "3"]) -> Float[Array, "3"]:
    r"""Angular momentum in the space frame $R\pi$.

    Parameters
    ----------
    R
        Attitude (3, 3), body to space.
    pi
        Body angular momentum (3,), kg m²/s.

    Returns
    -------
    Array
        Space-frame angular momentum (3,), kg m²/s.
    """
    R, pi = as_floats(R=(R, (3, 3)), pi=(pi, (3,)))
    return matmul(R, pi)


@as_one_program
def ortho_error(R: Float[ArrayLike, "3 3"]) -> Float[Array, ""]:
    r"""Distance from orthogonality: the Frobenius norm $\|R^T R - I\|_F$.

    Parameters
    ----------
    R
        Matrix (3, 3).

    Returns
    -------
    Array
        Error, scalar, dimensionless.
    """
    (R,) = as_floats(R=(R, (3, 3)))
    return jnp.linalg.norm(matmul(R.T, R) - jnp.eye(3, dtype=R.dtype))


@as_one_program
def determinant_error(R: Float[ArrayLike, "3 3"]) -> Float[Array, ""]:
    r"""Distance of the determinant from that of a rotation: $|\det R - 1|$.

    Parameters
    ----------
    R
        Matrix (3, 3).

    Returns
    -------
    Array
        Error, scalar, dimensionless; 2 for a reflection.
    """
    (R,) = as_floats(R=(R, (3, 3)))
    return jnp.abs(R[0] @ jnp.cross(R[1], R[2]) - 1)
