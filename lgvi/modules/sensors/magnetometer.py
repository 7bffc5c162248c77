"""Sensors of a known vector of space."""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ...core.kernels.vectors import matmul
from ...core.typed_arrays import as_floats
from ..fields import described_by
from ..known_vector import as_known_vector, known_vector_at, known_vectors
from ..loss import AbstractLoss
from .sensor import MotionState
from .vector import AbstractVectorSensor


class Magnetometer(AbstractVectorSensor):
    r"""A magnetometer: the magnetic field of a place, seen in the body frame.

    With the field $B$ in space it reads $s\,\operatorname{Exp}(a)^TR^TB + b + \sigma n$ with
    standard normal $n$. With a matrix of scales it reads
    $S\,\operatorname{Exp}(a)^TR^TB + b + \sigma n$.

    Alone it shows the ratios of the moments and the rates of a body that tumbles. In a constant
    field it never shows how far the body is turned about the field; the report says so. Beside
    another direction it shows attitudes.

    Parameters
    ----------
    field
        The magnetic field $B$ (3,) in the space frame, T, a learnable leaf; or a function of time,
        s, that gives it, such as along an orbit.
    sigma
        Standard deviation of the noise of each axis, T: a scalar or (3,).
    bias
        Hard iron $b$ (3,), T: the field of magnets in the body, a learnable leaf; zero by default.
    scale
        Scale factor $s$ of each axis (3,), a learnable leaf; one by default. Or a matrix $S$ (3, 3)
        of scales and soft iron, which has a rotation in it: leave `alignment` fixed then.
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

    channel = "magnetic_field"
    quantity = "magnetic field"
    unit = "T"
    depends_on_attitude = True

    field: Float[Array, "3"] | Callable[[Array], Array] = eqx.field(
        metadata=described_by("T", "a sensor of attitudes")
    )
    sigma: Float[Array, "*axes"]
    bias: Float[Array, "3"] = eqx.field(metadata=described_by("T"))
    scale: Float[Array, "3 *columns"] = eqx.field(
        metadata=described_by("1", "a known field", "an axis of the readings may be reversed")
    )
    alignment: Float[Array, "3"] = eqx.field(metadata=described_by("rad", "a second sensor"))
    time_offset: Float[Array, ""] | None = eqx.field(metadata=described_by("s", "a second sensor"))
    loss: AbstractLoss | None

    def __init__(
        self,
        field: Float[ArrayLike, "3"] | Callable[[Array], Array],
        sigma: Float[ArrayLike, "*axes"],
        bias: Float[ArrayLike, "3"] | None = None,
        scale: Float[ArrayLike, "3 *columns"] | None = None,
        alignment: Float[ArrayLike, "3"] | None = None,
        time_offset: Float[ArrayLike, ""] | None = None,
        loss: AbstractLoss | None = None,
    ):
        self.field = as_known_vector("field", field)
        super().__init__(sigma, bias, scale, alignment, time_offset, loss)

    def guess_vectors(
        self, t: Float[np.ndarray, " samples"], readings: Float[np.ndarray, "samples 3"]
    ) -> tuple[Float[np.ndarray, "samples 3"], Float[np.ndarray, "samples 3"]]:
        """The field in the body frame and in the space frame (samples, 3), T."""
        return self.correct(readings), known_vectors("field", self.field, t)

    def sense(self, state: MotionState) -> Float[Array, "3"]:
        """The field $R^TB$ (3,) in the body frame, T."""
        field = known_vector_at("field", self.field, state.t)
        R, field = as_floats(R=(state.R, (3, 3)), field=(field, (3,)))
        return matmul(R.T, field)
