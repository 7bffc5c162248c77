"""Recordings in CSV files, with errors that name the line and the column."""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from .formats import Format
from .samples import OfTrajectory, SampleError, check_samples, column_counts

TRAJECTORY = "trajectory"  # the column that is looked for by default
TIMES = "t", "time", "times", "timestamp", "seconds", "t_s", "time_s"  # usual names of the time


class Columns(NamedTuple):
    """The columns of a quantity in a file, and how their numbers are read."""

    names: Sequence[str]
    given: Format


class _Collected:
    """Samples of one quantity in one trajectory, and the lines they are from."""

    def __init__(self) -> None:
        self.lines: list[int] = []
        self.t: list[float] = []
        self.values: list[list[float]] = []


def read_table(
    file: str | PathLike[str], columns: Mapping[str, Columns], t: str, trajectory: str | None
) -> dict[str, OfTrajectory]:
    """For each trajectory the samples of each quantity.

    Raises
    ------
    ValueError
        For anything that is malformed, naming the file, the line and the column.
    """
    _require_counts(columns)
    path = Path(file)
    found: dict[str, dict[str, _Collected]] = {}
    lines = _Lines(path, columns, t, trajectory)
    for line, cells in lines:
        time, which = lines.number(line, cells, t), lines.trajectory_of(cells)
        rows = found.setdefault(which, {name: _Collected() for name in columns})
        for name, (names, _) in columns.items():
            if not any(cells[each] for each in names):
                continue  # not sampled at this time
            rows[name].lines.append(line)
            rows[name].t.append(time)
            rows[name].values.append([lines.number(line, cells, each) for each in names])
    if not found:
        _fail(path, 2, t, "there is no sample")
    return {
        which: {name: _samples(path, rows[name], of_name, t) for name, of_name in columns.items()}
        for which, rows in found.items()
    }


def _fail(path: Path, line: int, column: str, problem: str) -> NoReturn:
    raise ValueError(f"{path}, line {line}, column `{column}`: {problem}")


def _require_counts(columns: Mapping[str, Columns]) -> None:
    for name, (names, given) in columns.items():
        counts = column_counts(given)
        several = isinstance(names, Sequence) and all(isinstance(each, str) for each in names)
        if not several or isinstance(names, str) or len(set(names)) not in counts:
            wanted = " or ".join(map(str, counts))
            raise ValueError(
                f"Argument `{name}` must name {wanted} different columns, but is {names!r}."
            )


class _Lines:
    """The lines of a file after its header, each with its number and its cells by column."""

    def __init__(
        self, path: Path, columns: Mapping[str, Columns], t: str, trajectory: str | None
    ) -> None:
        self.path = path
        try:
            text = path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: must be text in UTF-8, but {error}") from error
        self.reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
        self.header = [name.strip() for name in next(self.reader, [])]
        used = [t, *(name for names, _ in columns.values() for name in names)]
        if trajectory is not None:
            used.append(trajectory)
        for name in used:
            if self.header.count(name) != 1:
                words = f"{','.join(self.header)!r}" if any(self.header) else "empty"
                problem = f"must be there once in a header separated by commas, which is {words}"
                likely = [each for each in self.header if each.lower() in TIMES]
                if name == t and len(likely) == 1:
                    problem += f'; write `t="{likely[0]}"` if that is the time'
                _fail(path, 1, name, problem)
        self.trajectory = trajectory or TRAJECTORY
        if self.header.count(self.trajectory) > 1:
            _fail(path, 1, self.trajectory, "must be there at most once")

    def __iter__(self) -> Iterator[tuple[int, dict[str, str]]]:
        for row in self._rows():
            line = self.reader.line_num
            if not any(cell.strip() for cell in row):
                continue  # an empty line
            if len(row) > len(self.header):
                _fail(self.path, line, str(len(self.header) + 1), "has no name in the header")
            if len(row) < len(self.header):
                missing = self.header[len(row)]
                _fail(self.path, line, missing, "is missing: the line ends before it")
            yield line, dict(zip(self.header, map(str.strip, row), strict=True))

    def _rows(self) -> Iterator[list[str]]:
        try:
            yield from self.reader
        except csv.Error as error:
            line = self.reader.line_num
            raise ValueError(f"{self.path}, line {line}: must be CSV, but {error}") from error

    def trajectory_of(self, cells: Mapping[str, str]) -> str:
        return cells.get(self.trajectory, "0")

    def number(self, line: int, cells: Mapping[str, str], name: str) -> float:
        try:
            if "_" in cells[name]:  # Python alone takes it for a number
                raise ValueError
            return float(cells[name])
        except ValueError:
            _fail(self.path, line, name, f"must be a number, but is {cells[name]!r}")


def _samples(
    path: Path, rows: _Collected, columns: Columns, t: str
) -> tuple[np.ndarray, np.ndarray]:
    names, given = columns
    values = np.array(rows.values).reshape(-1, len(names))
    try:
        return np.array(rows.t), check_samples(given, np.array(rows.t), values)
    except SampleError as problem:
        component = problem.component
        column = ",".join(names) if component is None else (*names, t)[component]
        _fail(path, rows.lines[problem.sample], column, problem.words)
