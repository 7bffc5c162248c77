"""Sensors of directions."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ...core import so3
from ...core.kernels.vectors import matmul
from ...core.typed_arrays import as_floats
from ..fields import Frame, described_by, require_frame, require_shape
from ..known_vector import as_known_vector, known_vector_at, known_vectors, require_direction
from ..loss import AbstractLoss
from .sensor import AbstractSensor, InvalidReadingError, MotionState
from .shared_fields import as_loss, as_sigma, as_time_offset, vector_or_default


class DirectionSensor(AbstractSensor):
    r"""A sun sensor, star camera or tracked mark: a known direction, with noise in angle.

    It reads the unit vector of $\operatorname{Exp}(a)^TR^Tu$ for a direction $u$ of space, and of
    $\operatorname{Exp}(a)^TR\,u$ for a direction $u$ of the body that is seen in space. The noise
    turns it by $\sigma n$ about two axes across it, with standard normal $n$ (2,). The length of
    readings does not count. A sensor whose readings have a length is a
    [`Magnetometer`][lgvi.Magnetometer].

    Alone a direction of space shows the ratios of the moments and the rates of a body that
    tumbles. If it is constant, it never shows how far the body is turned about it; the report says
    so. Beside another direction it shows attitudes. A direction of the body alone leaves open how
    the axes of the inertia are turned about it. A fit to it may end in a wrong minimum, and the
    report then says that the model does not hold: give the fit a `start`.

    Parameters
    ----------
    direction
        The known direction $u$ (3,) of any length, a learnable leaf; or a function of time, s, that
        gives it.
    sigma
        Standard deviation of the noise about each axis across the direction, rad: a scalar.
    frame
        `"space"` for a direction of space that is seen in the body frame, `"body"` for a direction
        of the body that is seen in the space frame. Static.
    alignment
        Rotation vector $a$ (3,) of the sensor's frame in that in which it sees the direction, rad,
        a learnable leaf; zero by default.
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

    channel = "direction"
    unit = "rad"
    axes = ("first", "second")
    shapes = ((3,),)
    depends_on_attitude = True

    direction: Float[Array, "3"] | Callable[[Array], Array] = eqx.field(
        metadata=described_by("1", "a sensor of attitudes, for all but its length")
    )
    sigma: Float[Array, ""]
    frame: Frame = eqx.field(static=True)
    alignment: Float[Array, "3"] = eqx.field(metadata=described_by("rad", "a second sensor"))
    time_offset: Float[Array, ""] | None = eqx.field(metadata=described_by("s", "a second sensor"))
    loss: AbstractLoss | None

    def __init__(
        self,
        direction: Float[ArrayLike, "3"] | Callable[[Array], Array],
        sigma: Float[ArrayLike, ""],
        frame: Frame = "space",
        alignment: Float[ArrayLike, "3"] | None = None,
        time_offset: Float[ArrayLike, ""] | None = None,
        loss: AbstractLoss | None = None,
    ):
        self.direction = as_known_vector("direction", direction)
        require_direction("direction", self.direction)
        self.sigma = as_sigma(sigma)
        require_shape("sigma", self.sigma, ())
        require_frame(frame)
        self.frame = frame
        self.alignment = vector_or_default("alignment", alignment, 0.0, self.sigma)
        self.time_offset = as_time_offset(time_offset)
        self.loss = as_loss(loss)

    def predict(self, state: MotionState) -> Float[Array, "3"]:
        r"""The unit vector that it reads without noise (3,)."""
        known = known_vector_at("direction", self.direction, state.t)
        R, a, u = as_floats(
            R=(state.R, (3, 3)), alignment=(self.alignment, (3,)), direction=(known, (3,))
        )
        seen = matmul(so3.exp(a).T, matmul(R.T if self.frame == "space" else R, u))
        return seen / jnp.sqrt(jnp.sum(seen**2))

    def compute_residual(
        self, predicted: Float[Array, "3"], measured: Float[Array, "3"]
    ) -> Float[Array, "2"]:
        r"""Whitened residual (2,): the turn from one to the other about two axes, over $\sigma$.

        The axes are across the predicted direction. The turn is that of a great circle.
        """
        measured = measured.astype(predicted.dtype)
        across = matmul(_axes_across(predicted), measured)
        sine_squared, cosine = jnp.sum(across**2), jnp.sum(predicted * measured)
        small = sine_squared < jnp.finfo(predicted.dtype).eps  # the quotient is one to rounding
        sine = jnp.sqrt(jnp.where(small, 1, sine_squared))
        turn = across * jnp.where(small, 1, jnp.atan2(sine, cosine) / sine)
        # Opposite directions are half a turn apart, about any axis.
        half = jnp.array([jnp.pi, 0], predicted.dtype)
        turn = jnp.where(small & (cosine < 0), half, turn)
        return turn / self.sigma.astype(predicted.dtype)

    def add_noise(
        self, predicted: Float[Array, "3"], noise: Float[Array, "2"]
    ) -> Float[Array, "3"]:
        r"""The direction turned by $\sigma n$ (3,)."""
        turn = (self.sigma * noise).astype(predicted.dtype)
        angle_squared = jnp.sum(turn**2)
        angle = jnp.sqrt(jnp.where(angle_squared > 0, angle_squared, 1))
        sinc = jnp.where(angle_squared > 0, jnp.sin(angle) / angle, 1)
        cosine = jnp.where(angle_squared > 0, jnp.cos(angle), 1)
        return cosine * predicted + sinc * matmul(_axes_across(predicted).T, turn)

    def guess_state(self, readings: Float[np.ndarray, "samples 3"]) -> tuple[None, None]:
        """Nothing: one direction tells no attitude."""
        return None, None

    def guess_vectors(
        self, t: Float[np.ndarray, " samples"], readings: Float[np.ndarray, "samples 3"]
    ) -> tuple[Float[np.ndarray, "samples 3"], Float[np.ndarray, "samples 3"]]:
        """The direction in the body frame and in the space frame (samples, 3)."""
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_rotvec(np.array(self.alignment, float)).as_matrix()
        seen = readings @ turn.T
        known = known_vectors("direction", self.direction, t)
        return (seen, known) if self.frame == "space" else (known, seen)

    @staticmethod
    def from_columns(columns: Float[np.ndarray, "samples columns"]) -> np.ndarray:
        """Unit vectors (samples, 3) of vectors of any length but zero.

        Raises
        ------
        InvalidReadingError
            For a vector that is zero.
        """
        length = np.sqrt(np.einsum("si,si->s", columns, columns))
        if (wrong := ~(length > 0)).any():
            raise InvalidReadingError(int(np.argmax(wrong)), "must have a direction, but is zero")
        return columns / length[:, None]

    @staticmethod
    def as_curves(readings: np.ndarray) -> tuple[str, dict[str, Float[np.ndarray, " samples"]]]:
        """Components of the unit vector."""
        return "direction", dict(zip("xyz", readings.T, strict=True))


def _axes_across(u: Array) -> Array:
    """Two unit vectors (2, 3) across a unit vector, and across each other.

    References
    ----------
    T. Duff et al., "Building an orthonormal basis, revisited", J. Comput. Graph. Tech. 6 (2017).
    """
    x, y, z = u
    sign = jnp.where(z >= 0, 1, -1).astype(u.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = jnp.stack([1 + sign * x * x * a, sign * b, -sign * x])
    return jnp.stack([first, jnp.stack([b, sign + y * y * a, -y])])
