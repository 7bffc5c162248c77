"""Sensors of specific force."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ...core.kernels.vectors import matmul
from ...core.typed_arrays import as_floats
from ..fields import described_by, shaped_array
from ..loss import AbstractLoss
from .sensor import MotionState
from .vector import AbstractVectorSensor


class Accelerometer(AbstractVectorSensor):
    r"""An accelerometer away from the centre of mass in flight, or on a body about a pivot.

    It senses the specific force

    $$f = \frac Fm + \dot\omega\times r + \omega\times(\omega\times r) - R^Tg$$

    and reads $s\,\operatorname{Exp}(a)^Tf + b + \sigma n$ with standard normal $n$. With a matrix
    of scales it reads $S\,\operatorname{Exp}(a)^Tf + b + \sigma n$. The angular acceleration is
    that of the equations of motion, so that nothing is differentiated. In flight gravity acts
    on the sensor as on the body and is not felt: $g = 0$, and the readings of a body that tumbles
    show the place $r$ relative to the centre of mass. The force $F$ over the mass is that of a
    model with a `mass`, such as of its rotors, and zero for others: forces that are not in the
    model move the estimate of $r$. About a pivot the body has the inertia about the pivot, and
    $F = 0$.

    Parameters
    ----------
    position
        Place $r$ (3,) of the sensor from the centre of mass in flight, or from the pivot, in the
        body frame, m, a learnable leaf.
    sigma
        Standard deviation of the noise of each axis, m/s²: a scalar or (3,).
    gravity
        Acceleration of gravity $g$ (3,) in the space frame, m/s², such as (0, 0, -9.81), for a body
        about a fixed pivot: a learnable leaf. `None`, by default, in free flight.
    bias
        What it reads without specific force $b$ (3,), m/s², a learnable leaf; zero by default.
    scale
        Scale factor $s$ of each axis (3,), a learnable leaf; one by default. Or a matrix $S$ (3, 3)
        of scales and sensitivities across the axes, which has a rotation in it: leave
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

    channel = "specific_force"
    quantity = "specific force"
    unit = "m/s²"

    position: Float[Array, "3"] = eqx.field(metadata=described_by("m", "a motion that tumbles"))
    sigma: Float[Array, "*axes"]
    gravity: Float[Array, "3"] | None = eqx.field(
        metadata=described_by("m/s²", "a sensor of attitudes")
    )
    bias: Float[Array, "3"] = eqx.field(metadata=described_by("m/s²"))
    scale: Float[Array, "3 *columns"] = eqx.field(
        metadata=described_by(
            "1", "a known `position`, or `gravity`,", "an axis of the readings may be reversed"
        )
    )
    alignment: Float[Array, "3"] = eqx.field(metadata=described_by("rad", "a second sensor"))
    time_offset: Float[Array, ""] | None = eqx.field(metadata=described_by("s", "a second sensor"))
    loss: AbstractLoss | None

    def __init__(
        self,
        position: Float[ArrayLike, "3"],
        sigma: Float[ArrayLike, "*axes"],
        gravity: Float[ArrayLike, "3"] | None = None,
        bias: Float[ArrayLike, "3"] | None = None,
        scale: Float[ArrayLike, "3 *columns"] | None = None,
        alignment: Float[ArrayLike, "3"] | None = None,
        time_offset: Float[ArrayLike, ""] | None = None,
        loss: AbstractLoss | None = None,
    ):
        super().__init__(sigma, bias, scale, alignment, time_offset, loss)
        self.position = shaped_array("position", position, (3,))
        self.gravity = None if gravity is None else shaped_array("gravity", gravity, (3,))

    @property
    def depends_on_attitude(  # pyright: ignore[reportIncompatibleVariableOverride]
        self,
    ) -> bool:
        """Whether gravity is felt."""
        return self.gravity is not None

    def sense(self, state: MotionState) -> Float[Array, "3"]:
        """The specific force (3,) in the body frame, m/s²."""
        omega, rate, r = as_floats(
            omega=(state.omega, (3,)),
            angular_acceleration=(state.angular_acceleration, (3,)),
            position=(self.position, (3,)),
        )
        force = jnp.cross(rate, r) + jnp.cross(omega, jnp.cross(omega, r))
        if state.specific_force is not None:
            (of_mass,) = as_floats(specific_force=(state.specific_force, (3,)))
            force = force + of_mass.astype(force.dtype)
        if self.gravity is None:
            return force
        R, g = as_floats(R=(state.R, (3, 3)), gravity=(self.gravity, (3,)))
        return force - matmul(R.T, g)
