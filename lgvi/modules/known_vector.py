"""A vector of space or of the body that is known: constant, a function of time, or sampled."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from ..core.kernels.interpolation import interpolate
from ..core.typed_arrays import as_floats, made_of_jax
from .errors import error_if
from .fields import float_array, require_function, shaped_array

KnownVector = Float[Array, "3"] | Callable[[Array], Array]


class SampledVector(eqx.Module):
    """A vector that is known at some times: a function of time, linear between the samples.

    For arguments that may be a function of time, such as the field of a
    [`MagneticTorque`][lgvi.MagneticTorque], of a [`Magnetometer`][lgvi.Magnetometer], or the
    position in [`GravityGradient`][lgvi.GravityGradient]. Before the first sample and after the
    last the vector is that of the sample; `simulate` refuses torques beyond the times, and sensors
    take them.

    Parameters
    ----------
    t
        Times (samples,), s, increasing. Where a step ends at a sample, derivatives with respect
        to times are one-sided.
    values
        Vectors (samples, 3), a learnable leaf.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type, or times that are known and do not increase.
    """

    t: Float[Array, " samples"] = eqx.field(converter=float_array("t"))
    values: Float[Array, "samples 3"] = eqx.field(converter=float_array("values"))

    def __check_init__(self):
        require_samples(self.t, "values", self.values)
        if not isinstance(self.t, Tracer) and not np.all(np.diff(self.t) > 0):
            raise ValueError(f"Argument `t` must increase, but is {self.t}.")

    def __call__(self, t: Float[ArrayLike, ""]) -> Float[Array, "3"]:
        """The vector (3,) at a time, s."""
        return sample_at(self.t, self.values, t)


def sample_at(times: Array, values: Array, t: ArrayLike) -> Array:
    """The vector at a time, linear between the samples."""
    times, values, t = as_floats(
        times=(times, times.shape), values=(values, values.shape), t=(t, ())
    )
    return interpolate(times, values, t)


def require_samples(t: Array, name: str, values: Array) -> None:
    """Check the shapes of times and of vectors, one for each time."""
    if t.ndim != 1 or len(t) == 0:
        raise ValueError(f"Argument `t` must have shape (samples,), but its shape is {t.shape}.")
    if values.shape != (len(t), 3):
        raise ValueError(
            f"Argument `{name}` must have shape {(len(t), 3)}, an entry for each of `t`, but its "
            f"shape is {values.shape}."
        )


def values_during(
    kind: str, t: Array, values: Array, times: Callable[[], Array], throw: bool
) -> Array:
    """The values, checked: their times must increase, and cover the times of a simulation.

    Raises
    ------
    RuntimeError
        If `throw` and they do not. Otherwise the values are NaN.
    """
    needed = times()
    t, needed = as_floats(t=(t, t.shape), times=(needed, needed.shape))
    first, last = jnp.min(needed), jnp.max(needed)
    # What rounding may make of the time after many steps.
    margin = jnp.sqrt(jnp.finfo(t.dtype).eps) * (last - first)
    covered = (t[0] <= first + margin) & (last - margin <= t[-1])
    failed = ~(jnp.all(jnp.diff(t) > 0) & covered)
    if not throw:
        return jnp.where(failed, jnp.nan, values)

    def describe(t: np.ndarray, first: np.floating, last: np.floating) -> str:
        if not np.all(np.diff(t) > 0):
            index = int(np.argmin(np.diff(t) > 0))
            return (
                f"The times `t` of a `{kind}` must increase, but t[{index}] is {t[index]:.6g} "
                f"and t[{index + 1}] is {t[index + 1]:.6g}."
            )
        return (
            f"The times `t` of a `{kind}` must cover those of the trajectory, from "
            f"{first:.6g} to {last:.6g} s, but go from {t[0]:.6g} to {t[-1]:.6g} s."
        )

    return error_if(values, failed, describe, lambda: (t, first, last))


def sampled_during(vector: SampledVector, times: Callable[[], Array], throw: bool) -> SampledVector:
    """The vector for a simulation, checked as by `values_during`."""
    values = values_during("SampledVector", vector.t, vector.values, times, throw)
    return SampledVector(vector.t, values)


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
