"""Sensors of velocities."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ...core.kernels.vectors import matmul
from ...core.typed_arrays import as_floats
from ..fields import Frame, described_by, require_frame
from ..loss import AbstractLoss
from .sensor import MotionState
from .shared_fields import as_loss, as_sigma, as_time_offset, vector_or_default
from .vector import AbstractThreeAxisSensor


class VelocitySensor(AbstractThreeAxisSensor):
    r"""A satellite receiver, or optical flow: the velocity of a point of the body.

    With the attitude $R$, the velocity $v$ of the centre of mass and the angular velocity $\omega$
    the sensor reads $v + R\,(\omega\times c)$ in the space frame, or $R^Tv + \omega\times c$ in the
    body frame, and normal noise. The centre of mass moves as the model says, which needs a
    `gravity`.

    Parameters
    ----------
    sigma
        Standard deviation of the noise of each axis, m/s: a scalar or (3,).
    offset
        Place $c$ (3,) of the point from the centre of mass, body frame, m, a learnable leaf; zero
        by default.
    frame
        The frame of the readings, `"space"` or `"body"`, static.
    time_offset
        Time of a reading minus its time stamp, s, which is below zero where time stamps are late: a
        learnable leaf if given as a number, such as 0.0. `None` is no offset, and costs nothing.
    loss
        A robust loss, such as [`Huber`][lgvi.Huber]. `None` is least squares.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape, type or frame.
    """

    channel = "velocity"
    unit = "m/s"
    depends_on_attitude = True

    sigma: Float[Array, "*axes"]
    offset: Float[Array, "3"] = eqx.field(metadata=described_by("m", "a motion that tumbles"))
    frame: Frame = eqx.field(static=True)
    time_offset: Float[Array, ""] | None = eqx.field(metadata=described_by("s", "a second sensor"))
    loss: AbstractLoss | None

    def __init__(
        self,
        sigma: Float[ArrayLike, "*axes"],
        offset: Float[ArrayLike, "3"] | None = None,
        frame: Any = "space",
        time_offset: Float[ArrayLike, ""] | None = None,
        loss: AbstractLoss | None = None,
    ):
        self.sigma = as_sigma(sigma)
        self.offset = vector_or_default("offset", offset, 0.0, self.sigma)
        require_frame(frame)
        self.frame = frame
        self.time_offset = as_time_offset(time_offset)
        self.loss = as_loss(loss)

    def predict(self, state: MotionState) -> Float[Array, "3"]:
        r"""What it reads without noise (3,)."""
        R, v, omega, c = as_floats(
            R=(state.R, (3, 3)),
            v=(state.velocity, (3,)),
            omega=(state.omega, (3,)),
            offset=(self.offset, (3,)),
        )
        about_centre = jnp.cross(omega, c)
        if self.frame == "body":
            return matmul(R.T, v) + about_centre
        return v + matmul(R, about_centre)

    def guess_motion(
        self, readings: Float[np.ndarray, "samples 3"]
    ) -> tuple[None, Float[np.ndarray, "samples 3"] | None]:
        """The velocities in space, as if the point were the centre of mass."""
        return None, readings if self.frame == "space" else None

    @classmethod
    def as_curves(  # pyright: ignore[reportIncompatibleMethodOverride]
        cls, readings: np.ndarray
    ) -> tuple[str, dict[str, Float[np.ndarray, " samples"]]]:
        """Components in the frame of the readings."""
        return "velocity (m/s)", dict(zip("xyz", readings.T, strict=True))
