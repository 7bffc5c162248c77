"""The torques of one simulation: the parts of a torque law, a controller, and checks."""

from collections.abc import Callable

from jaxtyping import Array, ArrayLike

from ...core.trajectory.kicks import Forcing
from ...core.typed_arrays import as_floats
from ..body import AbstractRigidBody
from ..fields import require_function
from ..function_of_arrays import FunctionOfArrays
from .law import (
    AbstractTorque,
    ScaledTorque,
    Torque,
    TorqueSum,
    as_law,
    multiply,
    require_arguments,
)

Controller = Callable[[Array, Array, Array], ArrayLike]  # of t, R and pi


def forcing_of(
    torque: Torque | None,
    controller: Controller | None,
    body: AbstractRigidBody,
    order: int,
    times: Callable[[], Array],
    throw: bool,
) -> tuple[Forcing, bool]:
    """The torques on a body at some times, and whether they depend on time alone.

    Raises
    ------
    TypeError, ValueError
        If an argument is not a function, or does not go with the order.
    RuntimeError
        If `throw` and sampled torques do not cover the times, or their own do not increase.
    """
    if controller is not None:
        require_function("controller", controller, ("t", "R", "pi"))
    of_attitude: list[AbstractTorque] = []
    of_rate: list[AbstractTorque] = []
    damping: list[Array] = []
    drag: list[Array] = []
    prescribed = controller is None
    for factor, law in () if torque is None else as_law("torque", torque).of_body(body).summands():
        require_arguments(law)
        highest = min(law.highest_order, 2) if law.depends_on_rate else law.highest_order
        if order > highest:
            raise ValueError(
                f"With a `{law._kind}` `order` must be at most {highest}, but is "
                f"{order}: {law.reason_for_highest_order}."
            )
        prescribed &= not (law.depends_on_attitude or law.depends_on_rate)
        if law.linear_damping is not None or law.quadratic_damping is not None:
            damping += _scaled(factor, law.linear_damping)
            drag += _scaled(factor, law.quadratic_damping)
            continue
        law = law.during(times, throw)
        law = law if factor is None else ScaledTorque(factor, law)
        (of_rate if law.depends_on_rate else of_attitude).append(law)
    functions = *map(_together, (of_attitude, of_rate)), controller
    law, rate_law, controller = (None if f is None else FunctionOfArrays(f) for f in functions)
    return Forcing(law, rate_law, controller, _sum(damping), _sum(drag)), prescribed


def _scaled(factor: Array | None, matrix: Array | None) -> list[Array]:
    """The product of a factor, or one, and a matrix, if there is one."""
    if matrix is None:
        return []
    return [matrix if factor is None else multiply(factor, "matrix", matrix, (3, 3))]


def _together(laws: list[AbstractTorque]) -> AbstractTorque | None:
    return TorqueSum(tuple(laws)) if len(laws) > 1 else laws[0] if laws else None


def _sum(matrices: list[Array]) -> Array | None:
    if not matrices:
        return None
    first, *others = as_floats(**{f"matrix {i}": (D, (3, 3)) for i, D in enumerate(matrices)})
    return sum(others, start=first)
