"""Recordings in CSV files, with errors that name the line and the column."""

import csv
import io
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import NoReturn

import numpy as np

from .samples import KINDS, as_matrices, find_problem

TRAJECTORY = "trajectory"  # the column that is looked for by default
Table = dict[str, dict[str, tuple[np.ndarray, np.ndarray] | None]]


class _Rows:
    """Samples of one quantity in one trajectory, and the lines they are from."""

    def __init__(self) -> None:
        self.lines: list[int] = []
        self.t: list[float] = []
        self.values: list[list[float]] = []


def read_table(
    file: str | PathLike[str], columns: Mapping[str, Sequence[str]], t: str, trajectory: str | None
) -> Table:
    """For each trajectory a dictionary of `(t, value)` by quantity."""
    path = Path(file)

    def fail(line: int, column: str, problem: str) -> NoReturn:
        raise ValueError(f"{path}, line {line}, column `{column}`: {problem}")

    for kind, names in columns.items():
        counts = (4, 9) if kind == "attitude" else (3,)
        if isinstance(names, str) or len(names) not in counts:
            wanted = " or ".join(map(str, counts))
            raise ValueError(f"Argument `{kind}` must name {wanted} columns, but is {names!r}.")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: must be text in UTF-8, but {error}") from error
    reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
    header = [name.strip() for name in next(reader, [])]
    used = [t, *(name for names in columns.values() for name in names)]
    if trajectory is not None:
        used.append(trajectory)
    for name in used:
        if header.count(name) != 1:
            words = f"{','.join(header)!r}" if any(header) else "empty"
            fail(1, name, f"must be there once in a header separated by commas, which is {words}")
    told_apart_by = trajectory or TRAJECTORY
    if header.count(told_apart_by) > 1:
        fail(1, told_apart_by, "must be there at most once")
    place = {name: header.index(name) for name in used}
    name_at = header.index(told_apart_by) if told_apart_by in header else None

    found: dict[str, dict[str, _Rows]] = {}
    for row in reader:
        line = reader.line_num
        if not any(cell.strip() for cell in row):
            continue  # an empty line
        if len(row) > len(header):
            fail(line, str(len(header) + 1), "has no name in the header")
        if len(row) < len(header):
            fail(line, header[len(row)], "is missing: the line ends before it")

        def number(name: str, row=row, line=line) -> float:
            try:
                return float(row[place[name]])
            except ValueError:
                fail(line, name, f"must be a number, but is {row[place[name]]!r}")

        time = number(t)
        which = "0" if name_at is None else row[name_at].strip()
        of_trajectory = found.setdefault(which, {kind: _Rows() for kind in columns})
        for kind, names in columns.items():
            if not any(row[place[name]].strip() for name in names):
                continue  # not sampled at this time
            rows = of_trajectory[kind]
            rows.lines.append(line)
            rows.t.append(time)
            rows.values.append([number(name) for name in names])

    if not found:
        fail(2, t, "there is no sample")
    table: Table = {}
    for which, of_trajectory in found.items():
        table[which] = dict.fromkeys(KINDS)
        for kind, names in columns.items():
            rows = of_trajectory[kind]
            times, values = np.array(rows.t), np.array(rows.values).reshape(-1, len(names))
            if problem := find_problem(kind, times, values):
                component = problem.component
                column = ",".join(names) if component is None else (*names, t)[component]
                fail(rows.lines[problem.sample], column, problem.words)
            table[which][kind] = times, as_matrices(values) if kind == "attitude" else values
    return table
