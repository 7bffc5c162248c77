"""Checks that a matrix, or moments and axes, can belong to a rigid body; in `jax.jit` too."""

from collections.abc import Sequence
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..core.inertia import inertia_from_principal_moments, log_cholesky_from_inertia
from ..core.kernels.matrix_properties import is_symmetric
from ..core.kernels.vectors import matmul
from ..core.typed_arrays import as_floats, as_one_program
from .errors import error_if


def checked_coordinates(inertia: ArrayLike, argument: str = "inertia") -> Array:
    """Log-Cholesky coordinates of the inertia of a body, which an argument gives."""
    (inertia,) = as_floats(inertia=(inertia, (3, 3)))
    coordinates, failed = _coordinates(inertia)
    describe = partial(_describe_unphysical, argument)
    return error_if(coordinates, failed, describe, lambda: (inertia,))


def checked_inertia(moments: ArrayLike | Sequence[ArrayLike], axes: ArrayLike | None) -> Array:
    """The inertia of principal moments and axes, which are checked."""
    inertia = inertia_from_principal_moments(moments, axes)
    (moments,) = as_floats(moments=(moments, (3,)))
    inertia = error_if(
        inertia,
        _not_positive(moments),
        lambda moments: f"Argument `moments` must be positive and finite, but is {moments}.",
        lambda: (moments,),
    )
    if axes is None:
        return inertia
    (axes,) = as_floats(axes=(axes, (3, 3)))
    return error_if(
        inertia,
        _not_orthonormal(axes),
        lambda axes: (
            "Argument `axes` must be orthogonal, its columns the unit principal axes, "
            f"but is {axes.tolist()}."
        ),
        lambda: (axes,),
    )


@as_one_program
def _coordinates(inertia: Array) -> tuple[Array, Array]:
    """Log-Cholesky coordinates, and whether the inertia is not that of a body."""
    coordinates = log_cholesky_from_inertia(inertia)
    return coordinates, ~jnp.all(jnp.isfinite(coordinates)) | ~is_symmetric(inertia)


@as_one_program
def _not_positive(moments: Array) -> Array:
    return ~jnp.all((moments > 0) & jnp.isfinite(moments))


@as_one_program
def _not_orthonormal(axes: Array) -> Array:
    defect = jnp.max(jnp.abs(matmul(axes.T, axes) - jnp.eye(3, dtype=axes.dtype)))
    return ~(defect <= jnp.finfo(axes.dtype).eps ** 0.5)


def _describe_unphysical(argument: str, J: np.ndarray) -> str:
    if not np.all(np.isfinite(J)):
        return f"Argument `{argument}` must be finite, but is {J.tolist()}."
    if not is_symmetric(J):
        return f"Argument `{argument}` must be symmetric, but is {J.tolist()}."
    smallest, middle, largest = moments = np.linalg.eigvalsh(J)
    moments = ", ".join(f"{moment:.6g}" for moment in moments)
    if smallest <= 0:
        return (
            f"Argument `{argument}` must be positive definite, but the principal moments are "
            f"{moments}: {smallest:.6g} is not positive."
        )
    return (
        f"Argument `{argument}` must satisfy the triangle inequality of a rigid body strictly, "
        f"but the principal moments are {moments}: {smallest:.6g} + {middle:.6g} = "
        f"{smallest + middle:.6g} does not exceed {largest:.6g}."
    )
