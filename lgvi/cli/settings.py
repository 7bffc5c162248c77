"""What a run is: the options of the command line and of a file, in one place."""

import math
import os
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin

QUANTITIES = (
    *("attitude", "angular_velocity", "specific_force", "magnetic_field", "direction", "position"),
    *("rotor_speed", "rotor_momentum", "body_torque"),
)


ONLY = "*"  # in the place of a quantity where there is one alone
WAYS = None, "auto", "whole"  # to find flights without a table of times


class SettingsError(ValueError):
    """An option that is wrong, in words."""


@dataclass
class Settings:
    """The options of a run; those of a file have the same names.

    Paths in a file are from the folder of that file.

    Attributes
    ----------
    logs
        Files.
    sha256
        Of logs by path, as they were in the run that the settings are of.
    reader
        The format, where it shall not be recognised.
    read
        Options of the reader, such as `time_unit`.
    map
        For each quantity the names of its signals.
    unit
        Units by quantity.
    frame, space, attitude_order, attitude_direction, duplicates
        As for `Log.recordings`.
    trajectory
        The column that names the trajectories, in CSV files that have several.
    flights
        `"auto"`, `"whole"`, or a table of times in a file.
    begin, end
        Times in the log, s, between which is one trajectory.
    free
        What is estimated beside the inertia.
    sigma
        Noise of sensors, by quantity.
    sensors, rotors, model
        Arguments of sensors by quantity, of `Multirotor` and of `Model`.
    rotor, axis, rotor_inertia
        The signal of the speed of a rotor, its axis, and its spin inertia, kg m².
    moments
        Principal moments of the body from which the fit starts, kg m².
    hold_out
        The part of the trajectories that is kept back.
    errors
        The kind of standard errors.
    check
        `False` to fit a log that has a usual mistake as it is.
    mass, centre
        Mass, kg, and centre of mass, m, for URDF and MuJoCo; the mass also where there are rotors.
    """

    logs: list[str] = field(default_factory=list)
    sha256: dict[str, str] = field(default_factory=dict)
    reader: str | None = None
    read: dict[str, Any] = field(default_factory=dict)
    map: dict[str, list[str]] = field(default_factory=dict)
    unit: dict[str, str] = field(default_factory=dict)
    frame: str | None = None
    space: str | None = None
    attitude_order: str | None = None
    attitude_direction: str | None = None
    duplicates: str | None = None
    trajectory: str | None = None
    flights: str | None = None
    begin: float | None = None
    end: float | None = None
    free: list[str] = field(default_factory=list)
    sigma: dict[str, float] = field(default_factory=dict)
    sensors: dict[str, dict[str, Any]] = field(default_factory=dict)
    rotors: dict[str, Any] = field(default_factory=dict)
    model: dict[str, Any] = field(default_factory=dict)
    rotor: str | None = None
    axis: Any = None
    rotor_inertia: float | None = None
    moments: list[float] | None = None
    hold_out: float | None = None
    errors: str | None = None
    check: bool | None = None
    mass: float | None = None
    centre: list[float] | None = None

    def with_paths(self, move: Callable[[str], str]) -> "Settings":
        """The settings with other paths of files."""
        return replace(
            self,
            logs=[move(path) for path in self.logs],
            sha256={move(path): digest for path, digest in self.sha256.items()},
            flights=self.flights if self.flights in WAYS else move(self.flights),
        )

    def to_toml(self) -> str:
        """The settings that are not the default, as TOML."""
        lines, tables = [], []
        for key, value in asdict(self).items():
            if value in (None, {}, []):
                continue
            if isinstance(value, dict):
                tables += [
                    "",
                    f"[{key}]",
                    *(f"{_key(k)} = {_as_toml(v)}" for k, v in value.items()),
                ]
            else:
                lines.append(f"{key} = {_as_toml(value)}")
        return "\n".join([*lines, *tables]) + "\n"


def _key(key: str) -> str:
    return key if key.replace("_", "").isalnum() and key.isascii() else _as_toml(key)


def _as_toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'
    if isinstance(value, Sequence):
        return f"[{', '.join(map(_as_toml, value))}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_key(k)} = {_as_toml(v)}' for k, v in value.items())}}}"
    return repr(value)


def make_settings(options: Mapping[str, Any], config: str | None) -> Settings:
    """The settings of a file, with those of the command line instead where both have one.

    Raises
    ------
    SettingsError
        For a key that is not known, or a value of the wrong kind.
    """
    values: dict[str, Any] = {}
    if config is not None:
        folder = Path(config).parent
        of_file = Settings(**_read(Path(config)))
        of_file = of_file.with_paths(lambda path: os.path.normpath(folder / path))
        values = {entry.name: getattr(of_file, entry.name) for entry in fields(Settings)}
    for key, value in options.items():
        if value in (None, (), [], {}):
            continue
        before = values.get(key)
        both = isinstance(value, Mapping) and isinstance(before, Mapping)
        values[key] = {**dict(before or {}), **value} if both else value
        if isinstance(value, float) and not math.isfinite(value):
            raise SettingsError(f"--{key.replace('_', '-')} must be a number, but is {value}")
    settings = Settings(**values)
    for quantity in (*settings.map, *settings.unit, *settings.sigma, *settings.sensors):
        if quantity not in (*QUANTITIES, ONLY):
            words = ", ".join(QUANTITIES)
            raise SettingsError(f"there is no quantity `{quantity}`; there are {words}")
    for quantity in options.get("sigma", ()):  # the command line comes first
        settings.sensors.get(quantity, {}).pop("sigma", None)
    if settings.hold_out is not None and not 0 < settings.hold_out < 1:
        raise SettingsError(f"--hold-out must be above 0 and below 1, but is {settings.hold_out}")
    begin, end = settings.begin, settings.end
    if begin is not None and end is not None and begin >= end:
        raise SettingsError(f"--to must be after --from, {begin}, but is {end}")
    for name in ("axis", "rotor_inertia"):
        if getattr(settings, name) is not None and settings.rotor is None:
            raise SettingsError(f"--{name.replace('_', '-')} needs the signal of the --rotor")
    return settings


def _read(path: Path) -> dict[str, Any]:
    values = read_toml(path)
    if isinstance(values.get("map"), dict):
        values["map"] = {
            name: [names] if isinstance(names, str) else names
            for name, names in values["map"].items()
        }
    require_known(str(path), values, {entry.name: entry.type for entry in fields(Settings)})
    return values


def read_toml(path: Path) -> dict[str, Any]:
    """The values of a file.

    Raises
    ------
    SettingsError
        If the file is not TOML.
    """
    try:
        return tomllib.loads(path.read_text("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: must be TOML, but is not: {error}") from None


def require_known(where: str, values: Mapping[str, Any], known: Mapping[str, Any]) -> None:
    """Check that values of TOML have keys that are known, and are of their kinds."""
    for key, value in values.items():
        if key not in known:
            words = ", ".join(known)
            raise SettingsError(f"{where}: there is no option `{key}`; there are {words}")
        if not _is_of(value, known[key]):
            kind = str(known[key]).replace("typing.", "")
            raise SettingsError(f"{where}: `{key}` must be of the kind {kind}, but is {value!r}")


def _is_of(value: Any, kind: Any) -> bool:
    """Whether a value of TOML is of the kind of a field, with finite numbers and no dates."""
    of = get_args(kind)
    if get_origin(kind) is UnionType:
        return any(_is_of(value, part) for part in of)
    if isinstance(value, dict):
        is_table = kind is Any or get_origin(kind) is dict
        return is_table and all(_is_of(part, of[1] if of else Any) for part in value.values())
    if isinstance(value, list):
        is_list = kind is Any or get_origin(kind) is list
        return is_list and all(_is_of(part, of[0] if of else Any) for part in value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return isinstance(value, str | bool) if kind is Any else kind is type(value)
    return kind in (Any, float) and math.isfinite(value)


def parse_pairs(option: str, words: Sequence[str]) -> dict[str, str]:
    """Options of the form `quantity=value`.

    Raises
    ------
    SettingsError
        For a word without an equals sign.
    """
    pairs = {}
    for word in words:
        key, sign, value = word.partition("=")
        if not sign or not key.strip() or not value:
            raise SettingsError(f"{option} must be like name=value, but is {word!r}")
        if key.strip() in pairs:
            raise SettingsError(
                f"{option} must be there once for {key.strip()}, but is there twice"
            )
        pairs[key.strip()] = value.strip() or value
    return pairs


def parse_names(words: Sequence[str]) -> list[str]:
    """Names apart by commas, in one option or several."""
    return [part.strip() for word in words for part in word.split(",")]


def parse_sigma(words: Sequence[str]) -> dict[str, float]:
    """The noise of each sensor, above 0.

    Raises
    ------
    SettingsError
        For what is not one number above 0.
    """
    noise = {}
    for quantity, text in parse_pairs("--sigma", words).items():
        numbers = parse_numbers("--sigma", text)
        if len(numbers) != 1 or numbers[0] <= 0:
            raise SettingsError(f"--sigma {quantity} must be a number above 0, but is {text!r}")
        noise[quantity] = numbers[0]
    return noise


def parse_numbers(option: str, text: str) -> list[float]:
    """Numbers apart by commas.

    Raises
    ------
    SettingsError
        For a word that is no number.
    """
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = [math.nan]
    if not all(map(math.isfinite, numbers)):
        raise SettingsError(f"{option} must be numbers such as 1,2,2.8, but is {text!r}")
    return numbers


def parse_value(text: str) -> Any:
    """A number where the text is one, else the text."""
    for kind in (int, float):
        try:
            value = kind(text)
        except ValueError:
            continue
        return value if math.isfinite(value) else text
    return text
