"""A vector of space or of the body that a sensor knows, perhaps as a function of time."""

from collections.abc import Callable

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from ...core.typed_arrays import as_floats, made_of_jax
from ..fields import require_function, shaped_array

KnownVector = Float[Array, "3"] | Callable[[Array], Array]


def as_known_vector(name: str, value: ArrayLike | Callable[[Array], Array]) -> KnownVector:
    """A vector (3,) as an array, or a function of time as it is.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type, naming the field.
    """
    if callable(value):
        require_function(name, value, ("t",))
        return value
    return shaped_array(name, value, (3,))


def require_direction(name: str, vector: KnownVector) -> None:
    """Check that a vector whose values are known is finite and not zero."""
    if callable(vector) or isinstance(vector, Tracer):
        return
    if not (np.all(np.isfinite(vector)) and np.any(np.asarray(vector) != 0)):
        raise ValueError(f"Argument `{name}` must be finite and not zero, but is {vector}.")


def known_vector_at(name: str, vector: KnownVector, t: Array) -> Array:
    """The vector (3,) at a time."""
    if not callable(vector):
        return vector
    with made_of_jax(name):
        value = vector(t)
    (known,) = as_floats(**{f"{name}(t)": (value, (3,))})
    return known


def known_vectors(name: str, vector: KnownVector, t: np.ndarray) -> np.ndarray:
    """The vectors (samples, 3) at some times."""
    if not callable(vector):
        return np.tile(np.asarray(vector, float), (len(t), 1))
    if not len(t):
        return np.zeros((0, 3))
    # Lengths are powers of two, so that one program serves many.
    padded = t[np.arange(2 ** (len(t) - 1).bit_length()) % len(t)]
    dtype = jax.dtypes.canonicalize_dtype(float)
    vectors = jax.vmap(lambda t: known_vector_at(name, vector, t))(padded.astype(dtype))
    return np.asarray(vectors, float)[: len(t)]
