"""Sensors: what they would read of a state, and how far a reading is from it, in noise."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..core import so3
from ..core.checks import as_floats
from ..core.components import matmul
from .fields import float_array, require_shape


class AbstractLoss(eqx.Module):
    r"""A robust loss $\rho(s)$ of the squared length $s = |r|^2$ of a whitened residual.

    It equals $s$ for small residuals and grows slower for large ones, so that a few readings that
    are far off do not decide the fit.
    """

    @abstractmethod
    def __call__(self, s: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
        r"""The loss $\rho(s)$."""

    @abstractmethod
    def weight(self, s: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
        r"""The weight $\rho'(s)$ of a residual, 1 for small ones."""


class Huber(AbstractLoss):
    r"""Huber's loss: $s$ up to $|r| = k$, then $2k|r| - k^2$, which is linear in the length.

    Parameters
    ----------
    threshold
        $k$, in standard deviations, positive, static.

    References
    ----------
    P. J. Huber, "Robust estimation of a location parameter", Ann. Math. Statist. 35 (1964),
    doi:10.1214/aoms/1177703732.
    """

    threshold: float = eqx.field(
        default=3.0, static=True, converter=lambda value: _as_threshold(value)
    )

    def __call__(self, s: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
        r"""The loss $\rho(s)$."""
        s, k = jnp.asarray(s), self.threshold
        within = s <= k**2
        return jnp.where(within, s, 2 * k * jnp.sqrt(jnp.where(within, 1, s)) - k**2)

    def weight(self, s: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
        r"""The weight $\rho'(s) = \min(1, k/|r|)$."""
        s, k = jnp.asarray(s), self.threshold
        within = s <= k**2
        return jnp.where(within, 1, k / jnp.sqrt(jnp.where(within, 1, s)))


class Cauchy(AbstractLoss):
    r"""Cauchy's loss $k^2\log(1 + s/k^2)$: far readings hardly count.

    Parameters
    ----------
    threshold
        $k$, in standard deviations, positive, static.

    References
    ----------
    P. W. Holland, R. E. Welsch, "Robust regression using iteratively reweighted least-squares",
    Commun. Stat. Theory Methods 6 (1977), doi:10.1080/03610927708827533.
    """

    threshold: float = eqx.field(
        default=3.0, static=True, converter=lambda value: _as_threshold(value)
    )

    def __call__(self, s: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
        r"""The loss $\rho(s)$."""
        return self.threshold**2 * jnp.log1p(jnp.asarray(s) / self.threshold**2)

    def weight(self, s: Float[ArrayLike, "*shape"]) -> Float[Array, "*shape"]:
        r"""The weight $\rho'(s) = 1/(1 + s/k^2)$."""
        return 1 / (1 + jnp.asarray(s) / self.threshold**2)


class AttitudeSensor(eqx.Module):
    r"""A star tracker, camera or motion capture: attitudes with noise in the sensor's frame.

    It reads $R_\text{m} = R\,\operatorname{Exp}(a)\operatorname{Exp}(\sigma n)$ with standard
    normal $n$.

    Parameters
    ----------
    sigma
        Standard deviation of the noise about each axis of the sensor, rad: a scalar or (3,).
    alignment
        Rotation vector $a$ (3,) of the sensor's frame in the body's, rad, a learnable leaf.
    time_offset
        How much later than its time stamps say the sensor reads, s, a learnable leaf. `None` is
        none, and costs nothing.
    loss
        A robust loss, such as [`Huber`][lgvi.Huber]. `None` is least squares.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    sigma: Float[Array, "*axes"] = eqx.field(converter=float_array("sigma"))
    alignment: Float[Array, "3"] = eqx.field(
        default=(0.0, 0.0, 0.0), converter=float_array("alignment")
    )
    time_offset: Float[Array, ""] | None = eqx.field(
        default=None, converter=lambda value: _optional_number("time_offset", value)
    )
    loss: AbstractLoss | None = None

    def __check_init__(self):
        _require_axes("sigma", self.sigma)
        require_shape("alignment", self.alignment, (3,))
        _require_loss(self.loss)

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
        What it reads at rest $b$ (3,), rad/s, a learnable leaf.
    scale
        Scale factor $s$ of each axis (3,), a learnable leaf.
    alignment
        Rotation vector $a$ (3,) of the sensor's frame in the body's, rad, a learnable leaf.
    time_offset
        How much later than its time stamps say the sensor reads, s, a learnable leaf. `None` is
        none, and costs nothing.
    loss
        A robust loss, such as [`Huber`][lgvi.Huber]. `None` is least squares.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    sigma: Float[Array, "*axes"] = eqx.field(converter=float_array("sigma"))
    bias: Float[Array, "3"] = eqx.field(default=(0.0, 0.0, 0.0), converter=float_array("bias"))
    scale: Float[Array, "3"] = eqx.field(default=(1.0, 1.0, 1.0), converter=float_array("scale"))
    alignment: Float[Array, "3"] = eqx.field(
        default=(0.0, 0.0, 0.0), converter=float_array("alignment")
    )
    time_offset: Float[Array, ""] | None = eqx.field(
        default=None, converter=lambda value: _optional_number("time_offset", value)
    )
    loss: AbstractLoss | None = None

    def __check_init__(self):
        _require_axes("sigma", self.sigma)
        for name in ("bias", "scale", "alignment"):
            require_shape(name, getattr(self, name), (3,))
        _require_loss(self.loss)

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


def _as_threshold(value: float) -> float:
    as_floats(threshold=(value, ()))  # raises for what is no number
    if not float(value) > 0:
        raise ValueError(f"Argument `threshold` must be positive, but is {value!r}.")
    return float(value)


def _optional_number(name: str, value: ArrayLike | None) -> Array | None:
    if value is None:
        return None
    value = float_array(name)(value)
    require_shape(name, value, ())
    return value


def _require_axes(name: str, value: Array) -> None:
    if value.shape not in ((), (3,)):
        raise ValueError(
            f"Argument `{name}` must have shape () or (3,), but its shape is {value.shape}."
        )


def _require_loss(loss: AbstractLoss | None) -> None:
    if not (loss is None or isinstance(loss, AbstractLoss)):
        raise TypeError(f"Argument `loss` must be None or a loss such as `Huber`, but is {loss!r}.")
