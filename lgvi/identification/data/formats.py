"""How a quantity may be given, in arrays or columns of a file: sensors and inputs say it."""

from collections.abc import Iterable, Mapping
from typing import Any, Protocol

import numpy as np

from ...modules.sensors import SENSORS
from ...modules.sensors.base import InvalidReadingError, Sensors, by_channel

MOST_ROTORS = 16


class Format(Protocol):
    """How a quantity may be given: sensors and inputs say it."""

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shapes of one sample."""
        ...

    @property
    def unit(self) -> str:
        """Unit of the values."""
        ...

    @staticmethod
    def from_columns(columns: np.ndarray) -> np.ndarray:
        """Values (samples, ...) from finite numbers (samples, n)."""
        ...


class Vector:
    """Three numbers, as they are."""

    shapes = ((3,),)
    unit = "N m"

    @staticmethod
    def from_columns(columns: np.ndarray) -> np.ndarray:
        """The columns."""
        return columns


class Rotor(Vector):
    """Three numbers, or one: a speed about an axis."""

    shapes = ((3,), (1,), ())
    unit = "rad/s"  # of speeds


class RotorSpeeds(Vector):
    """A number for each rotor."""

    shapes = tuple((count,) for count in range(1, MOST_ROTORS + 1))
    unit = "rad/s"

    @staticmethod
    def from_columns(columns: np.ndarray) -> np.ndarray:
        """The columns, none of which may be negative."""
        if (wrong := (columns < 0).any(axis=1)).any():
            raise InvalidReadingError(
                int(np.argmax(wrong)),
                "must not be negative, as the sense of rotation is the `spin` of a `Multirotor`",
            )
        return columns


# What acts on a body and is recorded, not read by a sensor of its motion.
INPUTS: dict[str, Format] = {
    "body_torque": Vector(),
    "rotor_momentum": Rotor(),
    "rotor_speed": RotorSpeeds(),
}
# Other arguments beside the channels.
ARGUMENTS = (
    *("t", "name", "sensors", "file", "folder", "trajectory"),
    *("time_unit", "duplicates", "delimiter", "decimal", "missing", "comment", "skip_lines"),
    *("units", "attitude_order", "normalise"),
)


def require_own_names(channels: Iterable[str]) -> None:
    """Check that no channel has the name of an input, or of another argument."""
    for channel in channels:
        if channel in (*INPUTS, *ARGUMENTS):
            raise ValueError(f"Argument `sensors` must not have a channel named `{channel}`.")


def known_formats(sensors: Sensors) -> dict[str, Format]:
    """How each quantity may be given, by name."""
    known = {**by_channel(SENSORS), **by_channel(sensors)}
    require_own_names(known)
    return {**known, **INPUTS}


def given_with_formats(
    channels: Mapping[str, Any], inputs: Mapping[str, Any], sensors: Sensors
) -> dict[str, tuple[Any, Format]]:
    """What is not None by quantity, and how it is given."""
    known = known_formats(sensors)
    for channel in channels:
        if channel not in known:
            names = ", ".join(f"`{name}`" for name in known)
            raise TypeError(
                f"There is no quantity or option `{channel}`; quantities are {names}. Sensors of "
                "other kinds are given by `sensors`."
            )
    if all(value is None for value in channels.values()):
        names = " or ".join(f"`{name}`" for name in known if name not in INPUTS)
        raise ValueError(f"Argument {names} must be given, but none is.")
    given = {**channels, **inputs}
    return {name: (value, known[name]) for name, value in given.items() if value is not None}
