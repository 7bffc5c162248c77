"""Sensors of angular velocities."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ...core import so3
from ...core.checks import as_floats
from ...core.kernels.vectors import matmul
from ..fields import described_by, float_array, require_shape
from ..loss import AbstractLoss
from .base import AbstractSensor, MotionState
from .fields import as_loss, as_sigma, as_time_offset, vector_or_default


class Gyroscope(AbstractSensor):
    r"""A rate gyroscope: angular velocities with bias, scale and noise.

    It reads $\omega_\text{m} = s\,\operatorname{Exp}(a)^T\omega + b + \sigma n$ with standard
    normal $n$. With a matrix of scales it reads $S\,\operatorname{Exp}(a)^T\omega + b + \sigma n$.

    Parameters
    ----------
    sigma
        Standard deviation of the noise of each axis, rad/s: a scalar or (3,).
    bias
        What it reads at rest $b$ (3,), rad/s, a learnable leaf; zero by default.
    scale
        Scale factor $s$ of each axis (3,), a learnable leaf; one by default. Or a matrix $S$
        (3, 3) of scales and sensitivities across the axes, which has a rotation in it: leave
        `alignment` fixed then.
    alignment
        Rotation vector $a$ (3,) of the sensor's frame in the body's, rad, a learnable leaf; zero
        by default.
    time_offset
        Time of a reading minus its time stamp, s: a learnable leaf if given as a number, such as
        0.0. `None` is no offset, and costs nothing.
    loss
        A robust loss, such as [`Huber`][lgvi.Huber]. `None` is least squares.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    channel = "angular_velocity"
    unit = "rad/s"
    axes = ("x", "y", "z")
    shapes = ((3,),)
    depends_on_attitude = False

    sigma: Float[Array, "*axes"]
    bias: Float[Array, "3"] = eqx.field(metadata=described_by("rad/s"))
    scale: Float[Array, "3 *columns"] = eqx.field(
        metadata=described_by("1", "a sensor of attitudes, or a known torque,")
    )
    alignment: Float[Array, "3"] = eqx.field(metadata=described_by("rad", "a second sensor"))
    time_offset: Float[Array, ""] | None = eqx.field(metadata=described_by("s", "a second sensor"))
    loss: AbstractLoss | None

    def __init__(
        self,
        sigma: Float[ArrayLike, "*axes"],
        bias: Float[ArrayLike, "3"] | None = None,
        scale: Float[ArrayLike, "3 *columns"] | None = None,
        alignment: Float[ArrayLike, "3"] | None = None,
        time_offset: Float[ArrayLike, ""] | None = None,
        loss: AbstractLoss | None = None,
    ):
        self.sigma = as_sigma(sigma)
        self.bias = vector_or_default("bias", bias, 0.0, self.sigma)
        given = None if scale is None else float_array("scale")(scale)
        if given is not None and given.ndim == 2:
            require_shape("scale", given, (3, 3))
            self.scale = given
        else:
            self.scale = vector_or_default("scale", given, 1.0, self.sigma)
        self.alignment = vector_or_default("alignment", alignment, 0.0, self.sigma)
        self.time_offset = as_time_offset(time_offset)
        self.loss = as_loss(loss)

    def predict(self, state: MotionState) -> Float[Array, "3"]:
        r"""What it reads without noise (3,), $s\,\operatorname{Exp}(a)^T\omega + b$, rad/s."""
        omega, a, s, b = as_floats(
            omega=(state.omega, (3,)),
            alignment=(self.alignment, (3,)),
            scale=(self.scale, self.scale.shape),
            bias=(self.bias, (3,)),
        )
        of_sensor = matmul(so3.exp(a).T, omega)
        return (matmul(s, of_sensor) if s.ndim == 2 else s * of_sensor) + b

    def compute_residual(
        self, predicted: Float[Array, "3"], measured: Float[Array, "3"]
    ) -> Float[Array, "3"]:
        r"""Whitened residual (3,), $(\omega_\text{m} - \omega_\text{pred})/\sigma$."""
        error = measured.astype(predicted.dtype) - predicted
        return error / self.sigma.astype(error.dtype)

    def add_noise(
        self, predicted: Float[Array, "3"], noise: Float[Array, "3"]
    ) -> Float[Array, "3"]:
        r"""The angular velocity $\omega_\text{pred} + \sigma n$ (3,), rad/s."""
        return predicted + (self.sigma * noise).astype(predicted.dtype)

    def guess_state(
        self, readings: Float[np.ndarray, "samples 3"]
    ) -> tuple[None, Float[np.ndarray, "samples 3"]]:
        r"""The angular velocities $\operatorname{Exp}(a)\,(\omega_\text{m} - b)/s$."""
        from scipy.spatial.transform import Rotation

        alignment = Rotation.from_rotvec(np.array(self.alignment, float))
        scale = np.asarray(self.scale, float)
        matrix = scale if scale.ndim == 2 else np.diag(scale)
        rates = np.linalg.solve(matrix, (readings - np.asarray(self.bias)).T).T
        return None, alignment.apply(rates)

    @staticmethod
    def from_columns(columns: Float[np.ndarray, "samples columns"]) -> np.ndarray:
        """Angular velocities (samples, 3) as they are."""
        return columns

    @staticmethod
    def as_curves(readings: np.ndarray) -> tuple[str, dict[str, Float[np.ndarray, " samples"]]]:
        """Components in the sensor's frame."""
        return "angular velocity (rad/s)", dict(zip("xyz", readings.T, strict=True))
