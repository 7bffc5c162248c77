"""What a run is: the options of the command line and of a file, in one place."""

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

QUANTITIES = (
    *("attitude", "angular_velocity", "specific_force", "magnetic_field", "direction", "position"),
    *("rotor_speed", "rotor_momentum", "body_torque"),
)


class SettingsError(ValueError):
    """An option that is wrong, in words."""


@dataclass
class Settings:
    """The options of a run; those of a file have the same names.

    Attributes
    ----------
    logs
        Files.
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
    mass, centre
        Mass, kg, and centre of mass, m, for URDF and MuJoCo.
    """

    logs: list[str] = field(default_factory=list)
    reader: str | None = None
    read: dict[str, Any] = field(default_factory=dict)
    map: dict[str, list[str]] = field(default_factory=dict)
    unit: dict[str, str] = field(default_factory=dict)
    frame: str | None = None
    space: str | None = None
    attitude_order: str | None = None
    attitude_direction: str | None = None
    duplicates: str | None = None
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
    mass: float | None = None
    centre: list[float] | None = None

    def to_toml(self) -> str:
        """The settings that are not the default, as TOML."""
        plain, tables = [], []
        for key, value in asdict(self).items():
            if value in (None, {}, []):
                continue
            (tables if isinstance(value, dict) else plain).append((key, value))
        lines = [f"{key} = {_as_toml(value)}" for key, value in plain]
        for name, table in tables:
            nested = {key: value for key, value in table.items() if isinstance(value, dict)}
            if set(table) - set(nested):
                lines += ["", f"[{name}]"]
            lines += [f"{_key(k)} = {_as_toml(v)}" for k, v in table.items() if k not in nested]
            for key, inner in nested.items():
                lines += ["", f"[{name}.{_key(key)}]"]
                lines += [f"{_key(k)} = {_as_toml(v)}" for k, v in inner.items()]
        return "\n".join(lines) + "\n"


def _key(key: str) -> str:
    return key if key.replace("_", "").isalnum() and key.isascii() else _as_toml(key)


def _as_toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in escaped) + '"'
    if isinstance(value, Sequence):
        return f"[{', '.join(map(_as_toml, value))}]"
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
        values = _read(Path(config))
    for key, value in options.items():
        if value in (None, (), [], {}):
            continue
        before = values.get(key)
        both = isinstance(value, Mapping) and isinstance(before, Mapping)
        values[key] = {**dict(before or {}), **value} if both else value
    settings = Settings(**values)
    for quantity in (*settings.map, *settings.unit, *settings.sigma, *settings.sensors):
        if quantity not in QUANTITIES:
            raise SettingsError(f"there is no quantity `{quantity}`; there are {_words()}")
    return settings


def _words() -> str:
    return ", ".join(QUANTITIES)


KINDS = {"list": list, "dict": dict, "str": str, "float": (int, float)}


def _read(path: Path) -> dict[str, Any]:
    try:
        values = tomllib.loads(path.read_text("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: must be TOML, but is not: {error}") from None
    known = {entry.name: str(entry.type) for entry in fields(Settings)}
    for key, value in values.items():
        if key not in known:
            raise SettingsError(f"{path}: there is no option `{key}`; there are {', '.join(known)}")
        kind = next((kinds for name, kinds in KINDS.items() if known[key].startswith(name)), object)
        if not isinstance(value, kind) or isinstance(value, bool):
            raise SettingsError(f"{path}: `{key}` must be {known[key]}, but is {value!r}")
    values["map"] = {
        name: [names] if isinstance(names, str) else names
        for name, names in values.get("map", {}).items()
    }
    return values


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
        if not sign or not key.strip() or not value.strip():
            raise SettingsError(f"{option} must be like quantity=value, but is {word!r}")
        pairs[key.strip()] = value.strip()
    return pairs


def parse_numbers(option: str, text: str) -> list[float]:
    """Numbers apart by commas.

    Raises
    ------
    SettingsError
        For a word that is no number.
    """
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise SettingsError(f"{option} must be numbers such as 1,2,2.8, but is {text!r}") from None


def parse_value(text: str) -> Any:
    """A number where the text is one, else the text."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
