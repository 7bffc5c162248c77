"""Cells of a CSV file as columns of numbers: all at once, or line by line to name what is wrong."""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from .table import CellError, Cells


class Body(NamedTuple):
    """The lines of a file after its header, and the columns that are wanted of them."""

    read: Callable[[], bytes]  # gives the text in UTF-8, with the header, which is not kept
    header: Sequence[str]
    header_lines: int
    delimiter: str
    numbers: Sequence[str]  # the time first
    trajectory: str | None


def read_columns(body: Body) -> Cells | None:
    """The cells of a regular file, read at once; None if a line is out of the ordinary."""
    import pyarrow
    from pyarrow import csv as arrow_csv

    places = [str(i) for i in range(len(body.header))]  # names that differ, as headers may not
    place = {name: str(body.header.index(name)) for name in body.numbers}
    kinds = dict.fromkeys(place.values(), pyarrow.float64())
    of_trajectory = body.trajectory and str(body.header.index(body.trajectory))
    if of_trajectory in kinds:
        return None
    if of_trajectory is not None:
        kinds[of_trajectory] = pyarrow.dictionary(pyarrow.int32(), pyarrow.string())
    text = body.read()
    if not _quotes_are_regular(text, body.delimiter):
        return None
    try:
        table = arrow_csv.read_csv(
            pyarrow.BufferReader(text),
            arrow_csv.ReadOptions(
                column_names=places, skip_rows=body.header_lines, use_threads=False
            ),
            arrow_csv.ParseOptions(delimiter=body.delimiter, newlines_in_values=True),
            arrow_csv.ConvertOptions(
                column_types=kinds, include_columns=list(kinds), null_values=["", " "]
            ),
            pyarrow.system_memory_pool(),  # gives back what is free
        )
    except pyarrow.ArrowInvalid:
        return None
    if len(table) == 0:
        return None
    numbers, empty = {}, {}
    for name, at in place.items():
        empty[name] = table[at].is_null().to_numpy()
        numbers[name] = table[at].to_numpy()
    if of_trajectory is None:
        return Cells(None, numbers, empty, ("0",), np.zeros(len(table), int))
    return Cells(None, numbers, empty, *_numbered(table[of_trajectory]))


def _quotes_are_regular(text: bytes, delimiter: str) -> bool:
    """Whether each quote begins or ends a cell, or is one of two for one, and none holds a line.

    A reader that passes over another quote would lose rows, or read what is malformed.
    """
    if b'"' not in text:
        return True
    characters = np.frombuffer(b"\n" + text + b"\n", np.uint8)
    quotes, ends = np.flatnonzero(characters == ord('"')), np.flatnonzero(characters == ord("\n"))
    if len(quotes) % 2 or np.any(np.searchsorted(quotes, ends) % 2):
        return False
    around = np.append(characters[quotes[::2] - 1], characters[quotes[1::2] + 1])
    return bool(np.isin(around, np.frombuffer(b'"\r\n' + delimiter.encode(), np.uint8)).all())


def _numbered(column: Any) -> tuple[tuple[str, ...], Int[np.ndarray, " lines"]]:
    """Names in the order of their first lines, and the number of the name of each line."""
    given = column.unify_dictionaries().combine_chunks()
    names = [name.strip() for name in given.dictionary.to_pylist()]
    name_of_line = given.indices.to_numpy()
    first = np.zeros(len(names), int)
    first[name_of_line[::-1]] = np.arange(len(column))[::-1]  # the last to be written stays
    number: dict[str, int] = {}
    for i in np.argsort(first):
        number.setdefault(names[i], len(number))
    return tuple(number), np.array([number[name] for name in names], int)[name_of_line]


def read_lines(body: Body) -> Cells:
    """The same, line by line.

    Raises
    ------
    CellError
        For the first line or cell that is malformed.
    """
    place = {name: body.header.index(name) for name in body.numbers}
    of_trajectory = None if body.trajectory is None else body.header.index(body.trajectory)
    trajectories: dict[str, int] = {}
    lines, trajectory, values, empty = [], [], [], []
    for line, cells in _lines(body):
        name = "0" if of_trajectory is None else cells[of_trajectory]
        lines.append(line)
        trajectory.append(trajectories.setdefault(name, len(trajectories)))
        values.append([_number(line, each, cells[i]) for each, i in place.items()])
        empty.append([not cells[i] for i in place.values()])
    if not lines:
        raise CellError(body.header_lines + 1, body.numbers[0], "there is no sample")
    table = np.array(values, float)
    is_empty = np.array(empty, bool)
    return Cells(
        np.array(lines, int),
        dict(zip(place, table.T, strict=True)),
        dict(zip(place, is_empty.T, strict=True)),
        tuple(trajectories),
        np.array(trajectory, int),
    )


def rows(text: bytes, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """The cells of each line that is not empty, and its number.

    Raises
    ------
    CellError
        If a line is not CSV.
    """
    line = 0
    lines = io.TextIOWrapper(io.BytesIO(text), encoding="utf-8", newline="")
    reader = csv.reader(lines, delimiter=delimiter, skipinitialspace=delimiter != " ", strict=True)
    try:
        for row in reader:
            line = reader.line_num
            cells = [cell.strip() for cell in row]
            if any(cells):
                yield line, cells
    except csv.Error as error:
        place, problem = reader.line_num, str(error)
        if "end of data" in problem:
            place, problem = line + 1, "has a quote that is never closed"
        raise CellError(place, None, f"must be CSV, but {problem}") from error


def _lines(body: Body) -> Iterator[tuple[int, list[str]]]:
    header = body.header
    for line, cells in rows(body.read(), body.delimiter):
        if line <= body.header_lines:
            continue
        if len(cells) > len(header):
            raise CellError(line, str(len(header) + 1), "has no name in the header")
        if len(cells) < len(header):
            raise CellError(line, header[len(cells)], "is missing: the line ends before it")
        yield line, cells


def _number(line: int, column: str, cell: str) -> float:
    try:
        if "_" in cell or not cell.isascii():  # Python alone takes it for a number
            raise ValueError
        return float(cell or "nan")
    except ValueError:
        raise CellError(line, column, f"must be a number, but is {cell!r}") from None
