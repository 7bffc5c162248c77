"""The samples of each quantity from the cells of a table, for files of any kind."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from .formats import Conversion, Format, require_one_of
from .sample_checks import (
    DUPLICATES,
    Duplicates,
    SampleError,
    column_counts,
    describe_counts,
    readings_by_time,
)
from .samples import OfTrajectory

TimeUnit = Literal["s", "ms", "us", "ns", "min"]
HOW = {"first": "left out", "mean": "averaged with it"}  # treatment of samples of the same time
PER_SECOND = dict(zip(get_args(TimeUnit), (1, 1e3, 1e6, 1e9, 1 / 60), strict=True))


Column = str | int  # a name, or in a CSV file a number, counted from 0


class Cells(NamedTuple):
    """The cells of those lines of a file that are not empty."""

    line: Int[np.ndarray, " lines"] | None  # number of each line in the file, if lines were counted
    numbers: dict[Column, Float[np.ndarray, " lines"]]  # by column
    empty: dict[Column, Bool[np.ndarray, " lines"]]  # True where a cell has no number
    trajectories: tuple[str, ...]  # names, in the order of their first lines
    trajectory: Int[np.ndarray, " lines"]  # index of the trajectory of each line


class CellError(ValueError):
    """An error in a file, in words, and the place of the error."""

    def __init__(self, line: int | None, column: str | None, words: str):
        super().__init__(words)
        self.line = line
        self.column = column
        self.words = words


class Columns(NamedTuple):
    """The columns of a quantity in a file, with their format and conversion."""

    names: Sequence[Column]
    form: Format
    conversion: Conversion = Conversion()

    @property
    def counts(self) -> tuple[int, ...]:
        """Numbers of columns that the quantity may have."""
        return self.conversion.counts(column_counts(self.form))


class Timing(NamedTuple):
    """The column and unit of the times of a file, and the treatment of equal times."""

    t: Column
    unit: TimeUnit
    duplicates: Duplicates


class Table(NamedTuple):
    """The samples in a file."""

    trajectories: dict[str, OfTrajectory]
    changed: Counter[tuple[str, str]]  # number of changed samples by quantity and reason


def is_column(name: Any, by_number: bool) -> bool:
    """Whether a value is the name of a column, or its number where numbers are possible."""
    is_int = isinstance(name, int | np.integer) and not isinstance(name, bool)
    return isinstance(name, str) or bool(by_number and is_int and name >= 0)


def require_counts(columns: Mapping[str, Columns], by_number: bool = False) -> None:
    for quantity, group in columns.items():
        names: Any = group.names
        several = isinstance(names, Sequence) and all(is_column(name, by_number) for name in names)
        if not several or isinstance(names, str) or len(set(names)) not in group.counts:
            raise ValueError(
                f"Argument `{quantity}` must name {describe_counts(group.counts)} different "
                f"columns{' or give their numbers from 0' if by_number else ''}, but is {names!r}"
                f"{group.conversion.describe_order()}."
            )


def require_timing(timing: Timing, by_number: bool = False) -> None:
    """Check the options of the times."""
    require_one_of("time_unit", timing.unit, PER_SECOND)
    require_one_of("duplicates", timing.duplicates, DUPLICATES)
    if not is_column(timing.t, by_number):
        raise TypeError(f"Argument `t` must be the name of a column, but is {timing.t!r}.")


def make_table(cells: Cells, columns: Mapping[str, Columns], timing: Timing) -> Table:
    """The samples of each quantity in each trajectory.

    Raises
    ------
    CellError
        For the first malformed cell.
    """
    _require_numbers(cells, columns, timing.t)
    order = np.argsort(cells.trajectory, kind="stable")
    counts = np.bincount(cells.trajectory, minlength=len(cells.trajectories))
    changed = Counter[tuple[str, str]]()
    same_time = f"same time as the one before, {HOW.get(timing.duplicates, '')}"
    trajectories = {}
    for name, lines in zip(
        cells.trajectories, np.split(order, np.cumsum(counts)[:-1]), strict=True
    ):
        trajectories[name] = samples = {}
        for quantity, group in columns.items():
            sampled = lines[~cells.empty[group.names[0]][lines]]
            samples[quantity], normalised = _samples(cells, sampled, group, timing)
            changed[quantity, "normalised"] += normalised
            changed[quantity, same_time] += len(sampled) - len(samples[quantity][0])
    return Table(trajectories, changed)


def describe_changed(changed: Mapping[tuple[str, str], int]) -> tuple[str, ...]:
    """The numbers of changed samples, in words."""
    return tuple(
        f"{count} sample{'s' * (count > 1)} of {quantity.replace('_', ' ')} ({reason})"
        for (quantity, reason), count in changed.items()
        if count > 0
    )


def _require_numbers(cells: Cells, columns: Mapping[str, Columns], t: Column) -> None:
    """Check that each line has a time, and all or no numbers of each quantity."""
    for names in ([t], *(group.names for group in columns.values())):
        empty = [cells.empty[name] for name in names]
        bad = np.any(empty, 0) if names == [t] else np.any(empty, 0) & ~np.all(empty, 0)
        if bad.any():
            row = int(np.argmax(bad))
            column = next(name for name in names if cells.empty[name][row])
            words = "must be a number, but is empty, or says that there is none"
            if names != [t]:
                words += ", and other columns of the quantity have numbers"
            raise CellError(_line(cells, row), str(column), words)


def _samples(
    cells: Cells, sampled: np.ndarray, columns: Columns, timing: Timing
) -> tuple[tuple[np.ndarray, np.ndarray], int]:
    """Times and values of a quantity, and the number of normalised values."""
    names, form, conversion = columns
    t = cells.numbers[timing.t][sampled] / PER_SECOND[timing.unit]
    values = np.empty((len(sampled), len(names)))
    for i, name in enumerate(names):
        values[:, i] = cells.numbers[name][sampled]
    values, normalised = conversion.apply(values)
    try:
        _require_resolved(t)
        return readings_by_time(timing.duplicates, form, t, values), normalised
    except SampleError as problem:
        component = problem.component
        wrong_columns = names if component is None else [(*names, timing.t)[component]]
        column = ",".join(map(str, wrong_columns))
        words = problem.words
        if words.startswith("must have length 1") and not conversion.normalise:
            words += "; `normalise=True` takes quaternions of any length"
        if words.startswith("must increase") and len(cells.trajectories) == 1:
            words += "; `trajectory=` names a column that tells trajectories apart"
        raise CellError(_line(cells, sampled[problem.sample]), column, words) from None


def _require_resolved(t: np.ndarray) -> None:
    """Check that rounding changes the intervals above zero by at most a hundredth."""
    rounding = np.finfo(float).eps * np.max(abs(t), initial=0)
    with np.errstate(invalid="ignore", over="ignore"):  # times that are refused later
        intervals = np.diff(t)
    close = (intervals > 0) & (intervals < 100 * rounding)
    if close.any():
        first = int(np.argmax(close))
        words = (
            f"must be told apart, but {t[first + 1]:.18g} s follows {t[first]:.18g} s, and float64 "
            f"rounds such times to {rounding:.1g} s: subtract the start from all times"
        )
        raise SampleError(first + 1, -1, words)


def _line(cells: Cells, row: int) -> int | None:
    return None if cells.line is None else int(cells.line[row])
