"""Convergence of the free motions of a trajectory."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from ..step.solution import SolverInfo, solver_info


class SolvedDrifts(NamedTuple):
    """Free motions, one or more for each step; all arrays begin with their number."""

    h: Array  # size
    pi: Array  # momentum (3,) at the start, less that of rotors
    residual_norm: Array
    rounding: Array  # residual norm that rounding can leave
    usable: Array  # whether the root is the right one, and an order above two is valid


class Failure(NamedTuple):
    """The first step that did not converge; the first step if all converged."""

    step: Array
    residual_norm: Array
    h: Array
    pi: Array  # momentum (3,) at the start of the step's rotation, less that of rotors


def assess_drifts(
    drifts: SolvedDrifts, steps: Array, tolerance: ArrayLike | None, finite: Array
) -> tuple[SolverInfo, Failure]:
    """Solver info of each drift, and the step, size and momentum of each for an error.

    `finite` (steps,) tells whether the states at the ends of the steps are.
    """
    h, pi, residual_norm, rounding, usable = jax.lax.stop_gradient(drifts)
    info = solver_info(residual_norm, rounding, tolerance)
    steps, finite = (jnp.repeat(x, len(h) // len(steps)) for x in (steps, finite))
    converged = info.converged & finite & usable
    failures = Failure(steps, jnp.where(finite, residual_norm, jnp.nan), h, pi)
    return info._replace(converged=converged), failures


def worst_info(info: SolverInfo, axis: int) -> SolverInfo:
    return SolverInfo(jnp.max(info.residual_norm, axis=axis), jnp.all(info.converged, axis=axis))


def first_failure(converged: Array, failures: Failure) -> Failure:
    """The first entry that did not converge; the first entry if all converged."""
    index = jnp.argmax(~converged)
    return jax.tree.map(lambda x: x[index], failures)
