"""The error that a step without a solution raises."""

from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core.trajectory.convergence import Failure
from .body import AbstractRigidBody
from .errors import error_if

Result = TypeVar("Result")


def raise_unless_converged(
    result: Result,
    converged: Array,
    body: AbstractRigidBody,
    failure: Failure,
) -> Result:
    """Return `result`, or raise for the first step that did not converge."""

    def values():
        turn = failure.h * jnp.linalg.solve(body.inertia, failure.pi)
        return failure.step, failure.residual_norm, jnp.linalg.norm(turn)

    return error_if(result, ~jnp.all(converged), _describe_unconverged, values)


def _describe_unconverged(step: np.integer, residual: np.floating, rotation: np.floating) -> str:
    start = (
        f"Step {step} did not converge: the norm of its discrete Moser-Veselov residual is "
        f"{residual:.3g} and |h J^-1 pi| is {rotation:.3g}"
    )
    if not (np.isfinite(residual) and np.isfinite(rotation)):
        return f"{start}. The state, the torques, `dt` or the inertia are not finite, or singular."
    cause = (
        ". Take a larger `newton_iters` or `tolerance`"
        if rotation < 0.8
        else ", which must stay below 1 for a solution to exist (1.57 for free motion of an "
        "order above 2 and for force gradients). Take a smaller `dt`"
    )
    return f"{start}{cause}; or use `throw=False` and look at `solver_info.converged`."
