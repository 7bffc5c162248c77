"""The error that a step without a solution raises."""

from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..core.trajectory import Failure
from .body import AbstractRigidBody
from .failures import error_if

Result = TypeVar("Result")


def raise_unless_converged(
    result: Result,
    converged: Array,
    body: AbstractRigidBody,
    failure: Failure,
) -> Result:
    """Return `result`, or raise for the first step that did not converge."""

    def values():
        turn = failure.h * body.angular_velocity(failure.pi)
        return failure.step, failure.residual_norm, jnp.linalg.norm(turn)

    return error_if(result, ~jnp.all(converged), _describe_unconverged, values)


def _describe_unconverged(step: np.generic, residual: np.generic, rotation: np.generic) -> str:
    start = (
        f"Step {step} did not converge: the norm of its discrete Moser-Veselov residual is "
        f"{residual:.3g} and |h J^-1 pi| is {rotation:.3g}"
    )
    if not (np.isfinite(residual) and np.isfinite(rotation)):
        return f"{start}. The state, the torques, `dt` or the inertia are not finite, or singular."
    return (
        f"{start}, which must stay below 1 for a solution to exist. Take a smaller `dt`; if "
        "|h J^-1 pi| is well below 1, a larger `newton_iters` or `tolerance`; or use "
        "`throw=False` and look at `solver_info.converged`."
    )
