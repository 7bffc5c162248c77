"""Whether a body can move as it was asked to, and the error if it cannot."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ..core.kernels.matrix_properties import (
    determinant,
    is_positive_definite,
    is_rotation,
    is_symmetric,
)
from ..core.trajectory.convergence import Failure
from ..core.typed_arrays import as_one_program
from .body import AbstractRigidBody
from .errors import error_if

Result = TypeVar("Result")


@as_one_program
def is_possible(R: ArrayLike, J: ArrayLike) -> Array:
    """Whether a first attitude is a rotation, and inertias symmetric and positive definite.

    `J` is (3, 3) or (steps, 3, 3).
    """
    # Else XLA would compute it anew for every step that it is compared with.
    return jax.lax.optimization_barrier(_is_attitude(R) & jnp.all(_are_inertias(J)))


def attitude_tolerance(dtype: Any) -> float:
    """How far an entry of R^T R - I may be from zero."""
    return 1e-6 if jnp.dtype(dtype).itemsize > 4 else 1e-3  # products in float32 are off by more


def _is_attitude(R):
    return is_rotation(R, attitude_tolerance(R.dtype))


def _are_inertias(J):
    J = J if J.ndim == 2 else J.T.swapaxes(0, 1)  # (3, 3) or (3, 3, steps)
    return is_symmetric(J) & is_positive_definite(J)


def raise_unless_converged(
    result: Result,
    converged: Array,
    body: AbstractRigidBody,
    attitude: tuple[str, ArrayLike],
    first_failure: Callable[[], Failure | None],
    shorter_steps: str,
) -> Result:
    """Return `result`, or raise for the first step that did not converge.

    `attitude` is the name of the argument that is the first attitude, and its value. Without steps
    there is no failure, and only the first state can be wrong. `shorter_steps` says how the caller
    asks for them.
    """
    name, R = attitude

    def describe(R: np.ndarray, J: np.ndarray, *of_step: Any) -> str:
        impossible = describe_impossible(name, R, J)
        if impossible is None and J.ndim > 2:
            J = J[of_step[0]]
        return impossible or _describe_step(shorter_steps, J, *of_step)

    def values():
        return jnp.asarray(R), body.inertia, *(first_failure() or ())

    return error_if(result, ~converged, describe, values)


def describe_impossible(name: str, R: np.ndarray, J: np.ndarray) -> str | None:
    """Why the argument of that name is no attitude, or an inertia is not one; else None.

    `J` is (3, 3) or (steps, 3, 3).
    """
    return _describe_attitude(name, R) or _describe_inertia(J)


def _describe_attitude(name: str, R: np.ndarray) -> str | None:
    if _is_attitude(R):
        return None
    error, det = np.max(np.abs(R.T @ R - np.eye(3))), determinant(R)
    message = (
        f"Argument `{name}` must be a rotation matrix, but is {R.tolist()}: the largest entry of "
        f"R^T R - I is {error:.2g} and the determinant is {det:.6g}."
    )
    if error < 1e-3 and det > 0:
        message += " `so3.wxyz_to_matrix(so3.matrix_to_wxyz(R))` takes such an error away."
    return message


def _describe_inertia(J: np.ndarray) -> str | None:
    with np.errstate(invalid="ignore"):  # zero divided by its trace
        are_right = _are_inertias(J)
    if np.all(are_right):
        return None
    where = ""
    if J.ndim > 2:
        step = int(np.argmin(are_right))
        J, where = J[step], f" in step {step}"
    moments = ""
    if np.all(np.isfinite(J)):
        listed = ", ".join(f"{moment:.6g}" for moment in np.linalg.eigvalsh((J + J.T) / 2))
        moments = f" with the principal moments {listed}"
    return (
        f"The inertia of the body must be symmetric and positive definite, but{where} is "
        f"{J.tolist()}{moments}."
    )


def _describe_step(
    shorter_steps: str,
    J: np.ndarray,
    step: np.integer,
    residual: np.floating,
    h: np.floating,
    pi: np.ndarray,
) -> str:
    with np.errstate(all="ignore"):  # the momentum may not be finite
        rotation = np.linalg.norm(h * np.linalg.solve(J, pi))
    start = (
        f"Step {step} did not converge: the norm of its discrete Moser-Veselov residual is "
        f"{residual:.3g} and |h J^-1 pi| is {rotation:.3g}"
    )
    if not (np.isfinite(residual) and np.isfinite(rotation)):
        if not np.isfinite(h):
            return f"{start}. `dt` is not finite: {h}."
        if not np.all(np.isfinite(pi)):
            return f"{start}. The first momentum, or a torque until then, is not finite: {pi}."
        return f"{start}. The state at its end is not finite, by a torque or by overflow."
    cause = (
        f". Take {shorter_steps}, or a larger `newton_iters` or `tolerance`"
        if rotation < 0.8
        else ", which must stay below 1 for a solution to exist (1.57 for free motion of an "
        f"order above 2 and for force gradients). Take {shorter_steps}"
    )
    if rotation > 1:
        cause += " (and check that rates are in rad/s, not in degrees/s)"
    return f"{start}{cause}; or use `throw=False` and look at `solver_info.converged`."
