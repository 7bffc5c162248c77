"""Recorded motion of a body: what was measured, when, and in which trajectory."""

from collections import Counter, OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from numbers import Integral
from os import PathLike
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ...modules.printing import as_table
from ...modules.sensors.sensor import Sensors
from .delimited import Dialect, read_table
from .formats import INPUTS, conversions_of, given_with_formats
from .parquet import Folder, StoredSamples
from .sample_checks import Duplicates, as_samples, require_complete
from .samples import AbstractParts, AbstractSamples, OfTrajectory, Samples, reading_times
from .table import Column, Columns, TimeUnit, Timing, describe_changed

MOST_ROWS = 20  # of a table in a notebook


class Recordings(AbstractParts, eqx.Module):
    """One or many recorded trajectories of a body, immutable.

    Make one with `from_arrays` or `from_csv`, and many with `from_csv`, `open` or `concatenate`;
    `merge` puts together what several files have of one flight.
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
        the samples; or None. Speeds will do where their inertia is estimated, and one column of
        them (samples, 1) where the axis is in the model.
    rotor_speed
        Speeds of the rotors of a [`Multirotor`][lgvi.Multirotor] (samples, rotors), rad/s, or
        commands, linear between the samples; or None.
    names
        A name for each trajectory.
    dropped
        What was dropped by request, in words.
    """

    channels: OrderedDict[str, AbstractSamples]
    body_torque: AbstractSamples | None
    rotor_momentum: AbstractSamples | None
    rotor_speed: AbstractSamples | None
    names: tuple[str, ...] = eqx.field(static=True)
    dropped: tuple[str, ...] = eqx.field(default=(), static=True)

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
            Times (samples,), s, increasing, of all quantities that do not bring their own.
        body_torque
            Torques (samples, 3), body frame, N m. They must cover the times of all readings. For
            times of its own a tuple `(t, body_torque)`, and so for all that follow.
        rotor_momentum
            Momenta of rotors (samples, 3), body frame, kg m²/s, or speeds; or speeds of one rotor
            (samples,), rad/s. They must cover them too.
        rotor_speed
            Speeds of the rotors of a [`Multirotor`][lgvi.Multirotor] (samples, rotors), rad/s, or
            commands, none negative, for at most 16 rotors. They must cover them too.
        name
            Name of the trajectory.
        sensors
            Kinds of sensors, such as a class of your own, or a mapping of names of channels to
            such; in addition to the sensors of the library.
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
            For input that is malformed, naming the argument and the sample.
        """
        inputs = {
            "body_torque": body_torque,
            "rotor_momentum": rotor_momentum,
            "rotor_speed": rotor_speed,
        }
        given = given_with_formats(channels, inputs, sensors)
        samples = {
            each: as_samples(each, given_as, t, value) for each, (value, given_as) in given.items()
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
        normalise: bool = False,
        sensors: Sensors = (),
        **channels: Sequence[Column] | None,
    ) -> "Recordings":
        """All trajectories of a CSV file, in UTF-8 or UTF-16.

        A column is a name in the header, which may be in a comment, or the number of the column,
        counted from 0. Where all are numbers, there need be no header.

        Parameters
        ----------
        file
            The file. A line whose cells of a quantity are all empty has no sample of it.
        body_torque, rotor_momentum
            Three columns, units and frames as in `from_arrays`; or the one column of speeds of a
            rotor.
        rotor_speed
            The columns, one for each rotor, at most 16.
        t
            The column of times, increasing within a trajectory.
        time_unit
            Unit of the times in the file, `"s"`, `"ms"`, `"us"`, `"ns"` or `"min"`; in the
            recordings they are in s. A warning tells if the name of the column says another one.
        trajectory
            The column that tells trajectories apart. By default it is `trajectory`, and a
            file without that column is one trajectory.
        duplicates
            What to do with samples of a quantity that have the time of the one before: `"error"`,
            keep the `"first"` of them, or take their `"mean"`, of rotations the rotation nearest
            to it. How many samples that concerns is told in `dropped`.
        delimiter
            What separates the cells: one of `,`, `;`, `|`, a tab and a space. Several spaces are
            as one.
        decimal
            The decimal mark, a point or a comma.
        missing
            Cells that say that there is no number, as empty cells do, such as `("NaN", "-")`.
        comment
            What a line begins with that is not read, such as `#`; by default all are read.
        skip_lines
            How many lines at the beginning are not read.
        units
            Units in the file, by quantity, where they are not those of the library, such as
            `{"angular_velocity": "deg/s", "position": "mm"}`: of rates and speeds `deg/s`, `rpm` or
            `rev/s`; of specific forces `g` or `mg`; of positions `cm` or `mm`; of magnetic fields
            `mT`, `uT`, `nT` or `G`; of torques `mN m`; of attitudes by angles `deg`. A
            warning tells if the name of a column ends with another of these units.
        attitude_order
            How attitudes are written in four or three columns: as quaternions `"wxyz"` or, scalar
            last, `"xyzw"`; as a `"rotation_vector"`, rad; or as three angles, rad, about the axes
            of a sequence such as `"ZYX"`, each of which the turns before have turned (intrinsic),
            or `"xyz"`, which stay (extrinsic).
        normalise
            Whether quaternions of any length are taken, and normalised; by default one that is off
            by more than 1e-3 is an error. How many that concerns is told in `dropped`.
        sensors
            As for `from_arrays`.
        **channels
            The columns of each sensor, under the name of its channel: for `attitude` four
            of a unit quaternion, or nine of a matrix, row by row, or three, see `attitude_order`;
            for others of the library three.

        Returns
        -------
        Recordings
            The trajectories, in the order of their first lines.

        Raises
        ------
        ValueError, TypeError
            For anything that is malformed, naming the file, the line and the column.
        """
        named = channels, body_torque, rotor_momentum, rotor_speed, sensors
        columns = _columns(*named, units, attitude_order, normalise)
        timing = Timing(t, time_unit, duplicates)
        dialect = Dialect(timing, trajectory, delimiter, comment, decimal, missing, skip_lines)
        trajectories, changed = read_table(file, columns, dialect)
        words = describe_changed(changed)
        try:
            return stack_trajectories(list(trajectories.values()), tuple(trajectories), words)
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
        normalise: bool = False,
        sensors: Sensors = (),
        **channels: Sequence[str] | None,
    ) -> "Recordings":
        """Trajectories in a folder of Parquet files, which stay there: more than memory holds.

        All files are read and checked once, and again one after another whenever they are needed.
        `select` and `drop` leave trajectories in the files; all else that gives other recordings
        puts those in memory, and so do `load`, and the attributes `times` and `values` of the
        channels.

        Parameters
        ----------
        folder
            The folder. Each file `*.parquet` is a trajectory, whose name is that of the file
            without its ending; trajectories are in the order of their names. A row whose cells of a
            quantity are all null has no sample of it.
        body_torque, rotor_momentum, rotor_speed, t, time_unit, duplicates
            As for `from_csv`.
        units, attitude_order, normalise, sensors, **channels
            As for `from_csv`.

        Returns
        -------
        Recordings
            The trajectories.

        Raises
        ------
        ValueError, TypeError
            For anything that is malformed, naming the file, the row, counted from 0, and the
            column; also later, for a file that has changed.
        """
        named = channels, body_torque, rotor_momentum, rotor_speed, sensors
        columns = _columns(*named, units, attitude_order, normalise)
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
            OrderedDict((name, each) for name, each in joined.items() if name not in INPUTS),
            **{name: joined.get(name) for name in INPUTS},
            names=tuple(file.stem for file in stored.files),
            dropped=describe_changed(changed),
        )

    @classmethod
    def concatenate(cls, recordings: Iterable["Recordings"]) -> "Recordings":
        """The trajectories of several recordings together.

        Names that occur twice get the number of the recording in front.

        Raises
        ------
        ValueError
            If there is none; or if the recordings have the same names, but no quantity in common:
            then they may be one flight in several files, which `merge` puts together.
        """
        recordings = _as_several(recordings)
        quantities = [name for each in recordings for name in each.quantities]
        are_apart = len(recordings) > 1 and len(set(quantities)) == len(quantities)
        if are_apart and len({each.names for each in recordings}) == 1:
            raise ValueError(
                "Argument `recordings` must have a quantity in common, or other names, but has "
                f"{', '.join(f'`{name}`' for name in quantities)} of trajectories of the same "
                "names: `Recordings.merge` puts one flight in several files together; "
                "trajectories of other flights need names of their own, such as by "
                "`dataclasses.replace(recordings, names=('second',))`."
            )
        names = [name for each in recordings for name in each.names]
        if len(set(names)) < len(names):
            names = [f"{i}:{name}" for i, each in enumerate(recordings) for name in each.names]
        dropped = tuple(words for each in recordings for words in each.dropped)
        return stack_trajectories(
            [each for one in recordings for each in one], tuple(names), dropped
        )

    @classmethod
    def merge(cls, recordings: Iterable["Recordings"]) -> "Recordings":
        """The same trajectories, of which each of several recordings has other quantities.

        It puts together one flight in several files, such as a camera's and a gyroscope's. All
        times are of one clock; `time_offset` of a sensor takes up what the clocks differ by.

        Parameters
        ----------
        recordings
            Recordings of trajectories with the same names; or of one trajectory each, whose name
            is then that of the first.

        Returns
        -------
        Recordings
            The trajectories, in the order of the first recordings.

        Raises
        ------
        ValueError, TypeError
            If there is none, a quantity is in two of them, the names differ, or the times of a
            trajectory do not overlap.
        """
        recordings = _as_several(recordings)
        first, *others = recordings
        quantities = [name for each in recordings for name in each.quantities]
        if twice := [name for name in quantities if quantities.count(name) > 1]:
            raise ValueError(
                f"Argument `recordings` must have each quantity once, but `{twice[0]}` is in "
                "several: `concatenate` puts different trajectories together."
            )
        trajectories = [dict(trajectory) for trajectory in first]
        for each in others:
            single = len(first) == len(each) == 1
            if not single and sorted(each.names) != sorted(first.names):
                raise ValueError(
                    "Argument `recordings` must have trajectories of the same names, but has "
                    f"{list(first.names)} and {list(each.names)}."
                )
            for name, trajectory in zip(first.names, trajectories, strict=True):
                other = each.of(0 if single else each.names.index(name))
                _require_overlap(name, trajectory, other)
                trajectory |= other
        dropped = tuple(words for each in recordings for words in each.dropped)
        return stack_trajectories(trajectories, first.names, dropped)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def quantities(self) -> dict[str, AbstractSamples]:
        """All that was recorded: the channels, and what acts, if it was recorded."""
        inputs = {name: getattr(self, name) for name in INPUTS}
        return {**self.channels, **{name: x for name, x in inputs.items() if x is not None}}

    @property
    def are_stored(self) -> bool:
        """Whether they are in files, which may be more than memory holds."""
        return any(isinstance(samples, StoredSamples) for samples in self.channels.values())

    def reading_times(self) -> list[Float[np.ndarray, " times"]]:
        """For each trajectory the times of all readings, each once, increasing."""
        return [self.times_of(each) for each in self]

    def times_of(self, trajectory: OfTrajectory) -> Float[np.ndarray, " times"]:
        """The times of all readings of one of the trajectories, each once, increasing."""
        return reading_times([trajectory[channel] for channel in self.channels])

    def of(self, trajectory: int) -> OfTrajectory:
        """A trajectory by its number, as a dictionary of `(t, values)` by quantity."""
        return {name: samples.of(trajectory) for name, samples in self.quantities.items()}

    def __iter__(self) -> Iterator[OfTrajectory]:
        """For each trajectory a dictionary of `(t, values)` by quantity."""
        quantities = self.quantities
        for samples in zip(*quantities.values(), strict=True):
            yield dict(zip(quantities, samples, strict=True))

    def load(self) -> "Recordings":
        """The same in memory, if they are in files."""
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
        channels = self.quantities
        head = ["trajectory", "duration (s)", *(f"samples of {name}" for name in channels)]
        rows: list[tuple[str | int, ...]] = []
        for i, (name, each) in enumerate(zip(self.names[:MOST_ROWS], self, strict=False)):
            t, counts = self.times_of(each), (int(of.count[i]) for of in channels.values())
            rows.append((name, f"{t[-1] - t[0]:.4g}", *counts))
        if len(self) > MOST_ROWS:
            rows.append(("...", *[""] * (len(head) - 1)))
        return f"<b>Recordings</b>: {escape(str(self))}{as_table(head, rows)}"

    def only(self, trajectories: np.ndarray, *dropped: str) -> "Recordings":
        """Some trajectories by their numbers, with what else is dropped, in words."""
        found = {name: each.only(trajectories) for name, each in self.quantities.items()}
        return Recordings(
            OrderedDict((channel, found[channel]) for channel in self.channels),
            **{name: found.get(name) for name in INPUTS},
            names=tuple(self.names[i] for i in trajectories),
            dropped=(*self.dropped, *dropped),
        )

    def _rebuilt(
        self,
        trajectories: Sequence[OfTrajectory],
        names: Sequence[str],
        dropped: Sequence[str] = (),
    ) -> "Recordings":
        """Recordings of other trajectories, with what was dropped, now and before, in words."""
        return stack_trajectories(trajectories, tuple(names), (*self.dropped, *dropped))


def _require_overlap(name: str, first: OfTrajectory, second: OfTrajectory) -> None:
    """Check that what two recordings have of a trajectory may be of one clock."""
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
    for each in recordings:
        if not isinstance(each, Recordings):
            raise TypeError(
                "Argument `recordings` must be several `Recordings`, but one is of the type "
                f"`{type(each).__name__}`."
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
    normalise: bool,
) -> dict[str, Columns]:
    """The columns of each quantity in a file."""
    rotor = (rotor_momentum,) if isinstance(rotor_momentum, str | Integral) else rotor_momentum
    inputs = {"body_torque": body_torque, "rotor_momentum": rotor, "rotor_speed": rotor_speed}
    given = given_with_formats(channels, inputs, sensors)
    formats = {quantity: given_as for quantity, (_, given_as) in given.items()}
    conversions = conversions_of(formats, units, attitude_order, normalise)
    return {
        quantity: Columns(names, given_as, conversions[quantity])
        for quantity, (names, given_as) in given.items()
    }


def stack_trajectories(
    trajectories: Sequence[OfTrajectory],
    names: tuple[str, ...],
    dropped: tuple[str, ...] = (),
) -> Recordings:
    """Recordings of some trajectories, in this order.

    Raises
    ------
    ValueError
        If a trajectory has too few readings, or not all inputs that others have.
    """
    first = {name: samples for each in reversed(trajectories) for name, samples in each.items()}
    recorded = list(dict.fromkeys(name for each in trajectories for name in each))
    channels = [name for name in recorded if name not in INPUTS]
    inputs = [name for name in recorded if name in INPUTS]
    for name, each in zip(names, trajectories, strict=True):
        require_complete(name, each, channels, inputs)

    def joined(quantity: str) -> Samples:
        t, values = first[quantity]
        for name, each in zip(names, trajectories, strict=True):
            if quantity in each and each[quantity][1].shape[1:] != values.shape[1:]:
                raise ValueError(
                    f"Trajectory {name!r} must have {values.shape[1]} columns of `{quantity}`, as "
                    f"others have, but has {each[quantity][1].shape[1]}."
                )
        empty = t[:0], values[:0]
        return Samples.stack([each.get(quantity, empty) for each in trajectories])

    return Recordings(
        OrderedDict((channel, joined(channel)) for channel in channels),
        **{name: joined(name) if name in inputs else None for name in INPUTS},
        names=names,
        dropped=dropped,
    )
