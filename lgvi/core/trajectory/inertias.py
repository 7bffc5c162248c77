r"""Inertias of steps: one for all steps, one for each, or sums $J_k = \sum_i f_{ki} M_i$.

Modified inertias of steps of several sizes are such sums of three matrices. Their derivatives are
then three numbers for each step, where those of matrices are nine.

All arrays may have batch axes at the end. All matrices are symmetric. Without sums there are no
factors, (0, 0), and the matrices are the inertias, (1, 3, 3) or (steps, 3, 3).
"""

from functools import reduce
from operator import add

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.primitives import Arrays
from ..kernels.vectors import Mat3, Vec3


def rates_of(J: Array, momenta: Array) -> Array:
    """Angular velocities (..., 3) of momenta (..., 3), by one inertia or many (..., 3, 3)."""
    trace = jnp.trace(J, axis1=-2, axis2=-1)  # or the determinant of a small body would underflow
    return (Mat3.of(J / trace[..., None, None]).inverse() @ (Vec3.of(momenta) / trace)).array()


def of_steps(matrices: Array, factors: Array) -> Array:
    """The inertias (steps, 3, 3), or one (1, 3, 3), with matrices (n, 3, 3), factors (steps, n)."""
    if len(factors) == 0:
        return matrices
    return jnp.sum(jnp.expand_dims(factors, (2, 3)) * matrices[None], axis=1)


def over_trace(J: Array, *arrays: Array) -> list[Array]:
    """Arrays of one entry, or of each step, over the traces of the inertias of the steps.

    The Rodrigues vector is the same for an inertia and a step size divided by one number, so that
    number is not differentiated.
    """
    trace = jax.lax.stop_gradient(jnp.trace(J, axis1=1, axis2=2))
    return [x / jnp.expand_dims(trace, range(1, 1 + x.ndim - trace.ndim)) for x in arrays]


def changes_of_steps(
    J: Array, matrices: Array, factors: Array, dmatrices: Array, dfactors: Array
) -> Arrays:
    """Arrays of steps for `times_change`, of unit trace where the inertias are `J`."""
    if len(factors) == 0:
        return [six(*over_trace(J, dmatrices))]
    sixes = (six(x)[None] for x in (matrices, dmatrices))
    return [*over_trace(J, factors, dfactors), *sixes]


def times_change(dJ: Arrays, vectors: Vec3) -> Vec3:
    """The changes of the inertias of all steps times vectors of the steps."""
    if len(dJ) == 1:
        return Mat3.of_six(dJ[0], axis=1) @ vectors
    terms = []
    for i in range(dJ[0].shape[1]):
        factor, dfactor, matrix, dmatrix = (x[:, i] for x in dJ)
        terms.append(dfactor * (Mat3.of_six(matrix, axis=1) @ vectors))
        terms.append(factor * (Mat3.of_six(dmatrix, axis=1) @ vectors))
    return reduce(add, terms)


def cotangents_of_inertias(J_bar: Array, matrices: Array, factors: Array) -> tuple[Array, Array]:
    """Cotangents of matrices and factors, from those of the inertias of all steps."""
    J_bar = (J_bar + jnp.swapaxes(J_bar, 1, 2)) / 2
    if len(factors) == 0:
        J_bar = jnp.sum(J_bar, axis=0, keepdims=True) if len(matrices) == 1 else J_bar
        return J_bar, jnp.zeros((0, 0, *J_bar.shape[3:]), J_bar.dtype)
    by_factor = jnp.expand_dims(factors, (2, 3)) * J_bar[:, None]
    by_matrix = matrices[None] * J_bar[:, None]
    return jnp.sum(by_factor, axis=0), jnp.sum(by_matrix, axis=(2, 3))


def six(J: Array) -> Array:
    """The six numbers (n, 6) of the symmetric parts of matrices (n, 3, 3)."""
    return Mat3.of((J + jnp.swapaxes(J, 1, 2)) / 2, axis=1).six(axis=1)
