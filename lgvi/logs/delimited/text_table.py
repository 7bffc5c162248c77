"""A table of delimited text: its columns, and their numbers."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..signal import LogError
from .dialect import MISSING, NUMBERS, Body, kind_of
from .text_files import shorten

COMMA_FOR_POINT = str.maketrans(",.", ".,")


class Column(NamedTuple):
    """A column of a table."""

    name: str
    unit: str
    header: str  # as in the file
    kind: str  # of most cells
    cells: Any  # text: a list, or an array of pyarrow


class Table(NamedTuple):
    """A table of a file."""

    body: Body
    columns: list[Column]
    line: int | None  # of the header
    facts: dict[str, str]
    rate: float  # Hz, if the file declares one; or NaN
    name: str  # of the file in its folder
    case: "Case | None" = None

    @property
    def names(self) -> list[str]:
        """The names of the columns."""
        return [column.name for column in self.columns]

    @property
    def words(self) -> list[str]:
        """What was recognised."""
        return self.body.text.words

    def error(self, words: str, place: int) -> LogError:
        """An error in the header of a column."""
        return self.body.text.error(words, self.line, self.columns[place].header)

    def find(self, name: str) -> int | None:
        """The place of the column with a name or a header."""
        headers = [column.header.lstrip("#% ") for column in self.columns]
        for names in (self.names, headers):
            if name.lstrip("#% ") in names:
                return names.index(name.lstrip("#% "))
        return None

    def not_a(self, kind: str, place: int, row: int) -> LogError:
        """The error for a cell of another kind."""
        text, headers = self.body.text, [column.header for column in self.columns]
        line, cells = next(sample for i, sample in enumerate(self.body.rows(headers)) if i == row)
        if sum(cell == header for cell, header in zip(cells, headers, strict=True)) > 1:
            return text.error("must be a sample, but repeats the header: divide the file", line)
        words = f"must be a {kind}, but is {shorten(cells[place])}"
        other = "," if self.body.dialect.decimal == "." else "."
        if NUMBERS[other].fullmatch(cells[place]):
            words += f"; write `decimal={other!r}` if that is the decimal mark"
        return text.error(words, line, headers[place])

    def numbers(self, place: int) -> Float[np.ndarray, " samples"] | None:
        """The numbers in a column, NaN where one is missing; None if most cells are words.

        Raises
        ------
        LogError
            For the first cell that is no number.
        """
        column = self.columns[place]
        if column.unit == "flags":
            return None
        at_once = _numbers_at_once(column.cells)
        if at_once is not None:
            return at_once
        if _are_words([kind_of(cell, ".") for cell in as_list(column.cells[:1000])]):
            return None
        cells = as_list(column.cells)
        kinds = [kind_of(cell, ".") for cell in cells]
        if _are_words(kinds):
            return None
        if words := [i for i, kind in enumerate(kinds) if kind not in ("number", "missing")]:
            raise self.not_a("number", place, words[0])
        pairs = zip(cells, kinds, strict=True)
        return np.array([float(cell) if kind == "number" else np.nan for cell, kind in pairs])


def _are_words(kinds: Sequence[str]) -> bool:
    return len(kinds) - kinds.count("missing") > 2 * kinds.count("number")


def read_cells(body: Body, headers: Sequence[str]) -> list[Any]:
    """The cells of each column, as text with decimal points."""
    at_once = _cells_at_once(body)
    if at_once is not None:
        return at_once
    columns = [list(column) for column in zip(*(row for _, row in body.rows(headers)), strict=True)]
    if body.dialect.decimal == ",":
        return [[cell.translate(COMMA_FOR_POINT) for cell in column] for column in columns]
    return columns


def _cells_at_once(body: Body) -> list[Any] | None:
    """The cells of each column of regular text; None of other text, or without pyarrow."""
    dialect, content = body.dialect, body.content
    if b'"' in content or (dialect.decimal == "," and b"." in content):
        return None
    try:
        from pyarrow import ArrowInvalid, BufferReader, csv, string
    except ImportError:
        return None
    if dialect.decimal == ",":
        content = content.replace(b",", b".")
    names = [str(i) for i in range(len(dialect.kinds))]
    try:
        table = csv.read_csv(
            BufferReader(_without_spaces(content, dialect.delimiter.encode())),
            # One thread, as another could free the text after this function has returned.
            csv.ReadOptions(column_names=names, use_threads=False),
            csv.ParseOptions(delimiter=dialect.delimiter, quote_char=False),
            csv.ConvertOptions(
                column_types=dict.fromkeys(names, string()),
                null_values=[*MISSING, "NaN", "NULL", "NA", "None", "N/A"],
                strings_can_be_null=True,
            ),
        )
    except ArrowInvalid:  # it does not tell where
        return None
    return [table[name] for name in names]


def _without_spaces(content: bytes, delimiter: bytes) -> bytes:
    """Text without spaces and tabs around cells."""
    if delimiter != b"\t":
        content = content.replace(b"\t", b" ")
    for spaced in (delimiter + b" ", b" " + delimiter, b" \n", b"\n "):
        while spaced in content:
            content = content.replace(spaced, spaced.strip(b" ") or b" ")
    return content.lstrip(b" ")


def _numbers_at_once(cells: Any) -> Float[np.ndarray, " samples"] | None:
    """The numbers in a column; None if a cell is none, or is written unusually."""
    if isinstance(cells, list):
        text = "".join(cells)
        if "_" in text or not text.isascii():  # numbers in Python only
            return None
        try:
            return np.array([float(cell) for cell in cells])
        except ValueError:
            return None
    from pyarrow import ArrowInvalid, float64

    try:
        return cells.cast(float64()).to_numpy()
    except ArrowInvalid:
        return None


def as_list(cells: Any) -> list[str]:
    """The cells of a column as a list."""
    if isinstance(cells, list):
        return cells
    return [(cell or "").strip() for cell in cells.to_pylist()]


class Case(NamedTuple):
    """What the documentation of a product says of its files."""

    kind: str
    recognises: Callable[[Table], bool]
    patterns: tuple[str, ...]  # of "title of the file/name of the column"
    describe: Callable[[Table, str, tuple[str, ...]], Mapping[str, Any]]  # of a vector
    times: Mapping[str, str] = {}  # units of columns of time, the preferred one first
    one_clock: bool = False  # of all files
    since_1970: bool = False
    remark: str = ""
