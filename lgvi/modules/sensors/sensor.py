"""Sensors: predictions, residuals, noise, and columns of a file.

A sensor is one file. The rest of the package holds readings by the names of channels, and asks the
sensor for all that depends on its kind.
"""

from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..loss import AbstractLoss
from ..printing import show


class MotionState(eqx.Module):
    """The motion of a body at one time, as far as a sensor can read it.

    Parameters
    ----------
    t
        Time, s, as a torque law gets it.
    R
        Attitude (3, 3), body to space.
    omega
        Angular velocity (3,), body frame, rad/s.
    compute_angular_acceleration
        A function that gives the angular acceleration (3,), body frame, rad/s². It is called only
        where a sensor asks for `angular_acceleration`.
    elapsed
        Time since that at which a sensor's `state_fields` hold, s; by default `t`. A fit cuts
        trajectories: a sensor that uses this time must have an `advance` that goes with it.
    x, v
        Position (3,), m, and velocity (3,), m/s, of the centre of mass, space frame; None where the
        model has no motion of the centre of mass.
    specific_force
        The sum of all forces but gravity over the mass (3,), body frame, m/s². None, by default, is
        zero, as in free flight.
    """

    t: Float[Array, ""]
    R: Float[Array, "3 3"]
    omega: Float[Array, "3"]
    compute_angular_acceleration: Callable[[], Array] | None
    elapsed: Float[Array, ""]
    x: Float[Array, "3"] | None
    v: Float[Array, "3"] | None
    specific_force: Float[Array, "3"] | None

    def __init__(
        self,
        t: Float[ArrayLike, ""],
        R: Float[ArrayLike, "3 3"],
        omega: Float[ArrayLike, "3"],
        compute_angular_acceleration: Callable[[], Array] | None = None,
        elapsed: Float[ArrayLike, ""] | None = None,
        x: Float[ArrayLike, "3"] | None = None,
        v: Float[ArrayLike, "3"] | None = None,
        specific_force: Float[ArrayLike, "3"] | None = None,
    ):
        self.t, self.R, self.omega = map(jnp.asarray, (t, R, omega))
        self.compute_angular_acceleration = compute_angular_acceleration
        self.elapsed = self.t if elapsed is None else jnp.asarray(elapsed)
        self.x, self.v, self.specific_force = (
            None if vector is None else jnp.asarray(vector) for vector in (x, v, specific_force)
        )

    @property
    def angular_acceleration(self) -> Float[Array, "3"]:
        r"""Angular acceleration $\dot\omega$ (3,), body frame, rad/s²."""
        if self.compute_angular_acceleration is None:
            raise ValueError(
                "A `MotionState` must be made with `compute_angular_acceleration` for a sensor "
                "that reads the angular acceleration."
            )
        return self.compute_angular_acceleration()

    @property
    def position(self) -> Float[Array, "3"]:
        """Position of the centre of mass (3,), space frame, m; an error where it is not known."""
        return self._of_centre("x", "position")

    @property
    def velocity(self) -> Float[Array, "3"]:
        """Velocity of the centre of mass (3,), space frame, m/s; an error where it is not known."""
        return self._of_centre("v", "velocity")

    def _of_centre(self, name: str, quantity: str) -> Array:
        if (vector := getattr(self, name)) is None:
            raise ValueError(
                f"A sensor that reads the {quantity} of the centre of mass needs a model with a "
                f"`gravity`, such as (0, 0, -9.81): by itself, a `MotionState` with `{name}`."
            )
        return vector


class InvalidReadingError(ValueError):
    """A reading that the sensor cannot have made.

    Parameters
    ----------
    reading
        Its index among the readings.
    words
        What a reading must be, and what this one was, such as "must have length 1, but has 2".
    """

    def __init__(self, reading: int, words: str):
        super().__init__(words)
        self.reading = reading
        self.words = words


class AbstractSensor(eqx.Module):
    r"""A sensor: a reading is what it predicts from the motion, disturbed by normal noise.

    The sensor reads $y_\text{m} = y \oplus \sigma n$ with standard normal $n$ (m,), where `predict`
    gives $y$, and `add_noise` is $\oplus$. The whitened residual is the inverse:
    `compute_residual(y, add_noise(y, n)) = n`. A sensor of your own has all attributes and methods
    below; `time_offset` and `loss` may be left out, and so may what is about `state_fields`.

    Attributes
    ----------
    channel
        Name of the quantity in recordings and reports, such as `"angular_velocity"`.
    unit
        Unit of `sigma`.
    axes
        Names of the m components of the residual, such as `("x", "y", "z")`.
    shapes
        Shapes in which one reading may be given; the possible numbers of columns in a file follow.
    depends_on_attitude
        Whether the prediction depends on the attitude. If so, and no sensor gives attitudes
        directly, a fit tries 24 attitudes. The degrees of freedom of its residuals follow too.
    sigma
        Standard deviation of the noise, a scalar or (m,).
    time_offset
        Time of a reading minus its time stamp, s. None, or without such a field: no offset.
    loss
        A robust loss. None, or without such a field: least squares.
    state_fields
        Names of floating-point fields that are a state at the start of a trajectory, such as where
        a tracked body is. Each trajectory has its own; a fit eliminates them with the initial
        attitude and rate. A sensor with such fields has `guess_fields` and `advance`.
    """

    channel: ClassVar[str]
    unit: ClassVar[str]
    axes: ClassVar[tuple[str, ...]]
    shapes: ClassVar[tuple[tuple[int, ...], ...]]
    depends_on_attitude: ClassVar[bool]
    state_fields: ClassVar[tuple[str, ...]] = ()
    sigma: eqx.AbstractVar[Float[Array, "*axes"]]

    def __repr__(self) -> str:
        return show(self)

    @abstractmethod
    def predict(self, state: MotionState) -> Array:
        """The reading without noise (...), in the shape that `from_columns` gives."""

    @abstractmethod
    def compute_residual(self, predicted: Array, measured: Array) -> Float[Array, " m"]:
        """Whitened residual (m,) of a reading, in standard deviations."""

    @abstractmethod
    def add_noise(self, predicted: Array, noise: Float[Array, " m"]) -> Array:
        """The prediction disturbed by noise (m,) in standard deviations."""

    @abstractmethod
    def guess_state(
        self, readings: np.ndarray
    ) -> tuple[Float[np.ndarray, "samples 3 3"] | None, Float[np.ndarray, "samples 3"] | None]:
        """Attitudes, body to space, and angular velocities, body frame, rad/s, of readings.

        A fit starts from these. None stands for a quantity that does not follow from one reading.
        If no sensor gives attitudes, a fit tries 24 attitudes and starts from the best.
        """

    def guess_vectors(
        self, t: Float[np.ndarray, " samples"], readings: np.ndarray
    ) -> tuple[Float[np.ndarray, "samples 3"], Float[np.ndarray, "samples 3"]] | None:
        """The same vector in the body frame and in the space frame.

        The sensor reads one of them and knows the other, at times as a torque law gets them, s, but
        for a `time_offset`. Where no sensor gives attitudes, a fit starts from two such vectors, or
        tries turns about one. None, by default, if a reading is no such vector.
        """
        return None

    def guess_fields(
        self, t: Float[np.ndarray, " samples"], readings: np.ndarray
    ) -> dict[str, np.ndarray]:
        """The `state_fields` by name, from readings at times since the start, s. A fit starts so.

        There is one reading at least.
        """
        return {}

    def guess_motion(
        self, readings: np.ndarray
    ) -> tuple[Float[np.ndarray, "samples 3"] | None, Float[np.ndarray, "samples 3"] | None]:
        """Positions, m, and velocities, m/s, of the centre of mass in space, of readings.

        A fit starts from these, where the centre of mass moves. None, by default, stands for what
        does not follow from one reading.
        """
        return None, None

    def find_mistake(
        self, trajectories: Iterable[tuple[Float[np.ndarray, " samples"], np.ndarray]]
    ) -> tuple[str, float] | None:
        """Another reading of recordings that fits much better, such as in another unit.

        In words that follow "reading", and how many times better it fits, in squares, from times
        and readings of all trajectories. None, by default, if there is none.
        """
        return None

    def advance(self, duration: Array) -> "AbstractSensor":
        """The sensor with the `state_fields` that it has after some time, s.

        Two times one after the other must give the same as their sum.
        """
        return self

    @staticmethod
    @abstractmethod
    def from_columns(columns: Float[np.ndarray, "samples columns"]) -> np.ndarray:
        """Readings (samples, ...) of finite numbers from columns of a file, or flat arrays.

        Raises
        ------
        InvalidReadingError
            For the first row that is not a reading.
        """

    @staticmethod
    @abstractmethod
    def as_curves(readings: np.ndarray) -> tuple[str, dict[str, Float[np.ndarray, " samples"]]]:
        """For a picture: the quantity with its unit, and its curves by name."""


def require_state_fields(sensor: AbstractSensor) -> None:
    """Check that the `state_fields` of a sensor are names of fields that can be a state.

    Raises
    ------
    TypeError
        If they are not.
    """
    names, kind = sensor.state_fields, type(sensor).__name__
    if not isinstance(names, tuple):
        raise TypeError(
            f"The class attribute `state_fields` of `{kind}` must be a tuple of names, but is "
            f"{names!r}."
        )
    for name in names:
        value, declared = getattr(sensor, str(name), ...), sensor.__dataclass_fields__.get(name)
        may_be_none = declared is not None and "unit" in declared.metadata
        is_state = eqx.is_inexact_array(value) or (value is None and may_be_none)
        if name == "sigma" or not is_state:
            raise TypeError(
                f"The class attribute `state_fields` of `{kind}` must have names of fields with "
                f"floating-point arrays, other than `sigma`, but has {name!r}."
            )


def states_of(sensor: AbstractSensor) -> dict[str, Array]:
    """The fields of a sensor that are a state, by name."""
    fields = {name: getattr(sensor, name) for name in sensor.state_fields}
    return {name: value for name, value in fields.items() if value is not None}


def require_fields(sensor: AbstractSensor, values: Mapping[str, ArrayLike]) -> None:
    """Check the `state_fields` that a sensor guesses.

    Raises
    ------
    ValueError
        If a name or a shape is another one.
    """
    wanted = {name: value.shape for name, value in states_of(sensor).items()}
    shapes = {name: np.shape(value) for name, value in values.items()}
    if shapes != wanted:
        raise ValueError(
            f"`guess_fields` of `{type(sensor).__name__}` must give the shapes {wanted}, but gives "
            f"{shapes}."
        )


def advance(sensor: AbstractSensor, duration: Array) -> AbstractSensor:
    """The sensor some time later, checked.

    Raises
    ------
    ValueError
        If a field that is a state has another shape.
    """
    later = sensor.advance(duration)
    for name, value in states_of(sensor).items():
        shape, new_shape = value.shape, jnp.shape(getattr(later, name, jnp.nan))
        if new_shape != shape:
            raise ValueError(
                f"`advance` of `{type(sensor).__name__}` must keep the shape {shape} of `{name}`, "
                f"but gives {new_shape}."
            )
    return later


def time_offset_of(sensor: AbstractSensor) -> ArrayLike | None:
    """The time offset of a sensor, s; None also where the sensor has no such field."""
    return getattr(sensor, "time_offset", None)


def loss_of(sensor: AbstractSensor) -> AbstractLoss | None:
    """The robust loss of a sensor; None also where the sensor has no such field."""
    return getattr(sensor, "loss", None)


def require_shapes(sensor: AbstractSensor, shape: tuple[int, ...], dtype: Any) -> None:
    """Check what a sensor makes of a predicted reading of some shape, without computing it.

    Raises
    ------
    ValueError
        If the shapes are not those that the sensor says.
    """
    name, axes = type(sensor).__name__, (len(sensor.axes),)
    reading = jax.ShapeDtypeStruct(shape, dtype)
    residual = jax.eval_shape(sensor.compute_residual, reading, reading)
    if residual.shape != axes:
        raise ValueError(
            f"The residual of `{name}` must have shape {axes}, one number for each of its `axes`, "
            f"but its shape is {residual.shape}."
        )
    noisy = jax.eval_shape(sensor.add_noise, reading, residual)
    if noisy.shape != shape:
        raise ValueError(
            f"A reading of `{name}` with noise must have the shape of its prediction, "
            f"{shape}, but its shape is {noisy.shape}."
        )


Sensor = AbstractSensor | type[AbstractSensor]
Sensors = Sensor | Sequence[Sensor] | Mapping[str, Sensor]


def by_channel(sensors: Sensors) -> OrderedDict[str, Any]:
    """Sensors by the names of their channels, in the order in which they are given.

    Raises
    ------
    TypeError, ValueError
        If something is not a sensor, or two sensors have one channel.
    """
    if isinstance(sensors, Mapping):
        pairs = list(sensors.items())
    else:
        several = sensors if isinstance(sensors, Sequence) else (sensors,)
        pairs = [(getattr(sensor, "channel", ""), sensor) for sensor in several]
    by_channel: OrderedDict[str, Any] = OrderedDict()
    for channel, sensor in pairs:
        kind = sensor if isinstance(sensor, type) else type(sensor)
        if not issubclass(kind, AbstractSensor):
            raise TypeError(
                "Argument `sensors` must be a sensor such as `AttitudeSensor`, several, or a "
                f"mapping of the names of channels to sensors, but has {sensor!r}."
            )
        for name in ("channel", "unit", "axes", "shapes", "depends_on_attitude"):
            if not hasattr(kind, name):
                raise TypeError(
                    f"The sensor `{kind.__name__}` must have a class attribute `{name}`."
                )
        shapes = kind.shapes if isinstance(kind.shapes, tuple) else (None,)
        if not all(isinstance(shape, tuple) for shape in shapes):
            raise TypeError(
                f"The class attribute `shapes` of `{kind.__name__}` must be a tuple of shapes, "
                f"such as ((3,),), but is {kind.shapes!r}."
            )
        if not isinstance(channel, str):
            raise TypeError(
                "Argument `sensors` must have names of channels that are strings, but has "
                f"{channel!r}."
            )
        if channel in by_channel:
            raise ValueError(
                f"Argument `sensors` must have one sensor for each channel, but has two for "
                f"`{channel}`: give them names of their own by a mapping."
            )
        by_channel[channel] = sensor
    return by_channel
