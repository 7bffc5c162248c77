"""A log: its signals, what its file says of itself, and what was assumed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..modules.units import split_unit
from .conversion import Conventions, Interval, make_recordings
from .signal import LogError, Signal, list_names
from .writing import write_table

if TYPE_CHECKING:
    from ..identification import Recordings


@dataclass(frozen=True)
class Log:
    """A log: signals, and what the file says of itself.

    Attributes
    ----------
    path
        The file or folder.
    kind
        The format, in words, such as "PX4 ULog".
    signals
        The signals by name.
    start
        Date and time of the zero of the times, in UTC; None if the file does not tell.
    facts
        What the file says of itself: firmware, device, parameters.
    armed
        Intervals (begin, end), s, in which the vehicle was armed; None if the file does not tell.
    assumed
        What was recognised or assumed, in words.
    """

    path: str
    kind: str
    signals: Mapping[str, Signal]
    start: datetime | None = None
    facts: Mapping[str, str] = field(default_factory=dict)
    armed: tuple[tuple[float, float], ...] | None = None
    assumed: tuple[str, ...] = ()

    def signal(self, names: str | Sequence[str]) -> Signal:
        """The signal of a name, or one signal of several names, one for each component.

        A component of a signal has the name `"gyro.x"`, or `"gyro[x]"`. A column of a file has the
        name of its header, with or without the unit: `"wheel_rpm"`, or `"wheel"`.

        Raises
        ------
        LogError
            If a signal is not there, or components differ in their times, unit or axes.
        """
        if not isinstance(names, str):
            if not names:
                raise LogError(self.path, "must have names of signals, but none are given")
            return self._join([self.signal(name) for name in names])
        if names in self.signals:
            return self.signals[names]
        in_brackets = names.endswith("]")
        whole, _, component = names.removesuffix("]").rpartition("[" if in_brackets else ".")
        signal = self.signals.get(whole)
        if signal is not None and component in signal.components:
            values = signal.values[:, signal.components.index(component)]
            return replace(signal, name=names, values=values, quantity="", components=(), order="")
        name, unit = split_unit(names)  # as in the header of the file
        if unit and name in self.signals and self.signals[name].unit == unit:
            return self.signals[name]
        raise LogError(
            self.path, f"is not there; there are {list_names(self.names())}", f"signal `{names}`"
        )

    def _join(self, signals: Sequence[Signal]) -> Signal:
        """One signal of several, which are its components."""
        first = signals[0]
        for signal in signals[1:]:
            place = f"signals `{first.name}` and `{signal.name}`"
            if not np.array_equal(signal.times, first.times):
                raise LogError(self.path, "must have the same times, but have not", place)
            for key in ("unit", "frame", "space"):
                pair = getattr(first, key), getattr(signal, key)
                if pair[0] != pair[1]:
                    words = f"must have the same {key}, but have {pair[0]!r} and {pair[1]!r}"
                    raise LogError(self.path, words, place)
        if len(signals) == 1:
            return first
        values = np.column_stack([signal.values for signal in signals])
        name = ", ".join(signal.name for signal in signals)
        return replace(first, name=name, values=values, quantity="", components=(), order="")

    def recordings(
        self,
        *,
        units: Mapping[str, str] | None = None,
        frame: str | None = None,
        space: str | None = None,
        attitude_order: str | None = None,
        attitude_direction: str | None = None,
        intervals: Sequence[tuple[str, float, float]] | None = None,
        duplicates: str = "error",
        sensors: Any = (),
        **quantities: str | Sequence[str],
    ) -> "Recordings":
        """Recordings of some signals, in the units and axes of the library.

        Parameters
        ----------
        units
            Units by quantity, for signals whose unit the file does not tell, or tells wrongly, such
            as `{"angular_velocity": "deg/s"}`; as for `Recordings.from_csv`. Of counts the unit has
            the size of a count in front, such as `"0.061 deg/s"`.
        frame
            The axes of the body in which the recordings are: `"FLU"` or `"FRD"`. By default those
            of the first signal that tells its axes.
        space
            The axes of space: `"ENU"` or `"NED"`; by default those of the file.
        attitude_order
            As for `Recordings.from_csv`, where the file does not tell.
        attitude_direction
            `"body to space"` or `"space to body"`; by default the first, where the file does not
            tell.
        intervals
            For each trajectory its name, its first and its last time, s, such as the flights that
            [`find_free_flights`][lgvi.logs.find_free_flights] returns. By default the whole log is
            one trajectory.
        duplicates
            As for `Recordings.from_csv`.
        sensors
            As for `Recordings.from_csv`.
        **quantities
            For each quantity the name of its signal, or the names of its components, such as
            `angular_velocity="gyro"` or `angular_velocity=("gx", "gy", "gz")`.

        Returns
        -------
        Recordings
            The recordings; `provenance` says what was read and what was assumed.

        Raises
        ------
        LogError
            If a signal is not there, or a unit or order is needed that the file does not tell.
        ValueError
            For an argument that is not one of those above.
        """
        if not quantities:
            raise ValueError(
                "Argument `quantities` must name a signal at least, such as "
                f"`angular_velocity=...`; there are {list_names(self.names())}."
            )
        conventions = Conventions(units or {}, frame, space, attitude_order, attitude_direction)
        parts = None if intervals is None else [Interval(*interval) for interval in intervals]
        signals = {quantity: self.signal(names) for quantity, names in quantities.items()}
        words = f"{self.path}: {self.kind}", *self.assumed
        return make_recordings(self.path, signals, conventions, parts, duplicates, sensors, words)

    def write(self, path: str | PathLike[str], signals: Sequence[str] | None = None) -> None:
        """Write signals to a CSV or Parquet file.

        Parameters
        ----------
        path
            The file, whose ending `.csv` or `.parquet` says the format. It has a column `t`, s,
            with the times of all signals, and a column for each component with its unit, which is
            empty where the signal has no sample.
        signals
            Names of the signals; by default all.

        Raises
        ------
        LogError
            If a signal is not there, or has several samples at one time.
        ValueError
            For another ending, or a table that would be too large.
        """
        write_table([self.signal(name) for name in signals or self.signals], Path(path), self.path)

    def names(self) -> list[str]:
        """The names of the signals, with components in brackets."""
        return [
            f"{name} ({', '.join(signal.components)})" if signal.components else name
            for name, signal in self.signals.items()
        ]
