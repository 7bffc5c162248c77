"""CSV files, read at once or line by line, with errors that name line and column."""

import codecs
import csv
import io
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from functools import partial
from itertools import islice
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from ...core.typed_arrays import as_count
from ...modules.units import FACTORS, split_unit
from .formats import require_one_of
from .table import (
    PER_SECOND,
    CellError,
    Cells,
    Column,
    Columns,
    Table,
    Timing,
    is_column,
    make_table,
    require_counts,
    require_timing,
)

COMMENTS = "#", "%"  # usual beginnings of a comment
LONGEST = 40  # characters of a cell in an error
COMMA_FOR_POINT = str.maketrans(",.", ".,")  # so that a point is not a decimal mark

TRAJECTORY = "trajectory"  # the default column of trajectories
TIMES = "t", "time", "times", "timestamp", "seconds"  # usual names of the time
DELIMITERS = ",", ";", "\t", "|", " "
BEGIN_OF_LINE = rb"(?<![^\r\n])"
MOST_BEFORE = 100  # lines that may be in front of a header
END_OF_LINE = rb"\r\n|\r|\n"


class Body(NamedTuple):
    """The lines of a file after the header, and the columns to read."""

    read: Callable[[], bytes]  # returns the text in UTF-8, with the header; the text is not kept
    header: Sequence[str]
    header_lines: int
    delimiter: str
    numbers: dict[Column, int]  # index of each numeric column, the time first
    trajectory: int | None = None  # index of the column of trajectory names
    decimal: str = "."
    missing: Sequence[str] = ()  # cells without a number, in addition to empty cells


def read_columns(body: Body) -> Cells | None:
    """The cells of a regular file, read at once; None if a line is irregular."""
    import pyarrow
    from pyarrow import csv as arrow_csv

    places = [str(i) for i in range(len(body.header))]  # names that differ, as headers may not
    kinds = {str(place): pyarrow.float64() for place in body.numbers.values()}
    trajectory = None if body.trajectory is None else str(body.trajectory)
    if trajectory in kinds:
        return None
    if trajectory is not None:
        kinds[trajectory] = pyarrow.dictionary(pyarrow.int32(), pyarrow.string())
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
            pyarrow.system_memory_pool(),  # returns free memory
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
    if trajectory is None:
        return Cells(None, numbers, empty, ("0",), np.zeros(len(table), int))
    return Cells(None, numbers, empty, *_numbered(table[trajectory]))


def _quotes_are_regular(text: bytes, delimiter: str) -> bool:
    """Whether each quote begins or ends a cell, or is doubled, and no quoted cell has two lines.

    With other quotes the reader would lose rows, or accept malformed cells.
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
    """Names in the order of their first lines, and the index of the name of each line."""
    cells = column.unify_dictionaries().combine_chunks()
    names = [name.strip() for name in cells.dictionary.to_pylist()]
    name_of_line = cells.indices.to_numpy()
    first = np.zeros(len(names), int)
    first[name_of_line[::-1]] = np.arange(len(column))[::-1]  # the last assignment counts
    number: dict[str, int] = {}
    for i in np.argsort(first):
        number.setdefault(names[i], len(number))
    return tuple(number), np.array([number[name] for name in names], int)[name_of_line]


def read_lines(body: Body) -> Cells:
    """The cells of a file, read line by line.

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
    """The number in a cell; NaN for an empty cell."""
    if _is_empty(cell, missing):
        return float("nan")
    try:
        if "_" in cell or not cell.isascii():  # a number in Python only
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
    """The option that helps where a cell is not a number, perhaps in the first line."""
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


class Dialect(NamedTuple):
    """How a file is written, as arguments of `Recordings.from_csv`."""

    timing: Timing
    trajectory: Column | None
    delimiter: str
    comment: str | None
    decimal: str
    missing: Sequence[str]
    skip_lines: int


class _Header(NamedTuple):
    names: Sequence[str]
    line: int  # of the names
    lines: int  # number of lines before the first sample


def read_table(
    file: str | PathLike[str], columns: Mapping[str, Columns], dialect: Dialect
) -> Table:
    """The samples of each quantity in each trajectory.

    Raises
    ------
    ValueError
        For malformed input; the message names the file, the line and the column.
    """
    require_counts(columns, by_number=True)
    _require_dialect(dialect)
    if not isinstance(file, (str, PathLike)):
        raise TypeError(f"Argument `file` must be the path of a file, but is {file!r}.")
    path = Path(file)
    try:
        body = _body(path, columns, dialect)
        at_once = _table_at_once(body, columns, dialect)
        return at_once or make_table(read_lines(body), columns, dialect.timing)
    except CellError as error:
        place = f"{path}, line {error.line}"
        if error.column is not None:
            place += f", column `{error.column}`"
        raise ValueError(f"{place}: {error.words}") from None


def _require_dialect(dialect: Dialect) -> None:
    require_timing(dialect.timing, by_number=True)
    require_one_of("delimiter", dialect.delimiter, DELIMITERS)
    require_one_of("decimal", dialect.decimal, (".", ","))
    if dialect.decimal == dialect.delimiter:
        raise ValueError(
            "Argument `decimal` must not be the `delimiter`, but both are ',': where numbers have "
            "a comma, cells are usually apart by `delimiter=';'`."
        )
    as_count("skip_lines", dialect.skip_lines, 0)
    missing: Any = dialect.missing
    if not isinstance(missing, Sequence | Set) or not _are_cells(missing):
        raise TypeError(
            "Argument `missing` must have the cells that say that there is no number, such as "
            f"('NaN', '-'), but is {missing!r}."
        )
    if not (dialect.trajectory is None or is_column(dialect.trajectory, by_number=True)):
        raise TypeError(
            "Argument `trajectory` must be the name or the number of a column, or None, but is "
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


def _are_cells(missing: Any) -> bool:
    return not isinstance(missing, str) and all(isinstance(cell, str) for cell in missing)


def _text(path: Path, skip_lines: int) -> bytes:
    """The text in UTF-8, with an empty line for each skipped line."""
    text = path.read_bytes().removeprefix(codecs.BOM_UTF8)
    try:
        if text.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            text = text.decode("utf-16").encode()
    except UnicodeError as error:
        raise CellError(1, None, "must be text in UTF-8 or UTF-16, but is neither") from error
    skipped = re.match(rb"(?:[^\r\n]*(?:" + END_OF_LINE + rb")){%d}" % skip_lines, text)
    return skip_lines * b"\n" + (b"" if skipped is None else text[skipped.end() :])


def _samples(path: Path, dialect: Dialect) -> bytes:
    """The text, with an empty line for each comment."""
    text = _text(path, dialect.skip_lines)
    if dialect.comment is not None:
        mark = re.escape(dialect.comment.strip().encode())
        text = re.sub(BEGIN_OF_LINE + rb"[ \t]*" + mark + rb"[^\r\n]*", b"", text)
    try:
        text.decode()
    except UnicodeDecodeError as error:
        before = text[: error.start].split(b"\n")
        words = f"must be text in UTF-8, but its byte {len(before[-1]) + 1} is not: save it as that"
        raise CellError(len(before), None, words) from error
    return _with_single_spaces(text) if dialect.delimiter == " " else text


def _with_single_spaces(text: bytes) -> bytes:
    """The text with one space between cells, and none at the beginning and end of lines."""
    if b'"' in text:
        text = re.sub(rb'("[^"\r\n]*")|[ \t]+', lambda match: match[1] or b" ", text)
    else:
        text = re.sub(rb"[ \t]+", b" ", text)
    for end in (b"\r", b"\n"):  # several times faster than a regular expression
        text = text.replace(b" " + end, end).replace(end + b" ", end)
    return text.strip(b" ")


def _body(path: Path, columns: Mapping[str, Columns], dialect: Dialect) -> Body:
    wanted = [dialect.timing.t, *(name for group in columns.values() for name in group.names)]
    trajectory_column = TRAJECTORY if dialect.trajectory is None else dialect.trajectory
    all_wanted = wanted if dialect.trajectory is None else [*wanted, trajectory_column]
    header = _header(path, all_wanted, dialect)
    place = {name: _place(name, header, dialect) for name in all_wanted}
    if header.names.count(trajectory_column) > 1:
        raise CellError(header.line, TRAJECTORY, "must be there at most once")
    if dialect.trajectory is None:
        if TRAJECTORY in header.names:
            place[TRAJECTORY] = header.names.index(TRAJECTORY)
        for name in header.names:
            if name.lower() == TRAJECTORY != name:
                words = f'is not read; write `trajectory="{name}"` if it tells trajectories apart'
                warnings.warn(f"{path}: the column `{name}` {words}.", stacklevel=5)
    names = {name: header.names[place[name]] for name in wanted}
    _compare_units(path, names, columns, dialect.timing)
    return Body(
        read=partial(_samples, path, dialect),
        header=header.names,
        header_lines=header.lines,
        delimiter=dialect.delimiter,
        decimal=dialect.decimal,
        missing=dialect.missing,
        numbers={name: place[name] for name in wanted},
        trajectory=place.get(trajectory_column),
    )


def _header(path: Path, wanted: Sequence[Column], dialect: Dialect) -> _Header:
    """The names of the columns: the first line, without a comment mark, or an earlier comment.

    Without a header, the names are the indices of the columns.
    """
    text, delimiter = _samples(path, dialect), dialect.delimiter
    table = rows(text, delimiter)
    try:
        line, cells = next(table, (1, []))
    except CellError as error:
        raise CellError(
            error.line, None, f"{error.words}{_other_delimiter(text.decode(), delimiter)}"
        ) from error
    names = {name for name in wanted if isinstance(name, str)}
    places = [i for i in wanted if not isinstance(i, str) and i != dialect.trajectory]
    if not names and any(is_number(cells[i], dialect.decimal) for i in places if i < len(cells)):
        return _Header([str(i) for i in range(len(cells))], line, line - 1)
    headers = [_Header(cells, line, line)]
    if cells and cells[0].startswith(COMMENTS):
        first = cells[0].lstrip("".join(COMMENTS)).strip()
        headers.append(_Header(_without_title([first, *cells[1:]]), line, line))
    if dialect.comment is not None:
        headers += _comments_before(line, path, dialect)
    matches = [header for header in headers if all(header.names.count(name) == 1 for name in names)]
    if len(matches) > 1:  # the samples decide whether a single mark is a name
        count = next((len(row) for number, row in table if number > line), None)
        matches = [header for header in matches if len(header.names) == count] or matches
    if names and not matches and cells and not cells[0].startswith(COMMENTS):
        _require_no_later_header(table, names)
    return (matches or headers)[0]


def _require_no_later_header(table: Iterator[tuple[int, list[str]]], names: set[str]) -> None:
    """Check that no line soon after the first one is the header."""
    for line, cells in islice(table, MOST_BEFORE):
        if names <= set(cells):
            words = f"must be the header, but line {line} is: write `skip_lines={line - 1}`"
            raise CellError(1, None, words)


def _comments_before(line: int, path: Path, dialect: Dialect) -> Iterator[_Header]:
    """The comments before a line, the last first; one may have the names of the columns."""
    assert dialect.comment is not None
    lines = re.split(END_OF_LINE, _text(path, dialect.skip_lines))[: line - 1]
    mark = dialect.comment.strip().encode()
    for number in reversed(range(len(lines))):
        if (comment := lines[number].strip()).startswith(mark):
            words = comment.removeprefix(mark).strip().decode(errors="replace").encode()
            words = _with_single_spaces(words) if dialect.delimiter == " " else words
            for _, cells in rows(words, dialect.delimiter):
                yield _Header(_without_title(cells), number + 1, line - 1)


def _without_title(cells: Sequence[str]) -> Sequence[str]:
    """Names in a comment, without a title in front, such as `columns:`."""
    return cells[1:] if not cells[0] or cells[0].endswith(":") else cells


def _place(name: Column, header: _Header, dialect: Dialect) -> int:
    if isinstance(name, str):
        if header.names.count(name) != 1:
            raise CellError(header.line, name, _missing(name, header.names, dialect))
        return header.names.index(name)
    if name >= len(header.names):
        words = f"must be there, counted from 0, but there are {len(header.names)} columns"
        raise CellError(header.line, str(name), words)
    return name


def _missing(name: str, header: Sequence[str], dialect: Dialect) -> str:
    if not header:
        return "must be there once in a header, but there is no line"
    joined = dialect.delimiter.join(header)
    words = repr(joined if len(joined) <= 200 else f"{joined[:200]}...")
    problem = f"must be there once in a header separated by {dialect.delimiter!r}, which is {words}"
    if header.count(name) > 1:
        return f"{problem}; the number of a column, counted from 0, tells which"
    if all(is_number(cell, dialect.decimal) for cell in header):
        return f"{problem}; where there is no header, columns are numbers, counted from 0"
    if len(header) == 1 and (hint := _other_delimiter(joined, dialect.delimiter)):
        return problem + hint
    if len(header) == 1 and name in joined.split():
        return f"{problem}; write `delimiter=' '` if spaces separate them"
    if alike := [other for other in header if other.lower() == name.lower()]:
        return f"{problem}; it has {alike[0]!r}"
    likely = [cell.lstrip("".join(COMMENTS)).strip() for cell in header]
    likely = [cell for cell in likely if split_unit(cell)[0].lower() in TIMES]
    if name == dialect.timing.t and len(likely) == 1:
        unit = split_unit(likely[0])[1]
        also = "" if unit in ("", dialect.timing.unit) else f', time_unit="{unit}"'
        return f'{problem}; write `t="{likely[0]}"{also}` if that is the time'
    if dialect.comment is None and header[0].startswith(COMMENTS):
        return f"{problem}; write `comment={header[0][0]!r}` if that is a comment"
    return problem


def _other_delimiter(text: str, delimiter: str) -> str:
    """The option that helps if the first line of a text has another delimiter."""
    first = re.split("\r\n|\r|\n", text.lstrip("\r\n"), maxsplit=1)[0]
    others = [other for other in DELIMITERS[:4] if other in first and other != delimiter]
    return f"; write `delimiter={others[0]!r}` if that separates them" if others else ""


def _compare_units(
    path: Path, names: Mapping[Column, str], columns: Mapping[str, Columns], timing: Timing
) -> None:
    """Warn where the name of a column says another unit than the arguments."""
    compared: list[tuple[str, Sequence[Column], str, Set[str]]] = [
        ("`time_unit`", [timing.t], timing.unit, PER_SECOND.keys())
    ]
    for quantity, group in columns.items():
        units = {group.form.unit, *FACTORS.get(group.form.unit, {})}
        compared.append((f"the unit of `{quantity}`", group.names, group.conversion.unit, units))
    for label, group, unit, known in compared:
        for name in (names[column] for column in group):
            said = split_unit(name)[1]
            if said in known and said != unit:
                words = f"the name of the column `{name}` says {said}, but {label} is {unit!r}"
                warnings.warn(f"{path}: {words}.", stacklevel=5)
                break


def _table_at_once(body: Body, columns: Mapping[str, Columns], dialect: Dialect) -> Table | None:
    try:
        cells = read_columns(body)
        return None if cells is None else make_table(cells, columns, dialect.timing)
    except CellError:
        return None  # Lines are not counted here, so that the error could not name a line.
