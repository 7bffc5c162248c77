"""Checks of the arguments of an integrator, and the number of its steps."""

import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, ArrayLike

from ..core.checks import as_count, as_floats, as_tolerance, steps_of_torques
from ..core.trajectory.splitting import COMPOSITION_ORDERS
from .body import AbstractRigidBody


def as_static_tolerance(value: float | None) -> float | None:
    as_tolerance(value)
    return None if value is None else float(value)


def as_divisor(name: str, value: int, of: int) -> int:
    """Check a static count that divides the number `of` of steps."""
    count = as_count(name, value, 1)
    if of % count:
        raise ValueError(
            f"Argument `{name}` must divide the number of steps, which is {of}, but is {count}."
        )
    return count


def require_body(body: AbstractRigidBody) -> None:
    if not isinstance(body, AbstractRigidBody):
        raise TypeError(f"Argument `body` must be a body such as `RigidBody`, but is {body!r}.")


def inertia_of(body: AbstractRigidBody) -> Array:
    require_body(body)
    return body.inertia


def number_of_steps(
    steps: int | None, dt: Array, body_torques: ArrayLike | None, rotor: Array | None
) -> int:
    """The number of steps on which all arguments agree."""
    given = {}
    if steps is not None:
        given["`steps`"] = as_count("steps", steps, 0)
    if dt.ndim:
        given["the length of `dt`"] = dt.shape[0]
    if body_torques is not None:
        given["the length of `body_torques` less one"] = steps_of_torques(body_torques)
    if rotor is not None and rotor.ndim > 1:
        given["the length of `rotor_momentum`"] = rotor.shape[0]
    if not given:
        raise ValueError(
            "Argument `steps` must be given when neither `dt`, nor `body_torques`, nor "
            "`rotor_momentum` has one entry for each step, but it is None."
        )
    if len(set(given.values())) > 1:
        counts = ", ".join(f"{name} is {count}" for name, count in given.items())
        raise ValueError(f"The number of steps must be given consistently, but {counts}.")
    return next(iter(given.values()))


def as_start(t0: ArrayLike) -> Array:
    """An initial time, which must be finite where it is known."""
    (start,) = as_floats(t0=(t0, ()))
    if not isinstance(start, Tracer) and not jnp.isfinite(start):
        raise ValueError(f"Argument `t0` must be finite, but is {float(start)}.")
    return start


def times_of(start: Array, dt: Array, steps: int) -> Array:
    """The times of all states, or of the first and the last state."""
    moved = jnp.cumsum(dt) if dt.ndim else steps * dt[None]
    return jnp.append(start, start + moved)


def refuse_high_order(order: int, **given: ArrayLike | None) -> None:
    """Refuse arguments that are known at the ends of steps only, where a high order needs more."""
    for name, value in given.items():
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
