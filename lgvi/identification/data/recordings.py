"""Recorded motion of a body: readings, their times and their trajectories."""

from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from html import escape
from numbers import Integral
from os import PathLike
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Bool, Float

from ...modules.printing import as_table
from ...modules.sensors.sensor import Sensors
from .delimited import Dialect, read_table
from .formats import INPUTS, conversions_of, given_with_formats
from .parquet import Folder, StoredSamples
from .sample_checks import Duplicates, as_samples, require_complete
from .samples import AbstractSamples, OfTrajectory, Samples, reading_times
from .table import Column, Columns, TimeUnit, Timing, describe_changed

MOST_ROWS = 20  # of a table in a notebook
JUMP = 1e-4  # part of an interval in which an input that was held goes to the next value


class Recordings(eqx.Module):
    """One or many recorded trajectories of a body, immutable.

    Make one with `from_arrays` or `from_csv`, and many with `from_csv`, `open` or `concatenate`;
    `merge` joins the recordings of one flight in several files.
    Each quantity has times of its own; trajectories may differ in length and need not be sampled
    evenly.

    Attributes
    ----------
    channels
        Readings of sensors by the names of their channels: under `"attitude"` rotations
        (samples, 3, 3), under `"angular_velocity"` vectors (samples, 3), rad/s.
    body_torque
        Torques (samples, 3), body frame, N m, linear between the samples; or None.
    rotor_momentum
        Momenta of rotors relative to the body (samples, 3), body frame, kg m²/s, linear between
        the samples; or None. Speeds suffice where the inertia of rotors is estimated, and one
        column of speeds (samples, 1) where the axis is in the model.
    rotor_speed
        Speeds of the rotors of a [`Multirotor`][lgvi.Multirotor] (samples, rotors), rad/s, or
        commands, linear between the samples; or None.
    names
        A name for each trajectory.
    dropped
        What was dropped by request, in words.
    provenance
        Where the samples come from: files, signals, and what was assumed about them, in words.
    """

    channels: OrderedDict[str, AbstractSamples]
    body_torque: AbstractSamples | None
    rotor_momentum: AbstractSamples | None
    rotor_speed: AbstractSamples | None
    names: tuple[str, ...] = eqx.field(static=True)
    dropped: tuple[str, ...] = eqx.field(default=(), static=True)
    provenance: tuple[str, ...] = eqx.field(default=(), static=True)

    @classmethod
    def from_arrays(
        cls,
        t: Any = None,
        *,
        body_torque: Any = None,
        rotor_momentum: Any = None,
        rotor_speed: Any = None,
        name: str = "0",
        sensors: Sensors = (),
        **channels: Any,
    ) -> "Recordings":
        """One trajectory; `concatenate` puts several together.

        Parameters
        ----------
        t
            Times (samples,), s, increasing, of all quantities without times of their own.
        body_torque
            Torques (samples, 3), body frame, N m, which must cover the times of all readings. A
            tuple `(t, body_torque)` gives separate times, as for all arguments that follow.
        rotor_momentum
            Momenta of rotors (samples, 3), body frame, kg m²/s, or speeds; or speeds of one rotor
            (samples,), rad/s. The samples must cover the times of all readings.
        rotor_speed
            Speeds of the rotors of a [`Multirotor`][lgvi.Multirotor] (samples, rotors), rad/s, or
            commands, none negative, for at most 16 rotors, which must cover the same times.
        name
            Name of the trajectory.
        sensors
            Kinds of sensors, such as a class of your own, or a mapping of names of channels to
            kinds; in addition to the sensors of the library.
        **channels
            Readings of each sensor under the name of its channel: `attitude`, body to space, as
            unit quaternions (samples, 4), scalar first, as matrices (samples, 3, 3), or as an
            object with `as_matrix()`, such as `scipy.spatial.transform.Rotation` and `jaxlie.SO3`;
            `angular_velocity` (samples, 3), body frame, rad/s; `specific_force`, `magnetic_field`,
            `direction` and `position` (samples, 3); and those of other `sensors`.
            Quaternions and matrices may be off by 1e-3, and are normalised.

        Returns
        -------
        Recordings
            The trajectory.

        Raises
        ------
        ValueError, TypeError
            For malformed input; the message names the argument and the sample.
        """
        inputs = {
            "body_torque": body_torque,
            "rotor_momentum": rotor_momentum,
            "rotor_speed": rotor_speed,
        }
        arguments = given_with_formats(channels, inputs, sensors)
        samples = {
            quantity: as_samples(quantity, form, t, value)
            for quantity, (value, form) in arguments.items()
        }
        return stack_trajectories([samples], (str(name),))

    @classmethod
    def from_csv(
        cls,
        file: str | PathLike[str],
        *,
        body_torque: Sequence[Column] | None = None,
        rotor_momentum: Column | Sequence[Column] | None = None,
        rotor_speed: Sequence[Column] | None = None,
        t: Column = "t",
        time_unit: TimeUnit = "s",
        trajectory: Column | None = None,
        duplicates: Duplicates = "error",
        delimiter: str = ",",
        decimal: str = ".",
        missing: Sequence[str] = (),
        comment: str | None = None,
        skip_lines: int = 0,
        units: Mapping[str, str] | None = None,
        attitude_order: str = "wxyz",
        attitude_direction: str = "body to space",
        normalise: bool = False,
        sensors: Sensors = (),
        **channels: Sequence[Column] | None,
    ) -> "Recordings":
        """All trajectories of a CSV file, in UTF-8 or UTF-16.

        A column is a name in the header, which may be in a comment, or the number of the column,
        counted from 0. Where all columns are numbers, a file needs no header.

        Parameters
        ----------
        file
            The file. A line with only empty cells of a quantity has no sample of the quantity.
        body_torque, rotor_momentum
            Three columns, units and frames as in `from_arrays`; or the single column of the speeds
            of a rotor.
        rotor_speed
            The columns, one for each rotor, at most 16.
        t
            The column of times, increasing within a trajectory.
        time_unit
            Unit of the times in the file, `"s"`, `"ms"`, `"us"`, `"ns"` or `"min"`; in the
            recordings times are in s. A warning tells if the column has another unit in the name.
        trajectory
            The column of the names of trajectories. The default is `trajectory`, and a file
            without that column is one trajectory.
        duplicates
            What to do with consecutive samples of a quantity at the same time: raise an `"error"`,
            keep the `"first"` sample, or take the `"mean"`, for rotations the rotation nearest to
            the mean. `dropped` tells the number of these samples.
        delimiter
            What separates the cells: one of `,`, `;`, `|`, a tab and a space. Several spaces
            count as one.
        decimal
            The decimal mark, a point or a comma.
        missing
            Cells that stand for a missing number, as empty cells do, such as `("NaN", "-")`.
        comment
            The beginning of lines that are not read, such as `#`; by default all lines are read.
        skip_lines
            Number of lines at the beginning that are not read.
        units
            Units in the file, by quantity, where these differ from the library, such as
            `{"angular_velocity": "deg/s", "position": "mm"}`: of rates and speeds `deg/s`, `rpm` or
            `rev/s`; of specific forces `g` or `mg`; of positions `cm` or `mm`; of magnetic fields
            `mT`, `uT`, `nT`, `G` or `mG`; of torques `mN m`; of attitudes by angles `deg`. A
            warning tells if the name of a column ends with another of these units.
        attitude_order
            How attitudes are written in four or three columns: as quaternions `"wxyz"` or, scalar
            last, `"xyzw"`; as a `"rotation_vector"`, rad; or as three angles, rad, about the axes
            of a sequence such as `"ZYX"`, each of which the turns before have turned (intrinsic),
            or `"xyz"`, which stay (extrinsic).
        attitude_direction
            `"body to space"`, or `"space to body"` for a file whose attitudes take vectors to the
            body.
        normalise
            Whether quaternions of any length are accepted, and normalised; by default a length that
            is off by more than 1e-3 is an error. `dropped` tells the number of these quaternions.
        sensors
            As for `from_arrays`.
        **channels
            The columns of each sensor, under the name of its channel: for `attitude` four
            of a unit quaternion, or nine of a matrix, row by row, or three, see `attitude_order`;
            for other sensors of the library three.

        Returns
        -------
        Recordings
            The trajectories, in the order of their first lines.

        Raises
        ------
        ValueError, TypeError
            For malformed input; the message names the file, the line and the column.
        """
        arguments = channels, body_torque, rotor_momentum, rotor_speed, sensors
        columns = _columns(*arguments, units, attitude_order, attitude_direction, normalise)
        timing = Timing(t, time_unit, duplicates)
        dialect = Dialect(timing, trajectory, delimiter, comment, decimal, missing, skip_lines)
        trajectories, changed = read_table(file, columns, dialect)
        words = describe_changed(changed)
        try:
            return stack_trajectories(
                list(trajectories.values()), tuple(trajectories), words, (f"file {file}",)
            )
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from error

    @classmethod
    def open(
        cls,
        folder: str | PathLike[str],
        *,
        body_torque: Sequence[str] | None = None,
        rotor_momentum: str | Sequence[str] | None = None,
        rotor_speed: Sequence[str] | None = None,
        t: str = "t",
        time_unit: TimeUnit = "s",
        duplicates: Duplicates = "error",
        units: Mapping[str, str] | None = None,
        attitude_order: str = "wxyz",
        attitude_direction: str = "body to space",
        normalise: bool = False,
        sensors: Sensors = (),
        **channels: Sequence[str] | None,
    ) -> "Recordings":
        """Trajectories in a folder of Parquet files, which stay there and may exceed the memory.

        All files are read and checked once, and each file is read again whenever it is needed.
        `select` and `drop` leave trajectories in the files; all other methods that return
        recordings put the trajectories in memory, as do `load` and the attributes `times` and
        `values` of the channels.

        Parameters
        ----------
        folder
            The folder. Each file `*.parquet` is a trajectory, whose name is that of the file
            without its ending; trajectories are in the order of their names. A row with only null
            cells of a quantity has no sample of the quantity.
        body_torque, rotor_momentum, rotor_speed, t, time_unit, duplicates
            As for `from_csv`.
        units, attitude_order, attitude_direction, normalise, sensors, **channels
            As for `from_csv`.

        Returns
        -------
        Recordings
            The trajectories.

        Raises
        ------
        ValueError, TypeError
            For malformed input; the message names the file, the row, counted from 0, and the
            column. Also later, for a file that has changed.
        """
        arguments = channels, body_torque, rotor_momentum, rotor_speed, sensors
        columns = _columns(*arguments, units, attitude_order, attitude_direction, normalise)
        timing = Timing(t, time_unit, duplicates)
        stored = Folder(folder, columns, timing)
        inputs = [name for name in columns if name in INPUTS]
        counts, changed = [], Counter[tuple[str, str]]()
        for i, file in enumerate(stored.files):
            table = stored.read_table(i)
            (samples,) = table.trajectories.values()
            try:
                readings = [name for name in columns if name not in INPUTS]
                require_complete(file.stem, samples, readings, inputs)
            except ValueError as error:
                raise ValueError(f"{file}: {error}") from None
            counts.append([len(samples[name][0]) for name in columns])
            changed.update(table.changed)
        joined = {
            name: StoredSamples(count, np.arange(len(stored.files)), stored, name)
            for name, count in zip(columns, np.array(counts).T, strict=True)
        }
        return cls(
            OrderedDict((name, x) for name, x in joined.items() if name not in INPUTS),
            **{name: joined.get(name) for name in INPUTS},
            names=tuple(file.stem for file in stored.files),
            dropped=describe_changed(changed),
            provenance=(f"folder {folder}",),
        )

    @classmethod
    def concatenate(cls, recordings: Iterable["Recordings"]) -> "Recordings":
        """Recordings of the trajectories of several recordings.

        Names that occur twice get the number of the recording in front.

        Raises
        ------
        ValueError
            If there are no recordings; or if all have the same names, but no quantity in common:
            the recordings may be one flight in several files, which `merge` joins.
        """
        recordings = _as_several(recordings)
        quantities = [name for part in recordings for name in part.quantities]
        are_apart = len(recordings) > 1 and len(set(quantities)) == len(quantities)
        if are_apart and len({part.names for part in recordings}) == 1:
            raise ValueError(
                "Argument `recordings` must have a quantity in common, or other names, but has "
                f"{', '.join(f'`{name}`' for name in quantities)} of trajectories of the same "
                "names: `Recordings.merge` puts one flight in several files together; "
                "trajectories of other flights need names of their own, such as by "
                "`dataclasses.replace(recordings, names=('second',))`."
            )
        names = [name for part in recordings for name in part.names]
        if len(set(names)) < len(names):
            names = [f"{i}:{name}" for i, part in enumerate(recordings) for name in part.names]
        return stack_trajectories(
            [trajectory for part in recordings for trajectory in part],
            tuple(names),
            *_words_of(recordings),
        )

    @classmethod
    def merge(cls, recordings: Iterable["Recordings"]) -> "Recordings":
        """Recordings of the quantities of several recordings, which have the same trajectories.

        One use is a flight in several files, such as those of a camera and a gyroscope. All times
        are of one clock; the `time_offset` of a sensor compensates a difference of clocks.

        Parameters
        ----------
        recordings
            Recordings of trajectories with the same names; or recordings of single trajectories,
            which get the name of the first.

        Returns
        -------
        Recordings
            The trajectories, in the order of the first recordings.

        Raises
        ------
        ValueError, TypeError
            If there are no recordings, two recordings have the same quantity, the names differ, or
            the times of a trajectory do not overlap.
        """
        recordings = _as_several(recordings)
        first, *others = recordings
        quantities = [name for part in recordings for name in part.quantities]
        if twice := [name for name in quantities if quantities.count(name) > 1]:
            raise ValueError(
                f"Argument `recordings` must have each quantity once, but `{twice[0]}` is in "
                "several: `concatenate` puts different trajectories together."
            )
        trajectories = [dict(trajectory) for trajectory in first]
        for part in others:
            single = len(first) == len(part) == 1
            if not single and sorted(part.names) != sorted(first.names):
                raise ValueError(
                    "Argument `recordings` must have trajectories of the same names, but has "
                    f"{list(first.names)} and {list(part.names)}."
                )
            for name, trajectory in zip(first.names, trajectories, strict=True):
                other = part[0 if single else name]
                _require_overlap(name, trajectory, other)
                trajectory |= other
        return stack_trajectories(trajectories, first.names, *_words_of(recordings))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def quantities(self) -> dict[str, AbstractSamples]:
        """All recorded quantities: the channels, and the recorded torques and rotors."""
        inputs = {name: getattr(self, name) for name in INPUTS}
        return {**self.channels, **{name: x for name, x in inputs.items() if x is not None}}

    @property
    def are_stored(self) -> bool:
        """Whether the trajectories are in files, which may exceed the memory."""
        return any(isinstance(samples, StoredSamples) for samples in self.channels.values())

    def reading_times(self) -> list[Float[np.ndarray, " times"]]:
        """The times of all readings of each trajectory, without duplicates, increasing."""
        return list(map(self.times_of, self))

    def times_of(self, trajectory: OfTrajectory) -> Float[np.ndarray, " times"]:
        """The times of all readings of a trajectory, without duplicates, increasing."""
        return reading_times([trajectory[channel] for channel in self.channels])

    def __getitem__(self, trajectory: int | str) -> OfTrajectory:
        """A trajectory by its number or name, as a dictionary of `(t, values)` by quantity.

        Raises
        ------
        KeyError
            If there is no trajectory of this name.
        IndexError
            If there is no trajectory of this number; negative numbers count from the last.
        """
        if isinstance(trajectory, str):
            if trajectory not in self.names:
                raise KeyError(self._unknown(trajectory))
            trajectory = self.names.index(trajectory)
        if not -len(self) <= trajectory < len(self):
            raise IndexError(f"There is no trajectory {trajectory}: there are {len(self)}.")
        number = range(len(self))[trajectory]
        return self.reader()(number)

    def reader(self) -> Callable[[int], OfTrajectory]:
        """A function that gives a trajectory by its number, from 0 on, for loops over many."""
        quantities = {name: samples.of for name, samples in self.quantities.items()}
        return lambda number: {name: of(number) for name, of in quantities.items()}

    def __iter__(self) -> Iterator[OfTrajectory]:
        """A dictionary of `(t, values)` by quantity for each trajectory."""
        quantities = self.quantities
        for samples in zip(*quantities.values(), strict=True):
            yield dict(zip(quantities, samples, strict=True))

    def load(self) -> "Recordings":
        """The recordings in memory, if the trajectories are in files."""
        return self._rebuilt(list(self), self.names) if self.are_stored else self

    def __str__(self) -> str:
        counts = [
            f"{np.sum(samples.count)} of {name.replace('_', ' ')}"
            for name, samples in self.quantities.items()
        ]
        count = "1 trajectory" if len(self) == 1 else f"{len(self)} trajectories"
        text = f"{count}; samples: {', '.join(counts)}"
        return f"{text}; dropped: {'; '.join(self.dropped)}" if self.dropped else text

    def __repr__(self) -> str:
        return f"Recordings({self})"

    def _repr_html_(self) -> str:
        """A line for each trajectory, for notebooks."""
        quantities = self.quantities
        head = ["trajectory", "duration (s)", *(f"samples of {name}" for name in quantities)]
        rows: list[tuple[str | int, ...]] = []
        for i, (name, trajectory) in enumerate(zip(self.names[:MOST_ROWS], self, strict=False)):
            t = self.times_of(trajectory)
            counts = (int(samples.count[i]) for samples in quantities.values())
            rows.append((name, f"{t[-1] - t[0]:.4g}", *counts))
        if len(self) > MOST_ROWS:
            rows.append(("...", *[""] * (len(head) - 1)))
        return f"<b>Recordings</b>: {escape(str(self))}{as_table(head, rows)}"

    def only(self, trajectories: np.ndarray, *dropped: str) -> "Recordings":
        """Some trajectories by their numbers, with more dropped data, in words."""
        parts = {name: samples.only(trajectories) for name, samples in self.quantities.items()}
        return Recordings(
            OrderedDict((channel, parts[channel]) for channel in self.channels),
            **{name: parts.get(name) for name in INPUTS},
            names=tuple(self.names[i] for i in trajectories),
            dropped=(*self.dropped, *dropped),
            provenance=self.provenance,
        )

    def _rebuilt(
        self,
        trajectories: Sequence[OfTrajectory],
        names: Sequence[str],
        dropped: Sequence[str] = (),
    ) -> "Recordings":
        """Recordings of other trajectories, with all data dropped so far, in words."""
        words = (*self.dropped, *dropped)
        return stack_trajectories(trajectories, tuple(names), words, self.provenance)

    def select(
        self,
        which: Iterable[str] | Callable[[OfTrajectory], bool],
        reason: str = "not selected",
    ) -> "Recordings":
        """Recordings of only some trajectories; the others are counted in `dropped`.

        Parameters
        ----------
        which
            Names of trajectories, or a function that tells whether to keep a trajectory, which is
            a dictionary of `(t, values)` by quantity, such as
            `lambda samples: len(samples["attitude"][0]) > 20`.
        reason
            Why the others are left out, in words.

        Raises
        ------
        ValueError
            If a name is not that of a trajectory, or no trajectory is left.
        """
        if callable(which):
            return self._with_only([bool(which(trajectory)) for trajectory in self], reason)
        names = [which] if isinstance(which, str) else list(which)
        self._require_names(names, "select")
        return self._with_only([name in names for name in self.names], reason)

    def _unknown(self, name: str, purpose: str = "") -> str:
        known = ", ".join(map(repr, self.names[:9])) + (", ..." if len(self) > 9 else "")
        return f"There is no trajectory {name!r}{purpose}; there are {known}."

    def _require_names(self, names: Sequence[str], verb: str) -> None:
        if unknown := [name for name in names if name not in self.names]:
            raise ValueError(self._unknown(unknown[0], f" to {verb}"))

    def _with_only(self, kept: Sequence[bool], reason: str) -> "Recordings":
        left_out = [name for name, keep in zip(self.names, kept, strict=True) if not keep]
        if not left_out:
            return self
        if not any(kept):
            raise ValueError("A trajectory must be left, but none is.")
        return self.only(np.flatnonzero(kept), f"trajectory {', '.join(left_out)} ({reason})")

    def drop(self, names: Iterable[str], reason: str = "by request") -> "Recordings":
        """Recordings without some trajectories, which are counted in `dropped`.

        Raises
        ------
        ValueError
            If a name is not that of a trajectory, or no trajectory is left.
        """
        names = [names] if isinstance(names, str) else list(names)
        self._require_names(names, "drop")
        if not names:
            return self
        return self._with_only([name not in names for name in self.names], reason)

    def drop_samples(
        self,
        channel: str,
        samples: Bool[np.ndarray, " samples"],
        reason: str = "by request",
    ) -> "Recordings":
        """Recordings without some readings of a sensor, which are counted in `dropped`.

        Parameters
        ----------
        channel
            The sensor's channel, such as `"attitude"`.
        samples
            True where a sample is dropped (samples,), of all trajectories one after another.
        reason
            Why, in words.

        Raises
        ------
        ValueError
            If the recordings do not have the channel, or the shape is wrong.
        TypeError
            If `samples` are not booleans.
        """
        if (readings := self.channels.get(channel)) is None:
            raise ValueError(
                f"Argument `channel` must be one of {tuple(self.channels)}, but is {channel!r}."
            )
        dropped = np.asarray(samples)
        if dropped.dtype != bool:
            raise TypeError(
                f"Argument `samples` must be boolean, True for what is dropped, but is of type "
                f"{dropped.dtype}."
            )
        if dropped.shape != (count := int(np.sum(readings.count)),):
            raise ValueError(
                f"Argument `samples` must have shape {(count,)}, but its shape is {dropped.shape}."
            )
        if not dropped.any():
            return self
        remaining = [
            {**trajectory, channel: tuple(x[keep] for x in trajectory[channel])}
            for trajectory, keep in zip(self, readings.split(~dropped), strict=True)
        ]
        words = f"{dropped.sum()} samples of {channel.replace('_', ' ')} ({reason})"
        return self._rebuilt(remaining, self.names, [words])

    def crop(
        self,
        start: Float[ArrayLike, "*trajectories"] | Sequence[float] | None = None,
        end: Float[ArrayLike, "*trajectories"] | Sequence[float] | None = None,
        reason: str = "cropped",
    ) -> "Recordings":
        """Recordings from one time to another; the other readings are counted in `dropped`.

        Torques and rotor momenta are kept as far as needed.

        Parameters
        ----------
        start, end
            Recorded times, s: one for all trajectories, or one for each (trajectories,). By
            default the first and the last time.
        reason
            Why, in words.

        Raises
        ------
        ValueError
            For a wrong shape, or if a trajectory has fewer than two samples left.
        """
        limits = []
        for name, limit, default in (("start", start, -np.inf), ("end", end, np.inf)):
            times = np.asarray(default if limit is None else limit, float)
            if times.shape not in ((), (len(self),)) or np.isnan(times).any():
                raise ValueError(
                    f"Argument `{name}` must be a time, or one for each of {len(self)} "
                    f"trajectories, but is {limit!r}."
                )
            limits.append(np.broadcast_to(times, len(self)))
        if (wrong := limits[0] > limits[1]).any():
            first, last = (limit[wrong][0] for limit in limits)
            raise ValueError(
                f"Argument `start` must be a time before `end`, {last} s, but is {first} s."
            )
        cropped, counts = [], dict.fromkeys(self.channels, 0)
        for trajectory, first, last in zip(self, *limits, strict=True):
            part = _between(trajectory, float(first), float(last))
            cropped.append(part)
            for channel in counts:
                if channel in trajectory:
                    counts[channel] += len(trajectory[channel][0]) - len(part[channel][0])
        words = [
            f"{count} samples of {channel.replace('_', ' ')} ({reason})"
            for channel, count in counts.items()
            if count
        ]
        return self._rebuilt(cropped, self.names, words)

    def hold_out(self, fraction: float) -> tuple["Recordings", "Recordings"]:
        """The recordings in two: those to fit, and those to keep back for a validation.

        Trajectories that are kept back are spread evenly. Of a single trajectory the end is kept
        back.

        Parameters
        ----------
        fraction
            The part that is kept back, above 0 and below 1: of the trajectories, at least one; of
            a single trajectory its time.

        Returns
        -------
        tuple of Recordings
            The recordings to fit, and the recordings for `validate` of the estimate.

        Raises
        ------
        ValueError
            For another fraction, or if it leaves no trajectory to fit.
        """
        if not 0 < fraction < 1:
            raise ValueError(
                f"Argument `fraction` must be above 0 and below 1, but is {fraction!r}."
            )
        reason = "kept back for a validation"
        if len(self) == 1:
            (t,) = self.reading_times()
            border = t[-1] - fraction * (t[-1] - t[0])
            after = float(t[np.searchsorted(t, border, "right")])
            return self.crop(end=border, reason=reason), self.crop(start=after, reason="fitted")
        count = min(max(round(fraction * len(self)), 1), len(self) - 1)
        places = np.floor((np.arange(count) + 0.5) * len(self) / count).astype(int)
        names = [self.names[i] for i in places]
        return self.drop(names, reason), self.select(names, "fitted")

    def hold(self, *inputs: str) -> "Recordings":
        """Recordings in which inputs keep each value until the next sample, and then jump.

        By default inputs are linear between samples. A flight computer holds a command until the
        next one, so that a line would be half an interval early. A jump takes a ten-thousandth of
        the interval after the sample.

        Parameters
        ----------
        inputs
            Names of recorded inputs: `"rotor_speed"`, `"body_torque"` or `"rotor_momentum"`.

        Raises
        ------
        ValueError
            If an input is not recorded, or none is named.
        """
        for name in inputs or ("",):
            if name not in INPUTS or getattr(self, name) is None:
                recorded = [known for known in INPUTS if getattr(self, known) is not None]
                raise ValueError(
                    f"Arguments `inputs` must be recorded inputs, of {recorded}, but are {inputs}."
                )
        held = [
            {**trajectory, **{name: _held(*trajectory[name]) for name in inputs}}
            for trajectory in self
        ]
        words = f"held between samples: {', '.join(inputs)}"
        return stack_trajectories(held, self.names, self.dropped, (*self.provenance, words))

    def split(self, gap: float) -> "Recordings":
        """Recordings with trajectories cut in two at long intervals without readings.

        The parts of trajectory `"toss"` are named `"toss[0]"`, `"toss[1]"` and so on. A part that
        has fewer than two readings of each sensor is left out and counted in `dropped`.

        Parameters
        ----------
        gap
            The least time, s, between two readings at which a trajectory is cut.

        Raises
        ------
        ValueError
            If `gap` is not above 0, or no part is left.
        """
        if not 0 < gap < np.inf:
            raise ValueError(f"Argument `gap` must be a time above 0 s, but is {gap!r}.")
        parts, names, short = [], [], []
        for name, trajectory in zip(self.names, self, strict=True):
            t = reading_times([trajectory[c] for c in self.channels if c in trajectory])
            first = np.append(0, np.flatnonzero(np.diff(t) >= gap) + 1)
            last = np.append(first[1:], len(t)) - 1
            for i, (begin, end) in enumerate(zip(t[first], t[last], strict=True)):
                part = _between(trajectory, begin, end)
                longest = max(len(part[c][0]) for c in self.channels if c in part)
                part_name = name if len(first) == 1 else f"{name}[{i}]"
                if longest < 2:
                    short.append(part_name)
                else:
                    parts.append(part)
                    names.append(part_name)
        if not parts:
            raise ValueError(f"Argument `gap` must leave parts of two readings, but is {gap!r}.")
        words = [f"trajectory {', '.join(short)} (fewer than two readings)"] if short else []
        return self._rebuilt(parts, names, words)


def _words_of(recordings: Sequence[Recordings]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What was dropped from several recordings, and where they come from, each once."""
    dropped = tuple(words for part in recordings for words in part.dropped)
    provenance = dict.fromkeys(words for part in recordings for words in part.provenance)
    return dropped, tuple(provenance)


def _require_overlap(name: str, first: OfTrajectory, second: OfTrajectory) -> None:
    """Check that the times of a trajectory in two recordings may be of one clock."""
    ends = []
    for samples in (first, second):
        times = [t for t, _ in samples.values() if len(t)]
        ends.append((min(t[0] for t in times), max(t[-1] for t in times)) if times else None)
    if None not in ends and (ends[0][1] < ends[1][0] or ends[1][1] < ends[0][0]):
        words = " and ".join(f"from {begin:.12g} to {end:.12g} s" for begin, end in ends)
        raise ValueError(
            f"Argument `recordings` must have times of one clock, but trajectory {name!r} goes "
            f"{words}."
        )


def _as_several(recordings: Any) -> list[Recordings]:
    if isinstance(recordings, Recordings) or not isinstance(recordings, Iterable):
        raise TypeError(
            f"Argument `recordings` must be several `Recordings`, but is {recordings!r}."
        )
    recordings = list(recordings)
    for part in recordings:
        if not isinstance(part, Recordings):
            raise TypeError(
                "Argument `recordings` must be several `Recordings`, but one is of the type "
                f"`{type(part).__name__}`."
            )
    if not recordings:
        raise ValueError("Argument `recordings` must have at least one, but is empty.")
    return recordings


def _columns(
    channels: Mapping[str, Sequence[Column] | None],
    body_torque: Sequence[Column] | None,
    rotor_momentum: Column | Sequence[Column] | None,
    rotor_speed: Sequence[Column] | None,
    sensors: Sensors,
    units: Mapping[str, str] | None,
    attitude_order: str,
    attitude_direction: str,
    normalise: bool,
) -> dict[str, Columns]:
    """The columns of each quantity in a file."""
    rotor = (rotor_momentum,) if isinstance(rotor_momentum, str | Integral) else rotor_momentum
    inputs = {"body_torque": body_torque, "rotor_momentum": rotor, "rotor_speed": rotor_speed}
    arguments = given_with_formats(channels, inputs, sensors)
    formats = {quantity: form for quantity, (_, form) in arguments.items()}
    conversions = conversions_of(formats, units, attitude_order, attitude_direction, normalise)
    return {
        quantity: Columns(names, form, conversions[quantity])
        for quantity, (names, form) in arguments.items()
    }


def stack_trajectories(
    trajectories: Sequence[OfTrajectory],
    names: tuple[str, ...],
    dropped: tuple[str, ...] = (),
    provenance: tuple[str, ...] = (),
) -> Recordings:
    """Recordings of some trajectories, in the given order.

    Raises
    ------
    ValueError
        If a trajectory has too few readings, or not all inputs that others have.
    """
    recorded = list(dict.fromkeys(name for samples in trajectories for name in samples))
    channels = [name for name in recorded if name not in INPUTS]
    inputs = [name for name in recorded if name in INPUTS]
    for name, samples in zip(names, trajectories, strict=True):
        require_complete(name, samples, channels, inputs)

    def joined(quantity: str) -> Samples:
        t, values = next(samples[quantity] for samples in trajectories if quantity in samples)
        for name, samples in zip(names, trajectories, strict=True):
            if quantity in samples and samples[quantity][1].shape[1:] != values.shape[1:]:
                raise ValueError(
                    f"Trajectory {name!r} must have {values.shape[1]} columns of `{quantity}`, as "
                    f"others have, but has {samples[quantity][1].shape[1]}."
                )
        empty = t[:0], values[:0]
        return Samples.stack([samples.get(quantity, empty) for samples in trajectories])

    return Recordings(
        OrderedDict((channel, joined(channel)) for channel in channels),
        **{name: joined(name) if name in inputs else None for name in INPUTS},
        names=names,
        dropped=dropped,
        provenance=provenance,
    )


def _held(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Samples, linear between the times, of values that stay until the next time."""
    if len(t) == 1:
        return t, values
    jump = JUMP * np.diff(t, append=2 * t[-1] - t[-2])
    before = np.concatenate([values[:1], values[:-1]])
    times = np.stack([t, t + jump], axis=1).ravel()
    return times, np.stack([before, values], axis=1).reshape(-1, *values.shape[1:])


def _between(samples: OfTrajectory, start: float, end: float) -> OfTrajectory:
    """The readings from one time to another, and the inputs that cover them."""
    readings = {
        channel: (t[(start <= t) & (t <= end)], values[(start <= t) & (t <= end)])
        for channel, (t, values) in samples.items()
        if channel not in INPUTS
    }
    times = np.concatenate([t for t, _ in readings.values()])
    part: OfTrajectory = dict(readings)
    for name in samples:
        if name in INPUTS and len(times):
            t, values = samples[name]
            first = max(int(np.searchsorted(t, np.min(times), side="right")) - 1, 0)
            last = int(np.searchsorted(t, np.max(times))) + 1
            part[name] = t[first:last], values[first:last]
    return part
