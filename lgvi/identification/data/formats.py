"""The quantities that may be recorded, the formats of their samples, and other units."""

import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from ...modules.sensors import SENSORS
from ...modules.sensors.attitude import TOLERANCE, AttitudeSensor
from ...modules.sensors.sensor import InvalidReadingError, Sensors, by_channel
from ...modules.units import FACTORS

MOST_ROTORS = 16

QUATERNIONS = "wxyz", "xyzw"
ROTATION_VECTOR = "rotation_vector"
DIRECTIONS = "body to space", "space to body"


class Format(Protocol):
    """The format of the samples of a quantity: an attribute of sensors and inputs."""

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


# Recorded actions on a body, in contrast to readings of sensors of the motion.
INPUTS: dict[str, Format] = {
    "body_torque": Vector(),
    "rotor_momentum": Rotor(),
    "rotor_speed": RotorSpeeds(),
}
# Arguments other than channels.
ARGUMENTS = (
    *("t", "name", "sensors", "file", "folder", "trajectory"),
    *("time_unit", "duplicates", "delimiter", "decimal", "missing", "comment", "skip_lines"),
    *("units", "attitude_order", "attitude_direction", "normalise"),
)


def require_own_names(channels: Iterable[str]) -> None:
    """Check that no channel has the name of an input, or of another argument."""
    for channel in channels:
        if channel in (*INPUTS, *ARGUMENTS):
            raise ValueError(f"Argument `sensors` must not have a channel named `{channel}`.")


def known_formats(sensors: Sensors) -> dict[str, Format]:
    """The format of each quantity, by name."""
    known = {**by_channel(SENSORS), **by_channel(sensors)}
    require_own_names(known)
    return {**known, **INPUTS}


def given_with_formats(
    channels: Mapping[str, Any], inputs: Mapping[str, Any], sensors: Sensors
) -> dict[str, tuple[Any, Format]]:
    """The arguments that are not None, with their formats, by quantity."""
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
    arguments = {**channels, **inputs}
    return {name: (value, known[name]) for name, value in arguments.items() if value is not None}


class Conversion(NamedTuple):
    """The conversion of the columns of a quantity to the columns of the format."""

    factor: float = 1.0
    unit: str = ""  # in the file
    attitude_order: str | None = None  # None for quantities other than attitudes
    normalise: bool = False
    attitude_direction: str = DIRECTIONS[0]

    def counts(self, format_counts: tuple[int, ...]) -> tuple[int, ...]:
        """Numbers of columns that the quantity may have in a file, from those of the format."""
        angles = self.attitude_order not in (None, *QUATERNIONS)
        return (3,) if angles else format_counts

    def describe_order(self) -> str:
        """The attitude order, in words, as the reason for the number of columns."""
        words = f"; `attitude_order` is {self.attitude_order!r}"
        return "" if self.attitude_order is None else words

    def apply(self, columns: np.ndarray) -> tuple[np.ndarray, int]:
        """The columns (samples, n) of the format, and the number of normalised samples."""
        order, count = self.attitude_order, columns.shape[1]
        columns = columns * self.factor
        if order is None or not np.isfinite(columns).all() or not len(columns):
            return columns, 0
        turns_back = self.attitude_direction != DIRECTIONS[0]
        if count == 9:
            return columns[:, np.arange(9).reshape(3, 3).T.ravel()] if turns_back else columns, 0
        if order == "xyzw":
            columns = columns[:, [3, 0, 1, 2]]
        elif order not in QUATERNIONS:
            columns = _quaternions(order, columns)
        if turns_back:
            columns = columns * [1, -1, -1, -1]
        length = np.linalg.norm(columns, axis=1)
        scaled = (abs(length - 1) > TOLERANCE) & (length > 0)
        if not (self.normalise and scaled.any()):
            return columns, 0
        return columns / np.where(scaled, length, 1)[:, None], int(np.sum(scaled))


def _quaternions(order: str, angles: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    if order == ROTATION_VECTOR:
        return Rotation.from_rotvec(angles).as_quat(scalar_first=True)
    return Rotation.from_euler(order, angles).as_quat(scalar_first=True)


def require_one_of(name: str, value: Any, allowed: Any) -> None:
    """Check that an argument is one of some words."""
    if not isinstance(value, str) or value not in allowed:
        words = ", ".join(map(repr, allowed))
        raise ValueError(f"Argument `{name}` must be one of {words}, but is {value!r}.")


def require_attitude_order(attitude_order: Any) -> None:
    """Check that attitudes may be written in this order."""
    is_sequence = isinstance(attitude_order, str) and re.fullmatch(
        r"(?!.*(.)\1)([xyz]{3}|[XYZ]{3})", attitude_order
    )
    if attitude_order not in (*QUATERNIONS, ROTATION_VECTOR) and not is_sequence:
        raise ValueError(
            "Argument `attitude_order` must be 'wxyz', 'xyzw', 'rotation_vector', or the axes of "
            "three angles such as 'ZYX', which turn with the body, or 'xyz', which do not, but is "
            f"{attitude_order!r}."
        )


def conversions_of(
    formats: Mapping[str, Format],
    units: Mapping[str, str] | None,
    attitude_order: str,
    attitude_direction: str,
    normalise: bool,
) -> dict[str, Conversion]:
    """The conversion of each quantity.

    Raises
    ------
    ValueError, TypeError
        For unknown units, or an unknown order or direction.
    """
    wanted = _as_units(units, formats)
    require_attitude_order(attitude_order)
    require_one_of("attitude_direction", attitude_direction, DIRECTIONS)
    if not isinstance(normalise, bool):
        raise TypeError(f"Argument `normalise` must be True or False, but is {normalise!r}.")
    conversions = {}
    for name, form in formats.items():
        kind: Any = form if isinstance(form, type) else type(form)
        is_attitude = issubclass(kind, AttitudeSensor)
        has_unit = attitude_order not in QUATERNIONS if is_attitude else form.unit != "rad"
        factors = {form.unit: 1.0, **FACTORS.get(form.unit, {})} if has_unit else {}
        if name in wanted and wanted[name] not in list(factors):  # the unit may not be hashable
            allowed = " or ".join(map(repr, factors)) or "no unit, as it has none"
            raise ValueError(
                f"Argument `units` must give {allowed} for `{name}`, but is {wanted[name]!r}."
            )
        unit = wanted.get(name, form.unit)
        conversion = Conversion(factors.get(unit, 1.0), unit)
        if is_attitude:
            conversion = conversion._replace(
                attitude_order=attitude_order,
                attitude_direction=attitude_direction,
                normalise=normalise,
            )
        conversions[name] = conversion
    return conversions


def _as_units(units: Any, formats: Mapping[str, Format]) -> Mapping[str, str]:
    units = {} if units is None else units
    if not isinstance(units, Mapping) or not set(units) <= set(formats):
        raise ValueError(
            "Argument `units` must be a dictionary of the units of some of "
            f"{', '.join(f'`{name}`' for name in formats)}, but is {units!r}."
        )
    return units
