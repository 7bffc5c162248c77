"""What the hardware of an experiment can do: rates, sensors, wheels, motors and torques."""

from dataclasses import dataclass
from numbers import Integral
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import ArrayLike, Float

from ..model.model import Model

NEAR = 4e-3  # part of a limit that is left, at most, where it binds
ROUNDING = 1e-6  # part of a limit that is no excess
TINY = 1e-9  # where a limit is zero


class LimitUse(NamedTuple):
    """How much of a limit a plan takes.

    Attributes
    ----------
    name, unit
        The limit and its unit.
    extreme
        The value in the plan that is nearest to the limit.
    limit
        The limit.
    is_lowest
        Whether values are above the limit, not below.
    """

    name: str
    unit: str
    extreme: float
    limit: float
    is_lowest: bool = False

    @property
    def is_kept(self) -> bool:
        """Whether the plan keeps the limit, but for rounding."""
        excess = self.limit - self.extreme if self.is_lowest else self.extreme - self.limit
        return excess <= ROUNDING * max(abs(self.limit), abs(self.extreme))

    @property
    def binds(self) -> bool:
        """Whether the plan comes up to the limit."""
        return abs(self.limit - self.extreme) <= NEAR * max(
            abs(self.limit), abs(self.extreme), TINY
        )

    def __str__(self) -> str:
        binds = ", which binds" if self.binds else ""
        return f"{self.name} {self.extreme:.4g} of {self.limit:.4g} {self.unit}{binds}"


class Commands(NamedTuple):
    """What the hardware is told: curves that are linear between knots, one for each column."""

    quantity: str  # of the recordings that the commands are
    label: str  # of a column, before its number
    unit: str
    lower: np.ndarray  # (columns,)
    upper: np.ndarray
    slope: np.ndarray  # the largest change in a second, infinite where there is no limit
    start: np.ndarray  # at the first knot, NaN where it is free
    knots: int
    to_quantity: np.ndarray  # (columns, recorded columns)
    momentum: np.ndarray  # (columns, 3), spin inertia times axis; zero where nothing turns
    torque: np.ndarray  # of the motor of a wheel, infinite where there is no limit

    @property
    def names(self) -> list[str]:
        """The name of each column."""
        return [f"{self.label} {k}" for k in range(len(self.lower))]

    @property
    def largest_momentum(self) -> float:
        """The momentum of all rotors together, at most, kg m²/s."""
        speeds = np.maximum(abs(self.lower), abs(self.upper))
        return float(np.linalg.norm(self.momentum, axis=1) @ speeds)

    @property
    def calm(self) -> np.ndarray:
        """A value of each column (columns,) that does little: where it starts, or nearest to 0."""
        return np.where(np.isnan(self.start), np.clip(0.0, self.lower, self.upper), self.start)


@dataclass(frozen=True)
class Wheels:
    """Reaction wheels, whose speeds are planned; their momentum is the `rotor_momentum`.

    Speeds are linear between the knots, which are equally far apart.

    Parameters
    ----------
    axes
        Axes of the wheels (wheels, 3), body frame, of any length but zero.
    inertia
        Spin inertia, kg m²: a number or (wheels,).
    speed
        Largest speed relative to the body, rad/s, in both directions: a number or (wheels,).
    acceleration
        Largest change of a speed, rad/s²: a number or (wheels,). `None` is no limit.
    torque
        Largest torque of a motor, N m: a number or (wheels,). It is the spin inertia times the
        change of the speed and of the rate of the body about the axis. `None` is no limit.
    start
        Speeds at the first reading, rad/s: a number or (wheels,). By default they are planned too.
    knots
        Number of knots of each speed.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    axes: Float[ArrayLike, "wheels 3"]
    inertia: Float[ArrayLike, "*wheels"]
    speed: Float[ArrayLike, "*wheels"]
    acceleration: Float[ArrayLike, "*wheels"] | None = None
    torque: Float[ArrayLike, "*wheels"] | None = None
    start: Float[ArrayLike, "*wheels"] | None = None
    knots: int = 6

    def __post_init__(self):
        axes = _numbers("axes", self.axes)
        if axes.ndim != 2 or axes.shape[1] != 3 or not np.all(np.any(axes != 0, axis=1)):
            raise ValueError(
                "Argument `axes` must have a direction for each wheel, of shape (wheels, 3), but "
                f"is {self.axes!r}."
            )
        self.of(None)

    def of(self, model: Model | None) -> Commands:
        """The commands to a model, or to one with a `rotor_inertia` of 1."""
        axes = np.asarray(self.axes, float)
        count = len(axes)
        speed = _positive("speed", self.speed, count)
        inertia = _positive("inertia", self.inertia, count)
        momentum = inertia[:, None] * axes / np.linalg.norm(axes, axis=1, keepdims=True)
        factor = np.asarray(1.0 if model is None else model.rotor_inertia, float)
        if factor.ndim:
            raise ValueError(
                "Argument `model` must have a `rotor_inertia` that is one number where wheels are "
                f"planned, but its shape is {factor.shape}."
            )
        return Commands(
            "rotor_momentum",
            "wheel",
            "rad/s",
            -speed,
            speed,
            _positive("acceleration", self.acceleration, count),
            _start("start", self.start, -speed, speed),
            _knots(self.knots),
            momentum / factor,
            momentum,
            _positive("torque", self.torque, count),
        )


@dataclass(frozen=True)
class Motors:
    """Motors of the rotors of the model, whose speeds or commands are planned: `rotor_speed`.

    They are linear between the knots, which are equally far apart.

    Parameters
    ----------
    lowest, highest
        Lowest and highest speed, rad/s, or command: a number or (rotors,).
    acceleration
        Largest change in a second: a number or (rotors,). `None` is no limit.
    start
        At the first reading, such as those of hovering: a number or (rotors,). By default they are
        planned too.
    knots
        Number of knots of each.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type, and a lowest speed that is not below the highest.
    """

    lowest: Float[ArrayLike, "*rotors"]
    highest: Float[ArrayLike, "*rotors"]
    acceleration: Float[ArrayLike, "*rotors"] | None = None
    start: Float[ArrayLike, "*rotors"] | None = None
    knots: int = 6

    def __post_init__(self):
        values: list[Any] = [self.lowest, self.highest, self.acceleration, self.start]
        self._commands(max(np.size(value) for value in values))

    def of(self, model: Model) -> Commands:
        """The commands to a model.

        Raises
        ------
        ValueError
            If the model has no rotors.
        """
        if model.rotors is None:
            raise ValueError("Argument `model` must have `rotors` where motors are planned.")
        count = len(model.rotors.arms)
        momentum = np.asarray(jax.vmap(model.rotors.momentum)(np.eye(count)), float)
        return self._commands(count)._replace(momentum=momentum)

    def _commands(self, count: int) -> Commands:
        lower = _shaped("lowest", _numbers("lowest", self.lowest), count)
        upper = _shaped("highest", _numbers("highest", self.highest), count)
        if not np.all(lower < upper):
            raise ValueError(
                "Argument `lowest` must be below `highest`, but they are "
                f"{self.lowest!r} and {self.highest!r}."
            )
        return Commands(
            "rotor_speed",
            "motor",
            "rad/s",
            lower,
            upper,
            _positive("acceleration", self.acceleration, count),
            _start("start", self.start, lower, upper),
            _knots(self.knots),
            np.eye(count),
            np.zeros((count, 3)),
            np.full(count, np.inf),
        )


@dataclass(frozen=True)
class Torques:
    """Torques about the axes of the body, which are planned: `body_torque`.

    They are linear between the knots, which are equally far apart.

    Parameters
    ----------
    torque
        Largest torque, N m, in both directions: a number or (3,).
    slope
        Largest change in a second, N m/s: a number or (3,). `None` is no limit.
    start
        At the first reading, N m: a number or (3,). By default they are planned too.
    knots
        Number of knots of each.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    torque: Float[ArrayLike, "*axes"]
    slope: Float[ArrayLike, "*axes"] | None = None
    start: Float[ArrayLike, "*axes"] | None = None
    knots: int = 6

    def __post_init__(self):
        self.of(None)

    def of(self, model: Model | None) -> Commands:
        """The commands to a model."""
        torque = _positive("torque", self.torque, 3)
        return Commands(
            "body_torque",
            "torque",
            "N m",
            -torque,
            torque,
            _positive("slope", self.slope, 3),
            _start("start", self.start, -torque, torque),
            _knots(self.knots),
            np.eye(3),
            np.zeros((3, 3)),
            np.full(3, np.inf),
        )


@dataclass(frozen=True)
class Limits:
    """What an experiment may do. Limits hold at all times, for each trajectory.

    Parameters
    ----------
    rate
        Largest angular rate of the body, rad/s.
    trajectories
        Number of throws, or of runs.
    initial_rate
        Largest angular rate at the start, rad/s. 0 is a body at rest. By default it is `rate` where
        nothing commands the body, as in a throw, and else 0.
    saturation
        Largest reading of the gyroscope about each of its axes, rad/s: a number or (3,). `None` is
        no limit.
    turn
        Largest turn from the first attitude, rad, that a camera follows. `None` is no limit.
    travel
        Largest distance of the centre of mass from where it started, m, for a model with a
        `gravity`. `None` is no limit.
    commands
        The [`Wheels`][lgvi.identification.Wheels], the [`Motors`][lgvi.identification.Motors] or
        the [`Torques`][lgvi.identification.Torques] that are planned. `None` for a body that is
        thrown, of which the rates are planned.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    rate: float
    trajectories: int = 1
    initial_rate: float | None = None
    saturation: Float[ArrayLike, "*axes"] | None = None
    turn: float | None = None
    travel: float | None = None
    commands: Wheels | Motors | Torques | None = None

    def __post_init__(self):
        count = self.trajectories
        if not isinstance(count, Integral) or isinstance(count, bool) or count < 1:
            raise ValueError(
                "Argument `trajectories` must be a whole number above 0, but is "
                f"{self.trajectories!r}."
            )
        for name in ("rate", "turn", "travel"):
            value = getattr(self, name)
            if value is None and name != "rate":
                continue
            if np.ndim(_numbers(name, value)):
                raise ValueError(f"Argument `{name}` must be a number, but is {value!r}.")
            _positive(name, value, 1)
        if self.turn is not None and self.turn > np.pi:
            raise ValueError(
                f"Argument `turn` must be at most pi rad, as no turn is larger, but is {self.turn}."
            )
        if self.saturation is not None:
            _positive("saturation", self.saturation, 3)
        initial = 0.0 if self.initial_rate is None else self.initial_rate
        if np.ndim(_numbers("initial_rate", initial)) or not 0 <= initial <= self.rate:
            raise ValueError(
                "Argument `initial_rate` must be a number from 0 to `rate`, rad/s, but is "
                f"{self.initial_rate!r}."
            )
        if not isinstance(self.commands, Wheels | Motors | Torques | None):
            raise TypeError(
                "Argument `commands` must be `Wheels`, `Motors`, `Torques` or None, but is "
                f"{self.commands!r}."
            )

    @property
    def largest_initial_rate(self) -> float:
        """The largest angular rate at the start, rad/s."""
        if self.initial_rate is None:
            return float(self.rate) if self.commands is None else 0.0
        return float(self.initial_rate)


def _numbers(name: str, value: Any) -> np.ndarray:
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "iuf":
            raise TypeError
        array = array.astype(float)
    except (TypeError, ValueError):
        raise TypeError(f"Argument `{name}` must be numbers, but is {value!r}.") from None
    if not np.all(np.isfinite(array)):
        raise ValueError(f"Argument `{name}` must be finite, but is {value!r}.")
    return array


def _shaped(name: str, array: np.ndarray, count: int) -> np.ndarray:
    if array.shape not in ((), (count,)):
        raise ValueError(
            f"Argument `{name}` must be a number or have shape ({count},), but its shape is "
            f"{array.shape}."
        )
    return np.broadcast_to(array, count).copy()


def _positive(name: str, value: Any, count: int) -> np.ndarray:
    """Limits (count,) above zero; infinite for None."""
    if value is None:
        return np.full(count, np.inf)
    array = _shaped(name, _numbers(name, value), count)
    if not np.all(array > 0):
        raise ValueError(f"Argument `{name}` must be above 0, but is {value!r}.")
    return array


def _start(name: str, value: Any, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    if value is None:
        return np.full(len(lower), np.nan)
    start = _shaped(name, _numbers(name, value), len(lower))
    if not np.all((lower <= start) & (start <= upper)):
        raise ValueError(
            f"Argument `{name}` must be within the limits, {lower} to {upper}, but is {value!r}."
        )
    return start


def _knots(value: Any) -> int:
    if not isinstance(value, Integral) or value < 2:
        raise ValueError(f"Argument `knots` must be a whole number above 1, but is {value!r}.")
    return int(value)
