"""Checks of arguments, most of them of an integrator."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from ..core.trajectory.splitting import COMPOSITION_ORDERS
from ..core.typed_arrays import as_floats, as_tolerance
from .body import AbstractRigidBody
from .gyrostat import Gyrostat
from .varying_body import VaryingRigidBody


def require_instance(name: str, value: Any, kind: type) -> None:
    if not isinstance(value, kind):
        # An array, or a module of many leaves, would fill the screen.
        was = repr(value)
        was = was if len(was) < 80 else f"of the type `{type(value).__name__}`"
        raise TypeError(f"Argument `{name}` must be `{kind.__name__}`, but is {was}.")


def as_static_tolerance(value: float | None) -> float | None:
    as_tolerance(value)
    return None if value is None else float(value)


def require_body(body: AbstractRigidBody) -> None:
    if not isinstance(body, AbstractRigidBody):
        raise TypeError(f"Argument `body` must be a body such as `RigidBody`, but is {body!r}.")


def inertia_of(body: AbstractRigidBody) -> Array:
    """The inertia (3, 3) of a body."""
    require_body(body)
    if isinstance(body, VaryingRigidBody):
        raise ValueError(
            "Argument `body` must have one inertia here, but a `VaryingRigidBody` has one for each "
            "step: `RigidBody(body.inertia[k])` is the body in a step."
        )
    inertia = body.inertia
    if jnp.ndim(inertia) > 2:
        raise ValueError(
            "Argument `body` must have one inertia (3, 3), but its shape is "
            f"{jnp.shape(inertia)}: use `jax.vmap` for batches."
        )
    return inertia


def first_momentum(
    body: AbstractRigidBody, pi0: ArrayLike | None, omega0: ArrayLike | None
) -> ArrayLike:
    """The initial momentum, which is given, or that of the initial angular velocity."""
    if omega0 is None and pi0 is not None:
        return pi0
    if omega0 is None or pi0 is not None:
        raise TypeError(
            "One of the arguments `pi0` and `omega0` must be given, but "
            f"{'none is' if omega0 is None else 'both are'}."
        )
    if isinstance(body, VaryingRigidBody):
        raise ValueError(
            "Argument `pi0` must be given for a body whose inertia varies, as the inertia at the "
            "start is not that of the first step; but `omega0` is."
        )
    if body.rotor_momentum is not None and body.rotor_momentum.ndim > 1:
        body = Gyrostat(body.inertia, body.rotor_momentum[0])
    return body.angular_momentum(as_floats(omega0=(omega0, (3,)))[0])


def refuse_high_order(order: int, **arguments: ArrayLike | None) -> None:
    """Refuse arguments that are known at the ends of steps only, where a high order needs more."""
    for name, value in arguments.items():
        if value is not None and order > 2:
            raise ValueError(
                f"Argument `{name}` needs an integrator of order 2, but `order` is {order}: a "
                "higher order needs values between the ends of a step too."
            )


def require_composition(order: int) -> None:
    if order not in COMPOSITION_ORDERS:
        raise ValueError(
            "With a torque, a controller or rotors `order` must be one of "
            f"{COMPOSITION_ORDERS}, but is {order}."
        )
