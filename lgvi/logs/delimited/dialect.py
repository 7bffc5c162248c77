"""How delimited text is written, and where its samples begin."""

import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from .text_files import NoTableError, Options, Text, shorten

DELIMITERS = ",", ";", "\t", "|", " "
DECIMALS = ".", ","
MARKS = "#", "%", "//"  # of comments
NUMBERS = {
    ".": re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[+-]?(?i:inf|infinity)", re.A),
    ",": re.compile(r"[+-]?(?:\d+(?:,\d+)?|,\d+)(?:[eE][+-]?\d+)?|[+-]?(?i:inf|infinity)", re.A),
}
MISSING = "", "-", "--", "nan", "-nan", "-nan(ind)", "null", "none", "na", "n/a"  # in small letters
DATE = re.compile(  # date, hours and minutes, seconds, fraction, time zone
    r"((?:19|20)\d\d[-/]\d\d[-/]\d\d)(?:[T ](\d\d:\d\d)(?::(\d\d)(?:[.,](\d{1,9}))?)?"
    r"(?: ?(Z|UTC|GMT|(?:UTC ?|GMT ?)?[+-]\d\d(?::?\d\d)?))?)?",
    re.A,
)
TIME_OF_DAY = re.compile(r"(\d{1,2}):([0-5]\d):([0-5]\d)(?:[.,](\d{1,9}))?", re.A)
TIMES = "number", "date", "time of day"  # kinds of cells
MOST_BEFORE = 2000  # lines in front of the samples
LONGEST_LINE = 1 << 20  # bytes
SAMPLED = 100  # lines by which the delimiter is recognised


def split_line(line: str, delimiter: str) -> list[str]:
    """The cells of a line."""
    if '"' in line:
        try:
            rows = csv.reader([line.strip(" ")], delimiter=delimiter, skipinitialspace=True)
            return [cell.strip() for cell in next(rows, [])]
        except csv.Error:  # a cell is longer than the package allows
            return [line]
    cells = line.split() if delimiter == " " else line.split(delimiter)
    return [cell.strip() for cell in cells]


def kind_of(cell: str, decimal: str) -> str:
    """The kind of a cell: "number", "missing", "date", "time of day" or "words"."""
    if NUMBERS[decimal].fullmatch(cell):
        return "number"
    if cell.lower() in MISSING:
        return "missing"
    if DATE.fullmatch(cell):
        return "date"
    return "time of day" if TIME_OF_DAY.fullmatch(cell) else "words"


class Dialect(NamedTuple):
    """What is between cells and in numbers, and the usual kind of the cells of each column."""

    delimiter: str
    decimal: str
    kinds: tuple[str, ...]

    def has_number(self, cells: Sequence[str]) -> bool:
        """Whether a cell is a number or a time."""
        return any(kind_of(cell, self.decimal) in TIMES for cell in cells)

    def agreement(self, cells: Sequence[str]) -> float:
        """The part of cells that are of the kind of their column, or missing."""
        if len(cells) != len(self.kinds) or not self.has_number(cells):
            return 0.0
        pairs = zip(cells, self.kinds, strict=True)
        known = [(cell, kind) for cell, kind in pairs if kind in TIMES]
        same = [kind_of(cell, self.decimal) in (kind, "missing") for cell, kind in known]
        return float(np.mean(same))


def recognise_dialect(text: Text, options: Options) -> Dialect:
    """The delimiter and decimal mark with which most cells are numbers or times."""
    lines = _probable_samples(text)
    best, most = None, 0.0
    for delimiter in DELIMITERS if options.delimiter is None else (options.delimiter,):
        rows = [split_line(line, delimiter) for line in lines]
        widths = Counter(map(len, rows))
        width = max(widths, key=lambda width: (widths[width], width), default=0)
        rows = [row for row in rows if len(row) == width]
        for decimal in DECIMALS if options.decimal is None else (options.decimal,):
            kinds = [[kind_of(cell, decimal) for cell in row] for row in rows]
            count = Counter(kind for row in kinds for kind in row)
            score = sum(count[kind] for kind in TIMES) - count["words"]
            score *= len(rows) / max(len(lines), 1)
            if decimal != delimiter and score > most:
                of_columns = [_commonest(column) for column in zip(*kinds, strict=True)]
                best, most = Dialect(delimiter, decimal, tuple(of_columns)), score
    if best is None:
        words = "must be a table of numbers, or of times such as 2024-12-31 23:59:59.5, with"
        has = f"but has {shorten(lines[-1])}" if lines else "but has no line"
        raise NoTableError(text.path, f"{words} ',', ';', tabs, '|' or spaces between, {has}")
    decimal = ", the decimal mark is ','" if best.decimal == "," else ""
    text.words.append(f"Cells are separated by {best.delimiter!r}{decimal}.")
    return best


def _commonest(kinds: Iterable[str]) -> str:
    count = Counter(kind for kind in kinds if kind != "missing")
    return count.most_common(1)[0][0] if count else "missing"


def _probable_samples(text: Text) -> list[str]:
    """Lines that are probably samples: some towards the end, without comments."""
    content = text.content
    if content.count(b"\n") <= 2 * SAMPLED:
        lines = [line for line in content.split(b"\n") if line.strip()]
        lines = lines[2 * len(lines) // 3 :]
    else:
        places = np.linspace(len(content) // 2, len(content), SAMPLED, endpoint=False)
        begins = [content.find(b"\n", int(place)) + 1 for place in places]
        lines = [content[begin : content.find(b"\n", begin)] for begin in begins if begin]
    samples, size = [], 0
    for line in lines:
        if len(line) > LONGEST_LINE:
            raise NoTableError(text.path, f"must have lines of at most {LONGEST_LINE} bytes")
        size += len(line)
        if line.strip() and not line.decode().lstrip().startswith(MARKS) and size < 2e6:
            samples.append(line.decode())
    return samples


class Row(NamedTuple):
    """A line in front of the samples."""

    line: int
    cells: list[str]
    comment: bool


class Body(NamedTuple):
    """The samples of a table, as text."""

    text: Text
    dialect: Dialect
    content: bytes
    line: int  # number of the first line

    def rows(self, headers: Sequence[str]) -> Iterator[tuple[int, list[str]]]:
        """The number and the cells of each line that is not empty.

        Raises
        ------
        LogError
            For a line with more or fewer cells than columns.
        """
        width = len(self.dialect.kinds)
        for line, written in enumerate(io.BytesIO(self.content), self.line):
            if not written.strip():
                continue
            cells = split_line(written.decode().rstrip("\n"), self.dialect.delimiter)
            if len(cells) == width + 1 and not cells[-1]:
                cells.pop()
            if len(cells) > width:
                words = f"must have {width} cells as lines before it, but has {len(cells)}"
                raise self.text.error(words, line)
            if len(cells) < width:
                words = "is missing: the line ends before it"
                raise self.text.error(words, line, headers[len(cells)])
            yield line, cells


def find_samples(text: Text, dialect: Dialect) -> tuple[list[Row], Body]:
    """The lines in front of the samples, and the samples.

    Samples begin with the first two lines that look like samples.
    """
    rows: list[Row] = []
    first: tuple[int, int, int] | None = None  # begin, number, and rows in front of it
    begin, line, width = 0, text.line, len(dialect.kinds)
    while begin < len(text.content) and len(rows) < MOST_BEFORE:
        end = text.content.find(b"\n", begin)
        end = len(text.content) if end < 0 else end
        written = text.content[begin : min(end, begin + LONGEST_LINE)].decode(errors="replace")
        written = written.strip(" ")
        mark = next((mark for mark in MARKS if written.startswith(mark)), "")
        cells = split_line(
            written.removeprefix(mark).strip(" ") if mark else written, dialect.delimiter
        )
        while len(cells) > width and not cells[-1]:
            cells.pop()
        if any(cells):
            is_sample = not mark and dialect.agreement(cells) > 0.5
            if is_sample and first is not None:
                break
            if is_sample:
                first = begin, line, len(rows)
            elif not mark:
                first = None
            rows.append(Row(line, cells, bool(mark)))
        begin, line = end + 1, line + 1
    if first is None:
        raise NoTableError(text.path, "must be a table of numbers, but has no lines of samples")
    begin, line, count = first
    content = _without_comments(text, text.content[begin:])
    return rows[:count], _without_cut_end(Body(text, dialect, content, line))


def _without_comments(text: Text, content: bytes) -> bytes:
    """Samples without comments between them; their lines stay, empty."""
    content, count = re.subn(rb"(?m)^ *(?:#|%|//).*$", b"", content)
    if count:
        text.words.append(f"Comments between samples were left out: {count} lines.")
    return content


def _without_cut_end(body: Body) -> Body:
    """The samples without a last line that is cut off."""
    content, dialect = body.content, body.dialect
    if content.endswith(b"\n") or b"\n" not in content:
        return body
    whole = content[: content.rfind(b"\n") + 1]
    line = body.line + whole.count(b"\n")
    cells = split_line(content[len(whole) :].decode(), dialect.delimiter)
    kinds = [kind_of(cell, dialect.decimal) for cell in cells]
    wrong = [kind == "words" != usual for kind, usual in zip(kinds, dialect.kinds, strict=False)]
    if len(cells) >= len(dialect.kinds) and not any(wrong):
        body.text.words.append("The last line has no line break: its last cell may be cut off.")
        return body
    body.text.words.append(f"The file ends in the middle of line {line}: the line was left out.")
    return body._replace(content=whole)
