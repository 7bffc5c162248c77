"""Sensors of positions."""

from collections.abc import Iterable
from typing import Any

import equinox as eqx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from ...core.decay import fall
from ...core.kernels.vectors import matmul
from ...core.typed_arrays import as_floats
from ..fields import described_by, shaped_array
from ..loss import AbstractLoss
from .gravity import find_other_reading
from .sensor import MotionState
from .shared_fields import as_loss, as_sigma, as_time_offset, vector_or_default
from .vector import AbstractThreeAxisSensor


class PositionSensor(AbstractThreeAxisSensor):
    r"""A camera or motion capture: the position of a tracked point of a body.

    With the attitude $R$ and the position $x$ of the centre of mass the sensor reads
    $s\,(x + Rc) + \sigma n$ with standard normal $n$. Where the body tumbles, the readings show
    the place $c$ of the tracked point from the centre of mass. The space frame is that of the
    attitudes.

    Without `gravity` the centre of mass moves as a model with a `gravity` says, under all forces of
    the model. With `gravity` it flies free for this sensor, as if the body did not turn,

    $$\ddot x = g - k\dot x, \qquad x(0) = x_0, \quad \dot x(0) = v_0,$$

    and without drag on the parabola $x(t) = x_0 + v_0t + gt^2/2$. Each trajectory has its own $x_0$
    and $v_0$, at its first reading of any sensor. A fit eliminates them with the initial state:
    they are in `own` of its `states`, and the values given here are those of a simulation.

    Free at most one of `gravity`, `gravity_scale`, `length_scale` and `Model.time_scale`, or give a
    prior: positions and attitudes cannot tell them apart. `drag` may be free beside one. Beside a
    gyroscope, without attitudes, `offset` must not start at zero: with no offset all attitudes look
    alike.

    Parameters
    ----------
    offset
        Place $c$ (3,) of the tracked point from the centre of mass, in the body frame, m, a
        learnable leaf.
    sigma
        Standard deviation of the noise of each axis, m: a scalar or (3,).
    gravity
        Acceleration of gravity $g$ (3,) in the space frame, m/s², such as (0, 0, -9.81), of a free
        flight, a learnable leaf. `None`, by default, where the model has a `gravity`; then there
        are no `gravity_scale`, `drag`, `position` and `velocity`.
    gravity_scale
        A factor on `gravity`, a learnable leaf; one by default. Free it where the direction of
        gravity is known, and its size is not.
    length_scale
        Scale of length $s$: what the sensor reads of a metre, a learnable leaf; one by default.
    drag
        Linear drag over mass $k$, 1/s: a learnable leaf if given as a number, such as 0.0. `None`
        is no drag.
    position
        Position $x_0$ (3,) of the centre of mass at the start, space frame, m; zero by default.
    velocity
        Velocity $v_0$ (3,) of the centre of mass at the start, space frame, m/s; zero by default.
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

    channel = "position"
    unit = "m"
    depends_on_attitude = True
    state_fields = ("position", "velocity")

    offset: Float[Array, "3"] = eqx.field(metadata=described_by("m", "a motion that tumbles"))
    sigma: Float[Array, "*axes"]
    gravity: Float[Array, "3"] | None = eqx.field(
        metadata=described_by("m/s²", "a known scale of length")
    )
    gravity_scale: Float[Array, ""] = eqx.field(
        metadata=described_by("1", "a known scale of length", "`gravity` may point up")
    )
    length_scale: Float[Array, ""] = eqx.field(
        metadata=described_by("1", "a known gravity", "the positions may be mirrored")
    )
    drag: Float[Array, ""] | None = eqx.field(
        metadata=described_by("1/s", "a longer flight", "the log may run backwards")
    )
    position: Float[Array, "3"] | None = eqx.field(metadata=described_by("m"))
    velocity: Float[Array, "3"] | None = eqx.field(metadata=described_by("m/s"))
    time_offset: Float[Array, ""] | None = eqx.field(metadata=described_by("s", "a second sensor"))
    loss: AbstractLoss | None

    def __init__(
        self,
        offset: Float[ArrayLike, "3"],
        sigma: Float[ArrayLike, "*axes"],
        gravity: Float[ArrayLike, "3"] | None = None,
        gravity_scale: Float[ArrayLike, ""] = 1.0,
        length_scale: Float[ArrayLike, ""] = 1.0,
        drag: Float[ArrayLike, ""] | None = None,
        position: Float[ArrayLike, "3"] | None = None,
        velocity: Float[ArrayLike, "3"] | None = None,
        time_offset: Float[ArrayLike, ""] | None = None,
        loss: AbstractLoss | None = None,
    ):
        self.sigma = as_sigma(sigma)
        self.offset = shaped_array("offset", offset, (3,))
        self.gravity = None if gravity is None else shaped_array("gravity", gravity, (3,))
        of_free_flight = {"drag": drag, "position": position, "velocity": velocity}
        for name, value in of_free_flight.items() if gravity is None else ():
            if value is not None:
                raise ValueError(
                    f"Argument `{name}` must be None where `gravity` is None, as the centre of "
                    f"mass then moves as the model says, but is {value!r}."
                )
        for name, value in {"offset": self.offset, "gravity": self.gravity}.items():
            if (
                value is not None
                and not isinstance(value, Tracer)
                and not np.all(np.isfinite(value))
            ):
                raise ValueError(f"Argument `{name}` must be finite, but is {value}.")
        self.gravity_scale = shaped_array("gravity_scale", gravity_scale, ())
        self.length_scale = shaped_array("length_scale", length_scale, ())
        if (
            not isinstance(self.length_scale, Tracer)
            and not float(np.asarray(self.length_scale)) > 0
        ):
            raise ValueError(
                f"Argument `length_scale` must be above 0, but is {self.length_scale}."
            )
        self.drag = None if drag is None else shaped_array("drag", drag, ())
        self.position = self.velocity = None
        if gravity is not None:
            self.position = vector_or_default("position", position, 0.0, self.sigma)
            self.velocity = vector_or_default("velocity", velocity, 0.0, self.sigma)
        self.time_offset = as_time_offset(time_offset)
        self.loss = as_loss(loss)

    def predict(self, state: MotionState) -> Float[Array, "3"]:
        r"""What it reads without noise (3,), $s\,(x + Rc)$."""
        R, c = as_floats(R=(state.R, (3, 3)), offset=(self.offset, (3,)))
        x = state.position if self.gravity is None else self._flight(state.elapsed)[0]
        (scale,) = as_floats(length_scale=(self.length_scale, ()))
        return scale.astype(x.dtype) * (x + matmul(R, c).astype(x.dtype))

    def advance(self, duration: Array) -> "PositionSensor":
        """With the position and the velocity that the centre of mass has after some time, s."""
        if self.gravity is None:
            return self
        now = self._flight(duration)
        return eqx.tree_at(lambda sensor: (sensor.position, sensor.velocity), self, now)

    def _flight(self, t: Array) -> tuple[Array, Array]:
        """Position (3,) and velocity (3,) of the centre of mass at a time since the start."""
        of_flight: dict[str, Any] = {
            name: (getattr(self, name), (3,)) for name in ("position", "velocity", "gravity")
        }
        x, v, g, factor, t, k = as_floats(
            **of_flight,
            gravity_scale=(self.gravity_scale, ()),
            elapsed=(t, ()),
            drag=(0.0 if self.drag is None else self.drag, ()),
        )
        half = 0.5 if self.drag is None else fall(k * t)
        decay = 1 - k * t * half  # (1 - exp(-k t))/(k t)
        a = factor * g - k * v
        return x + t * v + t**2 * half * a, v + t * decay * a

    def guess_fields(
        self, t: Float[np.ndarray, " samples"], readings: Float[np.ndarray, "samples 3"]
    ) -> dict[str, Float[np.ndarray, "3"]]:
        """Position and velocity at the start, by a parabola through the readings."""
        if self.gravity is None:
            return {}
        gravity = np.asarray(self.gravity, float) * float(self.gravity_scale)
        straight = readings / float(self.length_scale) - gravity * (t**2 / 2)[:, None]
        powers = np.vander(t, min(2, len(t)), increasing=True)
        start = np.zeros((2, 3))
        start[: powers.shape[1]] = np.linalg.lstsq(powers, straight, rcond=None)[0]
        return {"position": start[0], "velocity": start[1]}

    def guess_motion(
        self, readings: Float[np.ndarray, "samples 3"]
    ) -> tuple[Float[np.ndarray, "samples 3"], None]:
        """The positions, as if the tracked point were the centre of mass."""
        return readings / float(self.length_scale), None

    def find_mistake(
        self, trajectories: Iterable[tuple[Float[np.ndarray, " samples"], np.ndarray]]
    ) -> tuple[str, float] | None:
        """A unit, or a direction of gravity, with which the readings fall as gravity says."""
        if self.gravity is None:
            return None
        scale = float(self.length_scale)
        gravity = np.asarray(self.gravity, float) * float(self.gravity_scale)
        return find_other_reading(((t, each / scale) for t, each in trajectories), gravity)

    @staticmethod
    def as_curves(readings: np.ndarray) -> tuple[str, dict[str, Float[np.ndarray, " samples"]]]:
        """Components in the space frame."""
        return "position (m)", dict(zip("xyz", readings.T, strict=True))
