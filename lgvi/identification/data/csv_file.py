"""Recordings in CSV files, with errors that name the line and the column."""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from .csv_cells import Body, read_columns, read_lines, rows
from .table import (
    CellError,
    Columns,
    Table,
    Timing,
    make_table,
    require_counts,
    require_one_of,
    require_timing,
)

TRAJECTORY = "trajectory"  # the column that is looked for by default
TIMES = "t", "time", "times", "timestamp", "seconds", "t_s", "time_s"  # usual names of the time
DELIMITERS = ",", ";", "\t", "|", " "
COMMENTS = "#", "%"  # usual beginnings of a comment


class Dialect(NamedTuple):
    """How a file is written, as arguments of `Recordings.from_csv`."""

    timing: Timing
    trajectory: str | None
    delimiter: str
    comment: str | None


def read_table(
    file: str | PathLike[str], columns: Mapping[str, Columns], dialect: Dialect
) -> Table:
    """For each trajectory the samples of each quantity.

    Raises
    ------
    ValueError
        For anything that is malformed, naming the file, the line and the column.
    """
    require_counts(columns)
    _require_dialect(dialect)
    if not isinstance(file, (str, PathLike)):
        raise TypeError(f"Argument `file` must be the path of a file, but is {file!r}.")
    path = Path(file)
    try:
        body = _body(partial(_text, path, dialect.comment), columns, dialect)
        at_once = _table_at_once(body, columns, dialect)
        return at_once or make_table(read_lines(body), columns, dialect.timing)
    except CellError as error:
        place = f"{path}, line {error.line}"
        if error.column is not None:
            place += f", column `{error.column}`"
        raise ValueError(f"{place}: {error.words}") from None


def _require_dialect(dialect: Dialect) -> None:
    require_timing(dialect.timing)
    require_one_of("delimiter", dialect.delimiter, DELIMITERS)
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
    numbers = [dialect.timing.t, *(name for names, _ in columns.values() for name in names)]
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
    if header and dialect.comment is None and header[0].startswith(COMMENTS):
        return f"{problem}; write `comment={header[0][0]!r}` if that is a comment"
    if len(header) == 1 and (other := [each for each in DELIMITERS[:4] if each in header[0]]):
        return f"{problem}; write `delimiter={other[0]!r}` if that separates them"
    likely = [each for each in header if each.lower() in TIMES]
    if name == dialect.timing.t and len(likely) == 1:
        return f'{problem}; write `t="{likely[0]}"` if that is the time'
    return problem


def _table_at_once(body: Body, columns: Mapping[str, Columns], dialect: Dialect) -> Table | None:
    try:
        cells = read_columns(body)
        return None if cells is None else make_table(cells, columns, dialect.timing)
    except CellError:
        return None  # The lines are not counted here, so that the error could not name one.
