"""Cells of a CSV file as columns of numbers: all at once, or line by line to name what is wrong."""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from .table import CellError, Cells, Column

COMMENTS = "#", "%"  # usual beginnings of a comment
LONGEST = 40  # characters of a cell that is told
COMMA_FOR_POINT = str.maketrans(",.", ".,")  # a point is then no decimal mark


class Body(NamedTuple):
    """The lines of a file after its header, and the columns that are wanted of them."""

    read: Callable[[], bytes]  # gives the text in UTF-8, with the header, which is not kept
    header: Sequence[str]
    header_lines: int
    delimiter: str
    numbers: dict[Column, int]  # the place of each column that is read as numbers, the time first
    trajectory: int | None = None  # the place of the column that tells trajectories apart
    decimal: str = "."
    missing: Sequence[str] = ()  # cells that say that there is no number, beside empty ones


def read_columns(body: Body) -> Cells | None:
    """The cells of a regular file, read at once; None if a line is out of the ordinary."""
    import pyarrow
    from pyarrow import csv as arrow_csv

    places = [str(i) for i in range(len(body.header))]  # names that differ, as headers may not
    kinds = {str(place): pyarrow.float64() for place in body.numbers.values()}
    of_trajectory = None if body.trajectory is None else str(body.trajectory)
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
                column_types=kinds,
                include_columns=list(kinds),
                null_values=["", " ", *body.missing],
                decimal_point=body.decimal,
            ),
            pyarrow.system_memory_pool(),  # gives back what is free
        )
    except pyarrow.ArrowInvalid:
        return None
    if len(table) == 0:
        return None
    numbers, empty = {}, {}
    for name, place in body.numbers.items():
        empty[name] = table[str(place)].is_null().to_numpy()
        numbers[name] = table[str(place)].to_numpy()
        if (np.isnan(numbers[name]) & ~empty[name]).any():
            return None
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
    names, places = list(body.numbers), list(body.numbers.values())
    trajectories: dict[str, int] = {}
    lines, trajectory, values, empty = [], [], [], []
    for line, cells in _lines(body):
        name = "0" if body.trajectory is None else cells[body.trajectory]
        try:
            numbers = [_number(cells[i], body.decimal, body.missing) for i in places]
        except _NotANumberError as error:
            column = next(str(name) for name in names if cells[body.numbers[name]] == error.cell)
            option = _option(body, cells, error.cell, None if lines else line)
            raise CellError(line, column, f"{error}{option}") from None
        lines.append(line)
        trajectory.append(trajectories.setdefault(name, len(trajectories)))
        values.append(numbers)
        empty.append([_is_empty(cells[i], body.missing) for i in places])
    if not lines:
        raise CellError(body.header_lines + 1, str(names[0]), "there is no sample")
    table = np.array(values, float)
    is_empty = np.array(empty, bool)
    return Cells(
        np.array(lines, int),
        dict(zip(names, table.T, strict=True)),
        dict(zip(names, is_empty.T, strict=True)),
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
            words = "has no name in the header"
            if not any(cells[len(header) :]):
                words += ": the line ends with a delimiter more"
            raise CellError(line, str(len(header) + 1), words)
        if len(cells) < len(header):
            words = "is missing: the line ends before it"
            if cells[0].startswith(COMMENTS):
                words += f"; write `comment={cells[0][0]!r}` if the line is a comment"
            raise CellError(line, header[len(cells)], words)
        yield line, cells


class _NotANumberError(ValueError):
    def __init__(self, words: str, cell: str):
        super().__init__(words)
        self.cell = cell


def _number(cell: str, decimal: str, missing: Sequence[str]) -> float:
    """The number of a cell, NaN for an empty one."""
    if _is_empty(cell, missing):
        return float("nan")
    try:
        if "_" in cell or not cell.isascii():  # Python alone takes it for a number
            raise ValueError
        number = float(cell if decimal == "." else cell.translate(COMMA_FOR_POINT))
    except ValueError:
        short = cell if len(cell) <= LONGEST else f"{cell[:LONGEST]}..."
        raise _NotANumberError(f"must be a number, but is {short!r}", cell) from None
    if number != number:
        raise _NotANumberError(f"must be finite, but is {cell!r}", cell)
    return number


def _is_empty(cell: str, missing: Sequence[str]) -> bool:
    return not cell or cell in missing


def is_number(cell: str, decimal: str) -> bool:
    """Whether a cell has a number."""
    try:
        return not np.isnan(_number(cell, decimal, ()))
    except _NotANumberError:
        return False


def _option(body: Body, cells: Sequence[str], cell: str, first_line: int | None) -> str:
    """The option that would help where a cell is no number, perhaps in the first line."""
    if list(cells) == list(body.header):
        return "; the line repeats the header: make a file of each part, and `concatenate` them"
    if cell.lower() in ("nan", "na", "n/a", "null", "none", "-", "--"):
        return f"; write `missing=({cell!r},)` if that says that there is no number"
    other = {".": ",", ",": "."}[body.decimal]
    if is_number(cell, other):
        return f"; write `decimal={other!r}` if that is the decimal mark"
    named = any(isinstance(name, str) for name in body.numbers)
    if (
        first_line is not None
        and named
        and not any(is_number(cells[i], body.decimal) for i in body.numbers.values())
    ):
        return (
            "; if the line has units, give columns by their numbers, with "
            f"`skip_lines={first_line}`"
        )
    return ""
