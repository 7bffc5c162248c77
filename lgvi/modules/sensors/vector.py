"""What sensors of vectors in the body frame share: bias, scale, alignment and noise."""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ...core import so3
from ...core.kernels.vectors import matmul
from ...core.typed_arrays import as_floats
from ..fields import float_array
from ..loss import AbstractLoss
from .sensor import AbstractSensor, MotionState
from .shared_fields import as_loss, as_sigma, as_time_offset, vector_or_default


class AbstractThreeAxisSensor(AbstractSensor):
    """A sensor of three numbers (3,), each disturbed by normal noise that is added."""

    axes = ("x", "y", "z")
    shapes = ((3,),)

    def compute_residual(
        self, predicted: Float[Array, "3"], measured: Float[Array, "3"]
    ) -> Float[Array, "3"]:
        r"""Whitened residual (3,), $(y_\text{m} - y)/\sigma$."""
        error = measured.astype(predicted.dtype) - predicted
        return error / self.sigma.astype(error.dtype)

    def add_noise(
        self, predicted: Float[Array, "3"], noise: Float[Array, "3"]
    ) -> Float[Array, "3"]:
        r"""The reading $y + \sigma n$ (3,)."""
        return predicted + (self.sigma * noise).astype(predicted.dtype)

    def guess_state(
        self, readings: Float[np.ndarray, "samples 3"]
    ) -> tuple[None, Float[np.ndarray, "samples 3"] | None]:
        """Nothing: most vectors tell neither an attitude nor a rate."""
        return None, None

    @staticmethod
    def from_columns(columns: Float[np.ndarray, "samples columns"]) -> np.ndarray:
        """Vectors (samples, 3) as they are."""
        return columns


class AbstractVectorSensor(AbstractThreeAxisSensor):
    r"""A sensor of a vector $v$ in the body frame, with bias, scale, alignment and noise.

    With $v$, which `sense` gives, it reads $s\,\operatorname{Exp}(a)^Tv + b + \sigma n$ with
    standard normal $n$. With a matrix of scales it reads
    $S\,\operatorname{Exp}(a)^Tv + b + \sigma n$.

    Attributes
    ----------
    quantity
        What it reads, such as `"angular velocity"`.
    bias
        $b$ (3,).
    scale
        $s$ (3,), or $S$ (3, 3).
    alignment
        Rotation vector $a$ (3,) of the sensor's frame in the body's, rad.
    """

    quantity: ClassVar[str]

    bias: eqx.AbstractVar[Float[Array, "3"]]
    scale: eqx.AbstractVar[Float[Array, "3 *columns"]]
    alignment: eqx.AbstractVar[Float[Array, "3"]]
    time_offset: eqx.AbstractVar[Float[Array, ""] | None]
    loss: eqx.AbstractVar[AbstractLoss | None]

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
        self.scale = as_scale(scale, self.sigma)
        self.alignment = vector_or_default("alignment", alignment, 0.0, self.sigma)
        self.time_offset = as_time_offset(time_offset)
        self.loss = as_loss(loss)

    @abstractmethod
    def sense(self, state: MotionState) -> Float[Array, "3"]:
        """The vector $v$ (3,) in the body frame."""

    def predict(self, state: MotionState) -> Float[Array, "3"]:
        r"""What it reads without noise (3,), $s\,\operatorname{Exp}(a)^Tv + b$."""
        v, a, s, b = as_floats(
            v=(self.sense(state), (3,)),
            alignment=(self.alignment, (3,)),
            scale=(self.scale, self.scale.shape),
            bias=(self.bias, (3,)),
        )
        of_sensor = matmul(so3.exp(a).T, v)
        return (matmul(s, of_sensor) if s.ndim == 2 else s * of_sensor) + b

    def correct(self, readings: Float[np.ndarray, "samples 3"]) -> Float[np.ndarray, "samples 3"]:
        r"""The vectors $\operatorname{Exp}(a)\,(v_\text{m} - b)/s$ (samples, 3) of readings."""
        from scipy.spatial.transform import Rotation

        alignment = Rotation.from_rotvec(np.array(self.alignment, float))
        scale = np.asarray(self.scale, float)
        matrix = scale if scale.ndim == 2 else np.diag(scale)
        return alignment.apply(np.linalg.solve(matrix, (readings - np.asarray(self.bias)).T).T)

    @classmethod
    def as_curves(  # pyright: ignore[reportIncompatibleMethodOverride]
        cls, readings: np.ndarray
    ) -> tuple[str, dict[str, Float[np.ndarray, " samples"]]]:
        """Components in the sensor's frame."""
        return f"{cls.quantity} ({cls.unit})", dict(zip("xyz", readings.T, strict=True))


def as_scale(value: ArrayLike | None, like: Array) -> Array:
    """Scales (3,), or a matrix of scales (3, 3); ones by default."""
    if value is None:
        return vector_or_default("scale", None, 1.0, like)
    scale = float_array("scale")(value)
    if scale.shape not in ((3,), (3, 3)):
        raise ValueError(
            f"Argument `scale` must have shape (3,) or (3, 3), but its shape is {scale.shape}."
        )
    return scale
