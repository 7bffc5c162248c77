"""How the free motions of a trajectory were solved."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from . import components as xyz
from .moser_veselov import SolverInfo, solver_info


class Drifts(NamedTuple):
    """Free motions, one or more for each step; all arrays begin with their number."""

    trace: Array  # of the inertia
    h: Array  # size
    pi: Array  # momentum (3,) at the start
    c: Array  # Rodrigues vector (3,)
    residual_norm: Array


class Failure(NamedTuple):
    """The first step that did not converge (the first of all, where all did)."""

    step: Array
    residual_norm: Array
    h: Array
    pi: Array  # momentum (3,) at the start of the step's rotation


def outcome(
    drifts: Drifts, steps: Array, tolerance: ArrayLike | None
) -> tuple[SolverInfo, Failure]:
    """Solver info of each drift, and each as a failure of one of the `steps`."""
    trace, h, pi, c, residual_norm = jax.lax.stop_gradient(drifts)
    info = solver_info(residual_norm, jnp.abs(trace), xyz.split(c), tolerance)
    number = jnp.repeat(steps, len(h) // max(len(steps), 1))
    return info, Failure(number, residual_norm, h, pi)


def worst(info: SolverInfo, axis: int) -> SolverInfo:
    return SolverInfo(jnp.max(info.residual_norm, axis=axis), jnp.all(info.converged, axis=axis))


def first(converged: Array, failures: Failure) -> Failure:
    """The first that did not converge; the first of all, where all did."""
    index = jnp.argmax(~converged)
    return jax.tree.map(lambda x: x[index], failures)
