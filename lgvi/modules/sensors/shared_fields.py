"""Fields that sensors share: converters and checks."""

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike

from ..fields import float_array, require_shape, shaped_array
from ..loss import AbstractLoss


def vector_or_default(name: str, value: ArrayLike | None, default: float, like: Array) -> Array:
    """A vector (3,); a default takes the precision of another field.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type, naming the field.
    """
    value = jnp.full_like(like, default, shape=3) if value is None else float_array(name)(value)
    require_shape(name, value, (3,))
    return value


def as_sigma(value: ArrayLike) -> Array:
    """A standard deviation, for all three axes or for each."""
    value = float_array("sigma")(value)
    if value.shape not in ((), (3,)):
        raise ValueError(
            f"Argument `sigma` must have shape () or (3,), but its shape is {value.shape}."
        )
    if not isinstance(value, Tracer) and not np.all(np.asarray(value) >= 0):
        raise ValueError(f"Argument `sigma` must be at least 0, but is {value}.")
    return value


def as_time_offset(value: ArrayLike | None) -> Array | None:
    """A number, or None."""
    if value is None:
        return None
    return shaped_array("time_offset", value, ())


def as_loss(loss: AbstractLoss | None) -> AbstractLoss | None:
    """A loss, or None."""
    if not (loss is None or isinstance(loss, AbstractLoss)):
        raise TypeError(f"Argument `loss` must be None or a loss such as `Huber`, but is {loss!r}.")
    return loss
