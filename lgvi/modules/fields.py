"""Fields of modules: learnable leaves are floating-point arrays of a known shape."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from ..core.checks import Shape


def float_array(value: ArrayLike) -> Array:
    """Field converter: numbers, lists and integer arrays become floating-point arrays."""
    array = jnp.asarray(value)
    return array if jnp.issubdtype(array.dtype, jnp.inexact) else array.astype(float)


def require_shape(name: str, value: Array, shape: Shape) -> None:
    """Check a field; values are never checked, so that modules can be built under vmap.

    Raises
    ------
    ValueError
        If the shape is another, naming the field, the shape it must have and the one it had.
    """
    if value.shape != shape:
        raise ValueError(
            f"Argument `{name}` must have shape {shape}, but its shape is {value.shape}."
        )
