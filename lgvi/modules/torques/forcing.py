"""What acts on a body in one simulation: a torque law taken apart, a controller, and checks."""

from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from ...core.checks import as_floats
from ...core.trajectory.kicks import Forcing
from ..body import AbstractRigidBody
from ..errors import error_if
from ..fields import require_function
from .base import ScaledTorque, Torque, TorqueSum, of_body
from .constant import ConstantTorque
from .damping import LinearDamping, QuadraticDamping
from .sampled import SampledTorque

Controller = Callable[[Array, Array, Array], ArrayLike]  # of t, R and pi


class _Same:
    """A value that is equal to nothing but itself, where it cannot be hashed."""

    def __init__(self, value: Any):
        self.value = self.key = value
        try:
            hash(value)
        except TypeError:
            self.key = id(value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


class _Function(eqx.Module):
    """Any function as a pytree of arrays, for `jax.jit`."""

    arrays: Any
    others: Any = eqx.field(static=True)

    def __init__(self, function: Callable[..., ArrayLike]):
        self.arrays, others = eqx.partition(function, _is_array)
        leaves, structure = jax.tree.flatten(others)
        self.others = tuple(map(_Same, leaves)), structure

    def __call__(self, *arguments: Array) -> ArrayLike:
        leaves, structure = self.others
        others = jax.tree.unflatten(structure, [leaf.value for leaf in leaves])
        return eqx.combine(self.arrays, others)(*arguments)


def _is_array(leaf):
    return isinstance(leaf, (jax.Array, np.ndarray, np.generic))


def forcing_of(
    torque: Torque | None,
    controller: Controller | None,
    body: AbstractRigidBody,
    order: int,
    times: Callable[[], Array],
    throw: bool,
) -> tuple[Forcing, bool]:
    """What acts on a body at some times, and whether it depends on nothing but time.

    Raises
    ------
    TypeError, ValueError
        If an argument is not a function, or does not go with the order.
    RuntimeError
        If `throw` and sampled torques do not cover the times, or their own do not increase.
    """
    if torque is not None:
        require_function("torque", torque, "t", "R")
    if controller is not None:
        require_function("controller", controller, "t", "R", "pi")
    laws, dampings, drags = [], [], []
    for factor, law in [] if torque is None else _terms(of_body(torque, body)):
        if order > 2 and isinstance(law, tuple(_WHY_ORDER_TWO)):
            raise ValueError(
                f"With a `{type(law).__name__}` `order` must be 2, but is {order}: "
                f"{_WHY_ORDER_TWO[type(law)]}."
            )
        if isinstance(law, LinearDamping):
            dampings.append(_product(factor, law.matrix))
            continue
        if isinstance(law, QuadraticDamping):
            matrix = law.matrix if law.matrix.ndim > 1 else jnp.diag(law.matrix)
            drags.append(_product(factor, matrix))
            continue
        law = _covering(law, times(), throw) if isinstance(law, SampledTorque) else law
        laws.append(law if factor is None else ScaledTorque(factor, law))
    prescribed = controller is None and not (dampings or drags) and all(map(_is_prescribed, laws))
    law = TorqueSum(tuple(laws)) if len(laws) > 1 else laws[0] if laws else None
    law, controller = (None if f is None else _Function(f) for f in (law, controller))
    return Forcing(law, controller, _sum(dampings), _sum(drags)), prescribed


_DAMPING = (
    "methods of a higher one go back in time too, where damping gains energy, or take the "
    "variation of a torque that depends on the attitude alone"
)
_WHY_ORDER_TWO = {
    LinearDamping: _DAMPING,
    QuadraticDamping: _DAMPING,
    SampledTorque: "linear interpolation has kinks at the samples",
}


def needs_order_two(torque: Torque) -> bool:
    """Whether a law is one, or has one among its terms, for which `order` must be 2."""
    return any(isinstance(law, tuple(_WHY_ORDER_TWO)) for _, law in _terms(torque))


def _terms(torque: Torque, factor: Array | None = None) -> Iterator[tuple[Array | None, Torque]]:
    """Laws of which a torque is the sum, and their factors."""
    if isinstance(torque, TorqueSum):
        for term in torque.terms:
            yield from _terms(term, factor)
    elif isinstance(torque, ScaledTorque):
        of_term = torque.factor if factor is None else _product(factor, torque.factor)
        yield from _terms(torque.torque, of_term)
    else:
        yield factor, torque


def _sum(matrices: list[Array]) -> Array | None:
    if not matrices:
        return None
    first, *others = as_floats(**{f"matrix {i}": (D, (3, 3)) for i, D in enumerate(matrices)})
    return sum(others, start=first)


def _is_prescribed(law: Torque) -> bool:
    return isinstance(law, (ConstantTorque, SampledTorque)) and law.frame == "body"


def _product(factor: Array | None, value: Array) -> Array:
    if factor is None:
        return value
    factor, value = as_floats(factor=(factor, ()), value=(value, value.shape))
    return factor * value


def _covering(law: SampledTorque, times: Array, throw: bool) -> SampledTorque:
    """The law, checked to be given at increasing times that reach over the trajectory's.

    If it is not, that raises, or it becomes one that is no number.
    """
    t, times = as_floats(t=(law.t, law.t.shape), times=(times, times.shape))
    first, last = jnp.min(times), jnp.max(times)
    # What rounding may make of the time after many steps.
    margin = jnp.sqrt(jnp.finfo(t.dtype).eps) * (last - first)
    covered = (t[0] <= first + margin) & (last - margin <= t[-1])
    failed = ~(jnp.all(jnp.diff(t) > 0) & covered)
    if throw:
        torque = error_if(law.torque, failed, _describe_samples, lambda: (t, first, last))
    else:
        torque = jnp.where(failed, jnp.nan, law.torque)
    return SampledTorque(law.t, torque, law.frame)


def _describe_samples(t: np.ndarray, first: np.floating, last: np.floating) -> str:
    if not np.all(np.diff(t) > 0):
        index = int(np.argmin(np.diff(t) > 0))
        return (
            f"The times `t` of a `SampledTorque` must increase, but t[{index}] is {t[index]:.6g} "
            f"and t[{index + 1}] is {t[index + 1]:.6g}."
        )
    return (
        "The times `t` of a `SampledTorque` must cover those of the trajectory, from "
        f"{first:.6g} to {last:.6g} s, but go from {t[0]:.6g} to {t[-1]:.6g} s."
    )
