"""Sensors of angular velocities."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..fields import described_by
from ..loss import AbstractLoss
from .sensor import MotionState
from .vector import AbstractVectorSensor


class Gyroscope(AbstractVectorSensor):
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
        Time of a reading minus its time stamp, s, which is below zero where time stamps are late: a
        learnable leaf if given as a number, such as 0.0. `None` is no offset, and costs nothing.
    loss
        A robust loss, such as [`Huber`][lgvi.Huber]. `None` is least squares.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    channel = "angular_velocity"
    quantity = "angular velocity"
    unit = "rad/s"
    depends_on_attitude = False

    sigma: Float[Array, "*axes"]
    bias: Float[Array, "3"] = eqx.field(metadata=described_by("rad/s"))
    scale: Float[Array, "3 *columns"] = eqx.field(
        metadata=described_by(
            "1",
            "a sensor of attitudes, or a known torque,",
            "an axis of the readings may be reversed",
        )
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
        super().__init__(sigma, bias, scale, alignment, time_offset, loss)

    def sense(self, state: MotionState) -> Float[Array, "3"]:
        r"""The angular velocity $\omega$ (3,), rad/s."""
        return state.omega

    def guess_state(
        self, readings: Float[np.ndarray, "samples 3"]
    ) -> tuple[None, Float[np.ndarray, "samples 3"]]:
        r"""The angular velocities $\operatorname{Exp}(a)\,(\omega_\text{m} - b)/s$."""
        return None, self.correct(readings)
