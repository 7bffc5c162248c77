"""Sensors: what they would read of a state, and how far a reading is from it, in noise."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..core import so3
from ..core.checks import as_floats
from ..core.kernels.vectors import matmul
from .fields import float_array, require_shape
from .loss import AbstractLoss


class AttitudeSensor(eqx.Module):
    r"""A star tracker, camera or motion capture: attitudes with noise in the sensor's frame.

    It reads $R_\text{m} = R\,\operatorname{Exp}(a)\operatorname{Exp}(\sigma n)$ with standard
    normal $n$.

    Parameters
    ----------
    sigma
        Standard deviation of the noise about each axis of the sensor, rad: a scalar or (3,).
    alignment
        Rotation vector $a$ (3,) of the sensor's frame in the body's, rad, a learnable leaf; zero
        by default.
    time_offset
        How much later than its time stamps say the sensor reads, s: a learnable leaf if it starts
        from a number, such as 0.0. `None` is none, and costs nothing.
    loss
        A robust loss, such as [`Huber`][lgvi.Huber]. `None` is least squares.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    sigma: Float[Array, "*axes"]
    alignment: Float[Array, "3"]
    time_offset: Float[Array, ""] | None
    loss: AbstractLoss | None

    def __init__(
        self,
        sigma: Float[ArrayLike, "*axes"],
        alignment: Float[ArrayLike, "3"] | None = None,
        time_offset: Float[ArrayLike, ""] | None = None,
        loss: AbstractLoss | None = None,
    ):
        self.sigma = _as_axes("sigma", sigma)
        self.alignment = _vector("alignment", alignment, 0.0, self.sigma)
        self.time_offset = _optional_number("time_offset", time_offset)
        self.loss = _as_loss(loss)

    def predicted(self, R: Float[ArrayLike, "3 3"]) -> Float[Array, "3 3"]:
        r"""What it reads without noise (3, 3), $R\,\operatorname{Exp}(a)$, at an attitude."""
        R, a = as_floats(R=(R, (3, 3)), alignment=(self.alignment, (3,)))
        return matmul(R, so3.exp(a))

    def residual(
        self, R: Float[ArrayLike, "3 3"], measured: Float[ArrayLike, "3 3"]
    ) -> Float[Array, "3"]:
        r"""Whitened residual (3,), $\operatorname{Log}(R_\text{pred}^T R_\text{m})/\sigma$.

        Parameters
        ----------
        R
            Attitude (3, 3), body to space.
        measured
            What the sensor read (3, 3), sensor to space.

        Returns
        -------
        Array
            Residual (3,) in standard deviations, sensor frame.
        """
        predicted, measured = self.predicted(R), jnp.asarray(measured)
        error = so3.log(matmul(predicted.T, measured.astype(predicted.dtype)))
        return error / self.sigma.astype(error.dtype)


class Gyroscope(eqx.Module):
    r"""A rate gyroscope: angular velocities with bias, scale and noise.

    It reads $\omega_\text{m} = s\,\operatorname{Exp}(a)^T\omega + b + \sigma n$ with standard
    normal $n$.

    Parameters
    ----------
    sigma
        Standard deviation of the noise of each axis, rad/s: a scalar or (3,).
    bias
        What it reads at rest $b$ (3,), rad/s, a learnable leaf; zero by default.
    scale
        Scale factor $s$ of each axis (3,), a learnable leaf; one by default.
    alignment
        Rotation vector $a$ (3,) of the sensor's frame in the body's, rad, a learnable leaf; zero
        by default.
    time_offset
        How much later than its time stamps say the sensor reads, s: a learnable leaf if it starts
        from a number, such as 0.0. `None` is none, and costs nothing.
    loss
        A robust loss, such as [`Huber`][lgvi.Huber]. `None` is least squares.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    sigma: Float[Array, "*axes"]
    bias: Float[Array, "3"]
    scale: Float[Array, "3"]
    alignment: Float[Array, "3"]
    time_offset: Float[Array, ""] | None
    loss: AbstractLoss | None

    def __init__(
        self,
        sigma: Float[ArrayLike, "*axes"],
        bias: Float[ArrayLike, "3"] | None = None,
        scale: Float[ArrayLike, "3"] | None = None,
        alignment: Float[ArrayLike, "3"] | None = None,
        time_offset: Float[ArrayLike, ""] | None = None,
        loss: AbstractLoss | None = None,
    ):
        self.sigma = _as_axes("sigma", sigma)
        self.bias = _vector("bias", bias, 0.0, self.sigma)
        self.scale = _vector("scale", scale, 1.0, self.sigma)
        self.alignment = _vector("alignment", alignment, 0.0, self.sigma)
        self.time_offset = _optional_number("time_offset", time_offset)
        self.loss = _as_loss(loss)

    def predicted(self, omega: Float[ArrayLike, "3"]) -> Float[Array, "3"]:
        r"""What it reads without noise (3,), $s\,\operatorname{Exp}(a)^T\omega + b$, rad/s."""
        omega, a, s, b = as_floats(
            omega=(omega, (3,)),
            alignment=(self.alignment, (3,)),
            scale=(self.scale, (3,)),
            bias=(self.bias, (3,)),
        )
        return s * matmul(so3.exp(a).T, omega) + b

    def residual(
        self, omega: Float[ArrayLike, "3"], measured: Float[ArrayLike, "3"]
    ) -> Float[Array, "3"]:
        r"""Whitened residual (3,), $(\omega_\text{m} - \omega_\text{pred})/\sigma$.

        Parameters
        ----------
        omega
            Angular velocity (3,), body frame, rad/s.
        measured
            What the sensor read (3,), rad/s.

        Returns
        -------
        Array
            Residual (3,) in standard deviations, sensor frame.
        """
        predicted = self.predicted(omega)
        error = jnp.asarray(measured).astype(predicted.dtype) - predicted
        return error / self.sigma.astype(error.dtype)


def _optional_number(name: str, value: ArrayLike | None) -> Array | None:
    if value is None:
        return None
    value = float_array(name)(value)
    require_shape(name, value, ())
    return value


def _as_axes(name: str, value: ArrayLike) -> Array:
    value = float_array(name)(value)
    if value.shape not in ((), (3,)):
        raise ValueError(
            f"Argument `{name}` must have shape () or (3,), but its shape is {value.shape}."
        )
    return value


def _vector(name: str, value: ArrayLike | None, default: float, like: Array) -> Array:
    """A vector; that of defaults does not raise the precision."""
    value = jnp.full_like(like, default, shape=3) if value is None else float_array(name)(value)
    require_shape(name, value, (3,))
    return value


def _as_loss(loss: AbstractLoss | None) -> AbstractLoss | None:
    if not (loss is None or isinstance(loss, AbstractLoss)):
        raise TypeError(f"Argument `loss` must be None or a loss such as `Huber`, but is {loss!r}.")
    return loss
