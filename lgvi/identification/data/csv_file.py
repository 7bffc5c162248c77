"""Recordings in CSV files, with errors that name the line and the column."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from .csv_cells import Body, CellError, Cells, read_columns, read_lines, rows
from .duplicates import DUPLICATES, Duplicates, readings_by_time
from .formats import Format
from .samples import OfTrajectory, SampleError, column_counts

TRAJECTORY = "trajectory"  # the column that is looked for by default
TIMES = "t", "time", "times", "timestamp", "seconds", "t_s", "time_s"  # usual names of the time
DELIMITERS = ",", ";", "\t", "|", " "
TimeUnit = Literal["s", "ms", "us", "ns"]
PER_SECOND = dict(zip(get_args(TimeUnit), (1, 1e3, 1e6, 1e9), strict=True))


class Columns(NamedTuple):
    """The columns of a quantity in a file, and how their numbers are read."""

    names: Sequence[str]
    given: Format


class Dialect(NamedTuple):
    """How a file is written, as arguments of `Recordings.from_csv`."""

    t: str
    time_unit: TimeUnit
    trajectory: str | None
    duplicates: Duplicates
    delimiter: str
    comment: str | None


class Table(NamedTuple):
    """What was read from a file."""

    trajectories: dict[str, OfTrajectory]
    dropped: tuple[str, ...]  # what is not kept as it was, in words


def read_table(
    file: str | PathLike[str], columns: Mapping[str, Columns], dialect: Dialect
) -> Table:
    """For each trajectory the samples of each quantity.

    Raises
    ------
    ValueError
        For anything that is malformed, naming the file, the line and the column.
    """
    _require_counts(columns)
    _require_dialect(dialect)
    if not isinstance(file, (str, PathLike)):
        raise TypeError(f"Argument `file` must be the path of a file, but is {file!r}.")
    path = Path(file)
    try:
        body = _body(partial(_text, path, dialect.comment), columns, dialect)
        at_once = _table_at_once(body, columns, dialect)
        return at_once or _table(read_lines(body), columns, dialect)
    except CellError as error:
        place = f"{path}, line {error.line}"
        if error.column is not None:
            place += f", column `{error.column}`"
        raise ValueError(f"{place}: {error.words}") from None


def _require_counts(columns: Mapping[str, Columns]) -> None:
    for name, (names, given) in columns.items():
        counts = column_counts(given)
        several = isinstance(names, Sequence) and all(isinstance(each, str) for each in names)
        if not several or isinstance(names, str) or len(set(names)) not in counts:
            wanted = " or ".join(map(str, dict.fromkeys(counts)))
            raise ValueError(
                f"Argument `{name}` must name {wanted} different columns, but is {names!r}."
            )


def _require_dialect(dialect: Dialect) -> None:
    _require_one_of("time_unit", dialect.time_unit, PER_SECOND)
    _require_one_of("duplicates", dialect.duplicates, DUPLICATES)
    _require_one_of("delimiter", dialect.delimiter, DELIMITERS)
    if not isinstance(dialect.t, str):
        raise TypeError(f"Argument `t` must be the name of a column, but is {dialect.t!r}.")
    if not isinstance(dialect.trajectory, str | None):
        raise TypeError(
            "Argument `trajectory` must be the name of a column or None, but is "
            f"{dialect.trajectory!r}."
        )
    comment = dialect.comment
    if comment is None:
        return
    mark = comment.strip() if isinstance(comment, str) else ""
    if not mark or mark[0] in f'"{dialect.delimiter}+-.' or mark[0].isalnum():
        raise ValueError(
            "Argument `comment` must be what a comment begins with, such as '#', and no cell, or "
            f"None, but is {comment!r}."
        )


def _require_one_of(name: str, value: Any, allowed: Any) -> None:
    if not isinstance(value, str) or value not in allowed:
        words = ", ".join(map(repr, allowed))
        raise ValueError(f"Argument `{name}` must be one of {words}, but is {value!r}.")


def _text(path: Path, comment: str | None) -> bytes:
    """The text in UTF-8, with an empty line for each comment."""
    text = path.read_bytes().removeprefix(b"\xef\xbb\xbf")  # a mark of UTF-8
    try:
        text.decode()
    except UnicodeDecodeError as error:
        before = text[: error.start].split(b"\n")
        words = f"must be text in UTF-8, but its byte {len(before[-1]) + 1} is not"
        raise CellError(len(before), None, words) from error
    if comment is None:
        return text
    mark = re.escape(comment.strip().encode())
    return re.sub(rb"^[ \t]*" + mark + rb"[^\r\n]*", b"", text, flags=re.MULTILINE)


def _body(read: Callable[[], bytes], columns: Mapping[str, Columns], dialect: Dialect) -> Body:
    line, header = next(rows(read(), dialect.delimiter), (1, []))
    numbers = [dialect.t, *(name for names, _ in columns.values() for name in names)]
    for name in numbers if dialect.trajectory is None else [*numbers, dialect.trajectory]:
        if header.count(name) != 1:
            raise CellError(line, name, _missing(name, header, dialect))
    trajectory = TRAJECTORY if dialect.trajectory is None else dialect.trajectory
    if header.count(trajectory) > 1:
        raise CellError(line, trajectory, "must be there at most once")
    return Body(
        read=read,
        header=header,
        header_lines=line,
        delimiter=dialect.delimiter,
        numbers=list(dict.fromkeys(numbers)),
        trajectory=trajectory if trajectory in header else None,
    )


def _missing(name: str, header: Sequence[str], dialect: Dialect) -> str:
    words = repr(dialect.delimiter.join(header)) if header else "empty"
    problem = f"must be there once in a header separated by {dialect.delimiter!r}, which is {words}"
    if len(header) == 1 and (other := [each for each in DELIMITERS[:4] if each in header[0]]):
        return f"{problem}; write `delimiter={other[0]!r}` if that separates them"
    likely = [each for each in header if each.lower() in TIMES]
    if name == dialect.t and len(likely) == 1:
        return f'{problem}; write `t="{likely[0]}"` if that is the time'
    return problem


def _table_at_once(body: Body, columns: Mapping[str, Columns], dialect: Dialect) -> Table | None:
    try:
        cells = read_columns(body)
        return None if cells is None else _table(cells, columns, dialect)
    except CellError:
        return None  # The lines are not counted here, so that the error could not name one.


def _table(cells: Cells, columns: Mapping[str, Columns], dialect: Dialect) -> Table:
    _require_numbers(cells, columns, dialect.t)
    order = np.argsort(cells.trajectory, kind="stable")
    counts = np.bincount(cells.trajectory, minlength=len(cells.trajectories))
    duplicates = dict.fromkeys(columns, 0)
    trajectories = {}
    for name, lines in zip(
        cells.trajectories, np.split(order, np.cumsum(counts)[:-1]), strict=True
    ):
        trajectories[name] = samples = {}
        for quantity, of_quantity in columns.items():
            sampled = lines[~cells.empty[of_quantity.names[0]][lines]]
            samples[quantity] = _samples(cells, sampled, of_quantity, dialect)
            duplicates[quantity] += len(sampled) - len(samples[quantity][0])
    how = {"first": "left out", "mean": "averaged with it"}.get(dialect.duplicates, "")
    dropped = (
        f"{count} sample{'s' * (count > 1)} of {quantity.replace('_', ' ')} "
        f"(same time as the one before, {how})"
        for quantity, count in duplicates.items()
        if count > 0
    )
    return Table(trajectories, tuple(dropped))


def _require_numbers(cells: Cells, columns: Mapping[str, Columns], t: str) -> None:
    """Check that each line has a time, and of each quantity all columns or none."""
    for names in ([t], *(of_quantity.names for of_quantity in columns.values())):
        empty = [cells.empty[name] for name in names]
        bad = np.any(empty, 0) if names == [t] else np.any(empty, 0) & ~np.all(empty, 0)
        if bad.any():
            row = int(np.argmax(bad))
            column = next(name for name in names if cells.empty[name][row])
            raise CellError(_line(cells, row), column, "must be a number, but is ''")


def _samples(
    cells: Cells, sampled: np.ndarray, columns: Columns, dialect: Dialect
) -> tuple[np.ndarray, np.ndarray]:
    names, given = columns
    t = cells.numbers[dialect.t][sampled] / PER_SECOND[dialect.time_unit]
    values = np.empty((len(sampled), len(names)))
    for i, name in enumerate(names):
        values[:, i] = cells.numbers[name][sampled]
    try:
        _require_resolved(t)
        return readings_by_time(dialect.duplicates, given, t, values)
    except SampleError as problem:
        component = problem.component
        column = ",".join(names) if component is None else (*names, dialect.t)[component]
        raise CellError(_line(cells, sampled[problem.sample]), column, problem.words) from None


def _require_resolved(t: np.ndarray) -> None:
    """Check that rounding leaves the intervals, of those that are not zero, to a hundredth."""
    rounding = np.finfo(float).eps * np.max(abs(t), initial=0)
    with np.errstate(invalid="ignore", over="ignore"):  # times that are refused for that
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
