"""The limits of an experiment, from a file and the options of the command line."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ..identification import Limits, Motors, Torques, Wheels
from .script import Script, call
from .settings import SettingsError, read_toml, require_known

HARDWARE = {"wheels": Wheels, "motors": Motors, "torques": Torques}  # by table of a file
OF_MODEL = "rotors", "model"  # tables as in a file for `lgvi identify --config`
TABLES = *HARDWARE, *OF_MODEL
# The options for arguments of `Limits`.
OPTIONS = {
    "rate": "--max-rate",
    "trajectories": "--throws",
    "initial_rate": "--initial-rate",
    "saturation": "--saturation",
    "turn": "--turn",
}
THROWS = 3  # by default, where nothing commands the body
ARGUMENT = re.compile(r"(?:Argument )?`(\w+)`")  # in an error


@dataclass
class LimitSettings:
    """What limits an experiment.

    Attributes
    ----------
    values
        Arguments of `Limits`.
    hardware
        Arguments of `Wheels`, `Motors` or `Torques` by the name of that table, if there is one.
    of_model
        Tables of the settings of the model.
    names
        For each argument what the user has called it.
    """

    values: dict[str, Any]
    hardware: dict[str, dict[str, Any]]
    of_model: dict[str, dict[str, Any]]
    names: dict[str, str]

    def add_to(self, script: Script) -> None:
        """Add the lines that make the `limits`."""
        arguments = []
        for table, values in self.hardware.items():
            script.add(call(f"{table} = identification.{HARDWARE[table].__name__}", **values))
            arguments.append(f"commands={table}")
        script.add(call("limits = identification.Limits", *arguments, **self.values))

    @contextmanager
    def named(self) -> Iterator[None]:
        """Let errors name options, and keys of the file, instead of arguments of Python."""
        try:
            yield
        except (ValueError, TypeError) as error:
            words = ARGUMENT.sub(lambda name: self.names.get(name[1], name[0]), str(error))
            raise SettingsError(words) from error


def read_limits(file: str | None, options: Mapping[str, Any]) -> LimitSettings:
    """The limits of a file, with those of the command line instead where both have one.

    Raises
    ------
    SettingsError
        For a key that is not known, a table without what it needs, and without a largest rate.
    """
    options = {key: value for key, value in options.items() if value is not None}
    for key, value in options.items():
        if not np.all(np.isfinite(value)):
            raise SettingsError(f"{OPTIONS[key]} must be a finite number, but is {value}")
    tables, names = {}, {"limits": "the limits"}
    if file is not None:
        tables, names["model"] = _read(file), file
    values = {key: value for key, value in tables.items() if key not in TABLES}
    hardware = {key: tables[key] for key in HARDWARE if key in tables}
    for table, entries in hardware.items():
        names |= {key: f"`{key}` in [{table}] of {file}" for key in entries}
    names |= {**OPTIONS, **{key: f"`{key}` of {file}" for key in values if key not in options}}
    values = {"trajectories": 1 if hardware else THROWS, **values, **options}
    if "rate" not in values:
        raise SettingsError(
            "--max-rate must be there, the largest angular rate in rad/s, for an experiment that "
            "is searched for; or `rate` in a file for --limits; or --rates, for one of your own"
        )
    of_model = {key: tables[key] for key in OF_MODEL if key in tables}
    return LimitSettings(values, hardware, of_model, names)


def _read(file: str) -> dict[str, Any]:
    """The tables of a file, and the values at its top, with keys that are known."""
    tables = read_toml(Path(file))
    known = {entry.name: Any for entry in fields(Limits) if entry.name != "commands"}
    require_known(file, tables, {**known, **dict.fromkeys(TABLES, dict[str, Any])})
    hardware = [table for table in HARDWARE if table in tables]
    if len(hardware) > 1:
        raise SettingsError(
            f"{file}: must have one table of hardware, but has {' and '.join(hardware)}"
        )
    for table in hardware:
        where, arguments = f"{file}: [{table}]", fields(HARDWARE[table])
        require_known(where, tables[table], {entry.name: Any for entry in arguments})
        needed = [entry.name for entry in arguments if entry.default is MISSING]
        if missing := [name for name in needed if name not in tables[table]]:
            raise SettingsError(f"{where}: must have {', '.join(missing)} as well")
    return tables
