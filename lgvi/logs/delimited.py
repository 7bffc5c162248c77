"""Delimited text: CSV files of any origin, and zip files and folders of them.

One mechanism reads all of them: how a file is written is seen in its lines, what its columns are in
its header. `CASES` only adds what the documentation of a product says of headers.
"""

import csv
import io
import os
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .log import Log
from .signal import LogError, Signal, foreign_reader
from .ulog import DOCUMENTED as PX4_DOCUMENTED
from .units import SPELLINGS, standard_spelling

KIND = "delimited text"
DELIMITERS = ",", ";", "\t", "|", " "
DECIMALS = ".", ","
MARKS = "#", "%", "//"  # of comments
SUFFIXES = ".csv", ".tsv", ".txt", ".tum", ".dat"
NUMBERS = {
    ".": re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[+-]?(?i:inf|infinity)", re.A),
    ",": re.compile(r"[+-]?(?:\d+(?:,\d+)?|,\d+)(?:[eE][+-]?\d+)?|[+-]?(?i:inf|infinity)", re.A),
}
MISSING = "", "-", "--", "nan", "-nan", "-nan(ind)", "null", "none", "na", "n/a"  # in small letters
DATE = re.compile(
    r"((?:19|20)\d\d[-/]\d\d[-/]\d\d)(?:[T ](\d\d:\d\d(?::\d\d(?:[.,]\d{1,9})?)?)"
    r"(?: ?(Z|UTC|(?:UTC ?)?[+-]\d\d:?\d\d))?)?",
    re.A,
)
TIME_OF_DAY = re.compile(r"(\d{1,2}):([0-5]\d):([0-5]\d)(?:[.,](\d{1,9}))?", re.A)
COMMA_FOR_POINT = str.maketrans(",.", ".,")
TIMES = "number", "date", "time of day"  # kinds of cells

LARGEST = 1 << 30  # bytes of text
RATIO, SMALL = 100, 1 << 24  # a zip file with more text than SMALL may hold RATIO times its size
MOST_FILES = 1000
MOST_BEFORE = 2000  # lines in front of the samples
LONGEST_LINE = 1 << 20  # bytes
SAMPLED = 100  # lines by which the delimiter is recognised
SHOWN = 40  # characters of a cell in an error

TICKS = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}  # in a second
TIME_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "usecs", "micros", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosecond", "nanoseconds"), "ns"),
}
UNITS = {  # besides other spellings
    *("rad/s", "deg/s", "rpm", "rev/s", "rad/s²", "deg/s²", "m/s²", "g", "mg", "m/s", "km/h"),
    *("m", "cm", "mm", "km", "ft", "rad", "deg", "T", "mT", "uT", "nT", "G", "mG", "N m", "N"),
    *("V", "mV", "A", "mA", "mAh", "W", "K", "C", "°C", "degC", "Pa", "kPa", "hPa", "mbar", "bar"),
    *("Hz", "kHz", "%", "lx", "dB", "dBm", "kg", "flags"),
}
ENDINGS = {  # units in names such as acc_x_g
    **{name: unit for name, unit in TIME_UNITS.items() if name.isascii()},
    **dict.fromkeys(("rad_s", "radps", "rads"), "rad/s"),
    **dict.fromkeys(("deg_s", "degps", "dps"), "deg/s"),
    **dict.fromkeys(("m_s2", "m_s_2", "mps2", "ms2", "mss"), "m/s²"),
    **dict.fromkeys(("ut", "uT"), "uT"),
    **dict.fromkeys(("ga", "gauss"), "G"),
    **{unit: unit for unit in ("rpm", "rad", "deg", "g", "m", "mm", "cm", "nT", "mG")},
}
TIME_NAMES = {
    *("t", "ts", "time", "times", "timestamp", "timestamps", "stamp", "elapsed", "epoch"),
    *("date", "datetime", "seconds", "secs", "millis", "milliseconds", "micros", "microseconds"),
    *("nanos", "nanoseconds", "usec", "msec", "nsec"),
}
TIME_COMPANIONS = {  # other words in names of times
    *("since", "start", "boot", "from", "of", "the", "unix", "utc", "gps", "posix", "system"),
    *("sys", "sample", "log", "relative", "rel", "absolute", "abs", "device", "host", "local"),
    *("s", "sec", "ms", "us", "ns", "and"),
}
SINCE_1970 = {"unix", "epoch", "posix"}
PLAIN_TIMES = "t", "time"
PLAIN_STEPS = 1e-5, 1.0  # s: usual intervals of samples
LONG = 10**6  # s, from which times are counted from the first of them
DAY = 86_400 * 10**9  # ns
LATEST = 10**11  # s since 1970
COUNTERS = 2**16, 2**32
USUAL_STEPS = 100  # a counter goes on after its end within so many median steps

SECTION = re.compile(
    rb"(?m)^\"?(Devices|Joints|Segments|Trajectories|Objects|Model Outputs|Events)\"?[,;\t ]*\n"
    rb"\"?([0-9]+(?:[.,][0-9]+)?)\"?[,;\t ]*$"
)
RATE = re.compile(
    r"\b(?:frame|sampl\w*|data|capture|export)[ _]?(?:rate|frequency)\b[^\w.]{1,12}"
    r"(\d+(?:\.\d+)?) ?(k?Hz|fps)?(?![\w.])",
    re.A | re.I,
)


class Options(NamedTuple):
    """What a user says of files; None or empty for what is to be recognised."""

    delimiter: str | None
    decimal: str | None
    time: tuple[str, ...]
    time_unit: str | None
    units: Mapping[str, str]


def read(
    path: Path,
    delimiter: str | None = None,
    decimal: str | None = None,
    time: str | Sequence[str] | None = None,
    time_unit: str | None = None,
    units: Mapping[str, str] | None = None,
) -> Log:
    """Read delimited text: a file, a zip file of files, or a folder of files.

    Encoding, comments, lines in front of the header, header, delimiter, decimal mark, columns of
    time and units are recognised; `Log.assumed` says how. Each column of numbers is a signal with
    the name of its header; columns that are a vector by the documentation of a product are one
    signal. In folders, names of signals begin with the name of the file. Columns of words are left
    out. Cells that are empty, or `NaN`, `-` or `null`, are NaN.

    Parameters
    ----------
    path
        The file or folder.
    delimiter
        What is between cells: `","`, `";"`, a tab, `"|"` or a space.
    decimal
        The decimal mark, `"."` or `","`.
    time
        The column of time; or a column of dates and one of times of day; or the columns of time of
        several sensors, each of which is that of the columns up to the next.
    time_unit
        Unit of the time, `"s"`, `"ms"`, `"us"` or `"ns"`.
    units
        Units by the names of columns or signals, where the file tells none or a wrong one.

    Returns
    -------
    Log
        Times are those of the file if they begin within 10⁶ s of their zero, and otherwise since
        the whole second before the first. Times of day are since midnight.

    Raises
    ------
    LogError
        If the file is no table of numbers, a cell is no number, or the time or its unit cannot be
        recognised; the message names line and column.

    References
    ----------
    phyphox: <https://phyphox.org/wiki/>. blackbox_decode:
    <https://github.com/betaflight/blackbox-tools>. ulog2csv: <https://github.com/PX4/pyulog>,
    <https://docs.px4.io/main/en/msg_docs/>. OptiTrack Motive:
    <https://docs.optitrack.com/motive/data-export/data-export-csv>,
    <https://help.naturalpoint.com/kb/articles/changes-in-motive-s-reported-euler-angles>. Vicon:
    <https://help.vicon.com/>. TUM:
    <https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats>. EuRoC:
    <https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets>.
    """
    path = Path(path)
    options = _as_options(delimiter, decimal, time, time_unit, units)
    files = _files(path)
    metadata = {name: files.pop(name) for name in list(files) if name.endswith(PHYPHOX_METADATA)}
    is_file = not path.is_dir() and not _is_zip(path)
    tables, assumed = _tables(path, files, is_file, options)
    signals, start, zeros = _signals(path, tables, is_file, options)
    assumed += _said(tables) + zeros
    facts: dict[str, str] = {}
    for table in reversed(tables):
        facts.update(table.facts)
    start = _add_phyphox_metadata(metadata, facts, assumed) or start
    kinds = dict.fromkeys(table.case.kind for table in tables if table.case)
    kind = ", ".join(kinds) or KIND
    return Log(str(path), kind, signals, start, facts, None, tuple(assumed))


def _as_options(delimiter: Any, decimal: Any, time: Any, time_unit: Any, units: Any) -> Options:
    for name, value, allowed in (
        ("delimiter", delimiter, DELIMITERS),
        ("decimal", decimal, DECIMALS),
        ("time_unit", time_unit, tuple(TICKS)),
    ):
        if value is not None and value not in allowed:
            words = ", ".join(map(repr, allowed))
            raise ValueError(f"Argument `{name}` must be one of {words}, but is {value!r}.")
    if delimiter is not None and delimiter == decimal:
        raise ValueError("Argument `decimal` must not be the `delimiter`, but both are ','.")
    units = {} if units is None else units
    if not isinstance(units, Mapping) or not all(isinstance(unit, str) for unit in units.values()):
        words = "must give units by columns, such as {'gyro_x': 'deg/s'}"
        raise ValueError(f"Argument `units` {words}, but is {units!r}.")
    times = (time,) if isinstance(time, str) else tuple(time or ())
    if not all(isinstance(name, str) for name in times):
        raise ValueError(f"Argument `time` must be names of columns, but is {time!r}.")
    return Options(delimiter, decimal, times, time_unit, units)


# Files.


def _is_zip(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(4) in (b"PK\x03\x04", b"PK\x05\x06")


def _files(path: Path) -> dict[str, bytes]:
    """The content of each file of text, by its path in the folder or zip file."""
    if path.is_dir():
        names = sorted(
            Path(folder, name).relative_to(path).as_posix()
            for folder, _, inside in os.walk(path)
            for name in inside
        )
        return {name: _content(path / name) for name in _names_of_texts(path, names)}
    return _members(path) if _is_zip(path) else {path.name: _content(path)}


def _content(path: Path) -> bytes:
    if path.stat().st_size > LARGEST:
        raise LogError(path, f"must have at most {LARGEST} bytes of text")
    return path.read_bytes()


def _members(path: Path) -> dict[str, bytes]:
    """The files of text in a zip file, which may be larger than it declares."""
    left = min(LARGEST, max(SMALL, RATIO * path.stat().st_size))
    files = {}
    content = io.BytesIO(_content(path))
    with foreign_reader(path, "a zip file"), zipfile.ZipFile(content) as archive:
        for name in _names_of_texts(path, sorted(set(archive.namelist()))):
            with archive.open(name) as member:
                files[name] = member.read(left + 1)
            left -= len(files[name])
            if left < 0:
                raise LogError(path, "holds more text than a log of its size", f"file `{name}`")
    return files


def _names_of_texts(path: Path, names: Sequence[str]) -> list[str]:
    if any(name.startswith("xl/") for name in names):
        raise LogError(path, "must be text, but is a spreadsheet: save its sheets as CSV")
    hidden = "__MACOSX/", "."
    texts = [name for name in names if name.lower().endswith(SUFFIXES)]
    texts = [name for name in texts if not name.startswith(hidden)]
    if not 0 < len(texts) <= MOST_FILES:
        words = f"must have 1 to {MOST_FILES} files of text ({', '.join(SUFFIXES)})"
        raise LogError(path, f"{words}, but has {len(texts)}")
    return texts


class Text(NamedTuple):
    """A file, or a section of a file: text in UTF-8 with line breaks of one byte."""

    path: Path
    title: str  # of the file or section
    content: bytes
    line: int  # number of the first line
    rate: float  # Hz, if the section declares one; or NaN
    words: list[str]  # what was recognised

    def error(self, words: str, line: int | None = None, column: str | None = None) -> LogError:
        """An error that names the place."""
        places = [] if line is None else [f"line {line}"]
        places += [] if column is None else [f"column `{column}`"]
        return LogError(self.path, words, ", ".join(places))


class NoTableError(LogError):
    """A file without a table of numbers."""


def _decoded(path: Path, title: str, content: bytes) -> Text:
    """The text of a file, by its byte-order mark, or as UTF-8, or as Latin-1."""
    text = Text(path, title, b"", 1, float("nan"), [])
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        whole = content[: len(content) // 2 * 2]
        content = whole.decode("utf-16", errors="replace").encode()
        text.words.append("The text is UTF-16.")
    content = content.removeprefix(b"\xef\xbb\xbf")
    written = content.rstrip(b"\0")
    if len(written) < len(content):
        words = f"The file ends with {len(content) - len(written)} bytes without text: left out."
        text.words.append(words)
    content = written.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if control := re.search(rb"[\x00-\x08\x0e-\x1a\x1c-\x1f]", content):
        line = content.count(b"\n", 0, control.start()) + 1
        raise text.error(f"must be text, but has the byte {control[0][0]}", line)
    try:
        content.decode()
    except UnicodeDecodeError:
        content = content.decode("latin-1").encode()
        text.words.append("The text is not UTF-8: read as Latin-1.")
    return text._replace(content=content)


def _sections(text: Text) -> list[Text]:
    """The sections of a file of Vicon, each with a title and a rate; or the whole file."""
    marks = list(SECTION.finditer(text.content))
    if not marks:
        return [text]
    ends = [mark.start() for mark in marks[1:]] + [len(text.content)]
    return [
        text._replace(
            title=mark[1].decode(),
            content=text.content[mark.end() : end],
            line=text.content.count(b"\n", 0, mark.end()) + 1,
            rate=float(mark[2].replace(b",", b".")),
            words=list(text.words),
        )
        for mark, end in zip(marks, ends, strict=True)
    ]


# How a file is written.


def _split(line: str, delimiter: str) -> list[str]:
    """The cells of a line."""
    if '"' in line:
        try:
            rows = csv.reader([line.strip(" ")], delimiter=delimiter, skipinitialspace=True)
            return [cell.strip() for cell in next(rows, [])]
        except csv.Error:  # a cell is longer than the package allows
            return [line]
    cells = line.split() if delimiter == " " else line.split(delimiter)
    return [cell.strip() for cell in cells]


def _kind(cell: str, decimal: str) -> str:
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
        return any(_kind(cell, self.decimal) in TIMES for cell in cells)

    def agreement(self, cells: Sequence[str]) -> float:
        """The part of cells that are of the kind of their column, or missing."""
        if len(cells) != len(self.kinds) or not self.has_number(cells):
            return 0.0
        pairs = zip(cells, self.kinds, strict=True)
        known = [(cell, kind) for cell, kind in pairs if kind in TIMES]
        same = [_kind(cell, self.decimal) in (kind, "missing") for cell, kind in known]
        return float(np.mean(same))

    def is_sample(self, cells: Sequence[str]) -> bool:
        """Whether most cells are of the kind of their column, or missing."""
        return self.agreement(cells) > 0.5


def _recognise_dialect(text: Text, options: Options) -> Dialect:
    """The delimiter and decimal mark with which most cells are numbers or times."""
    lines = _probable_samples(text)
    best, most = None, 0.0
    for delimiter in DELIMITERS if options.delimiter is None else (options.delimiter,):
        rows = [_split(line, delimiter) for line in lines]
        widths = Counter(map(len, rows))
        width = max(widths, key=lambda width: (widths[width], width), default=0)
        rows = [row for row in rows if len(row) == width]
        for decimal in DECIMALS if options.decimal is None else (options.decimal,):
            kinds = [[_kind(cell, decimal) for cell in row] for row in rows]
            count = Counter(kind for row in kinds for kind in row)
            score = sum(count[kind] for kind in TIMES) - count["words"]
            score *= len(rows) / max(len(lines), 1)
            if decimal != delimiter and score > most:
                of_columns = [_commonest(column) for column in zip(*kinds, strict=True)]
                best, most = Dialect(delimiter, decimal, tuple(of_columns)), score
    if best is None:
        words = "must be a table of numbers with ',', ';', tabs, '|' or spaces between, but is not"
        raise NoTableError(text.path, words)
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
            cells = _split(written.decode().rstrip("\n"), self.dialect.delimiter)
            if len(cells) == width + 1 and not cells[-1]:
                cells.pop()
            if len(cells) > width:
                words = f"must have {width} cells as lines before it, but has {len(cells)}"
                raise self.text.error(words, line)
            if len(cells) < width:
                words = "is missing: the line ends before it"
                raise self.text.error(words, line, headers[len(cells)])
            yield line, cells


def _in_front(text: Text, dialect: Dialect) -> tuple[list[Row], Body]:
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
        cells = _split(
            written.removeprefix(mark).strip(" ") if mark else written, dialect.delimiter
        )
        while len(cells) > width and not cells[-1]:
            cells.pop()
        if any(cells):
            is_sample = not mark and dialect.is_sample(cells)
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
    if not re.search(rb"(?m)^ *(?:#|%|//)", content):
        return content
    content, count = re.subn(rb"(?m)^ *(?:#|%|//).*$", b"", content)
    text.words.append(f"Comments between samples were left out: {count} lines.")
    return content


def _without_cut_end(body: Body) -> Body:
    """The samples without a last line that is cut off."""
    content, dialect = body.content, body.dialect
    if content.endswith(b"\n") or b"\n" not in content:
        return body
    whole = content[: content.rfind(b"\n") + 1]
    line = body.line + whole.count(b"\n")
    cells = _split(content[len(whole) :].decode(), dialect.delimiter)
    kinds = [_kind(cell, dialect.decimal) for cell in cells]
    wrong = [kind == "words" != usual for kind, usual in zip(kinds, dialect.kinds, strict=False)]
    if len(cells) >= len(dialect.kinds) and not any(wrong):
        body.text.words.append("The last line has no line break: its last cell may be cut off.")
        return body
    body.text.words.append(f"The file ends in the middle of line {line}: the line was left out.")
    return body._replace(content=whole)


# The header.


class Header(NamedTuple):
    """The names of the columns."""

    headers: list[str]  # as in the file
    names: list[str]  # without units
    units: list[str]
    line: int | None
    facts: dict[str, str]


def _header(body: Body, before: Sequence[Row]) -> Header:
    """The header, which is in the last lines in front of the samples."""
    dialect, text = body.dialect, body.text
    rows = [row for row in before if any(re.search(r"[^\W_]|°|%", cell) for cell in row.cells)]
    rows = [row for row in rows if any(cell.lower() not in MISSING for cell in row.cells)]
    candidates = [i for i, row in enumerate(rows) if _can_be_header(row.cells, dialect)]
    if not candidates:
        return _without_header(body, rows)
    place, units_row = candidates[-1], None
    if len(candidates) > 1 and _are_units(rows[place].cells):
        place, units_row = candidates[-2], rows[place]
    header = rows[place]
    cells = _padded(header.cells, len(dialect.kinds))
    headers = [cell or str(i) for i, cell in enumerate(cells)]
    for row in (row for row in rows if not (row.comment or row is units_row)):
        if row.line > header.line:
            _require_sample(body, row, headers)
        elif dialect.agreement(row.cells) == 1:
            raise text.error("must not be in front of the header: divide the file", row.line)
    parts = [_name_and_unit(cell) for cell in cells]
    names, units = [name for name, _ in parts], [unit for _, unit in parts]
    where = f"line {header.line}"
    if units_row is not None:
        pairs = zip(_padded(units_row.cells, len(units)), units, strict=True)
        units = [_unit(cell) or unit for cell, unit in pairs]
        where += f", their units in line {units_row.line}"
    above = _rows_above(rows, place, len(cells))
    facts = _facts(rows[: place - len(above)])
    if MOTIVE in facts and len(above) > 2:
        names = _motive_names(names, above)
    else:
        names = _names_in_groups(names, above, text.rate > 0)
    text.words.append(f"The names of columns are in {where}.")
    names = [name or str(i) for i, name in enumerate(names)]
    return Header(headers, _distinct(names), units, header.line, facts)


def _padded(cells: Sequence[str], width: int) -> list[str]:
    return [*cells, *[""] * (width - len(cells))][:width]


def _can_be_header(cells: Sequence[str], dialect: Dialect) -> bool:
    """Whether cells are words for all columns, of which one without a number may have no name."""
    lacking = len(dialect.kinds) - len(cells)
    unnamed = lacking == 1 and dialect.kinds[-1] == "missing"
    short = lacking > 0 and dialect.delimiter != " " and _are_units(cells)
    return (lacking == 0 or unnamed or short) and not dialect.has_number(cells)


def _without_header(body: Body, rows: Sequence[Row]) -> Header:
    text, width = body.text, len(body.dialect.kinds)
    names = [str(i) for i in range(width)]
    last = rows[-1] if rows and not rows[-1].comment else None
    if last is not None and body.dialect.agreement(last.cells) > 0:
        _require_sample(body, last, names)
    if last is not None and body.dialect.delimiter != " " and 1 < len(last.cells) != width:
        words = f"must have {width} names of columns, but has {len(last.cells)}"
        raise text.error(words, last.line)
    text.words.append("There is no header: columns have numbers, counted from 0, as names.")
    return Header(names, names, [""] * width, None, _facts(rows))


def _require_sample(body: Body, row: Row, headers: Sequence[str]) -> None:
    """Check that a line between the header and the samples has no words for numbers."""
    if len(row.cells) != len(headers):
        words = f"must have {len(headers)} cells as the header, but has {len(row.cells)}"
        raise body.text.error(words, row.line)
    for header, cell, kind in zip(headers, row.cells, body.dialect.kinds, strict=True):
        if kind in TIMES and _kind(cell, body.dialect.decimal) not in (kind, "missing"):
            raise body.text.error(f"must be a {kind}, but is {_short(cell)}", row.line, header)


def _short(cell: str) -> str:
    return repr(cell if len(cell) <= SHOWN else f"{cell[:SHOWN]}...")


def _facts(rows: Sequence[Row]) -> dict[str, str]:
    """Names with values in the lines in front of the samples."""
    facts: dict[str, str] = {}
    for row in rows:
        cells = [cell for cell in row.cells if cell]
        if row.cells[0] == MOTIVE:
            facts.update(zip(row.cells[::2], row.cells[1::2], strict=False))
        elif len(cells) == 2:
            facts[cells[0].rstrip(":= ")] = cells[1]
        elif pair := re.fullmatch(r"\W*(\w[^:=]{0,60}?)\s*[:=]\s*(\S.*)", " ".join(cells)):
            facts[pair[1]] = pair[2]
    return {name: value for name, value in facts.items() if value}


def _name_and_unit(header: str) -> tuple[str, str]:
    """A name without its unit, as in `gyro_x [deg/s]`, `X (rad/s)`, `acc_x_g` and `TimeUS`."""
    header = header.lstrip("#% ").strip()
    for pattern in (
        r"(.*\S)\s*[\[(]([^\[\]()]*)[\])]",
        r"(.*\S)\s*,\s+(\S+)",
        r"(.*\S)\s+/\s+(\S.*)",
        r"(.*\S)[ _](\S+/\S+)",
    ):
        parts = re.fullmatch(pattern, header)
        if parts and (unit := _unit(parts[2] or "-")):
            return parts[1].strip(), unit
    words = header.split("_")
    for count in (3, 2, 1):
        if len(words) > count and (unit := ENDINGS.get("_".join(words[-count:]))):
            return "_".join(words[:-count]), unit
    if parts := re.fullmatch(r"(.*[a-z])(US|MS|NS)", header):
        return parts[1], parts[2].lower()
    return header, ""


def _unit(written: str) -> str:
    """The unit that is written; empty if it is none that is known."""
    written = re.sub(r"^[\[(]|[\])]$", "", written.strip()).strip()
    if written in ("-", "unitless"):
        return "1"
    plain = written.replace("⁻¹", "^-1").replace("⁻²", "^-2").replace("·", " ")
    plain = re.sub(r"(?<=\S) s\^-1$", "/s", re.sub(r"(?<=\S) s\^-2$", "/s²", plain))
    if plain in UNITS:
        return plain
    if plain in SPELLINGS:
        return standard_spelling(plain)
    return TIME_UNITS.get(plain, "")


def _are_units(cells: Sequence[str]) -> bool:
    """Whether most cells that are not empty are units."""
    written = [cell for cell in cells if cell]
    return sum(bool(_unit(cell)) for cell in written) > len(written) / 2


def _rows_above(rows: Sequence[Row], place: int, width: int) -> list[list[str]]:
    """The cells of the lines right above the names, the nearest first."""
    above = []
    for row in reversed(rows[:place]):
        adjoining = row.line == rows[place].line - len(above) - 1
        if not adjoining or row.comment or len(row.cells) < 2 or row.cells[0] == MOTIVE:
            break
        above.append(_padded(row.cells, width))
    return above


def _names_in_groups(names: list[str], above: Sequence[list[str]], always: bool) -> list[str]:
    """Names that repeat, behind the groups above them, which go on up to the next group."""
    for number, row in enumerate(above):
        if len(set(names)) == len(names) and not (always and number == 0):
            break
        joined, group = [], ""
        for cell, name in zip(row, names, strict=True):
            group = cell or group
            joined.append(f"{group}.{name}" if group else name)
        names = joined
    return names


def _distinct(names: Sequence[str]) -> list[str]:
    seen: Counter[str] = Counter()
    distinct = []
    for name in names:
        seen[name] += 1
        distinct.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return distinct


# Tables.


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
        words = f"must be a {kind}, but is {_short(cells[place])}"
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
        if _are_words([_kind(cell, ".") for cell in _as_list(column.cells[:1000])]):
            return None
        cells = _as_list(column.cells)
        kinds = [_kind(cell, ".") for cell in cells]
        if _are_words(kinds):
            return None
        if words := [i for i, kind in enumerate(kinds) if kind not in ("number", "missing")]:
            raise self.not_a("number", place, words[0])
        pairs = zip(cells, kinds, strict=True)
        return np.array([float(cell) if kind == "number" else np.nan for cell, kind in pairs])


def _are_words(kinds: Sequence[str]) -> bool:
    return len(kinds) - kinds.count("missing") > 2 * kinds.count("number")


def _cells(body: Body, headers: Sequence[str]) -> list[Any]:
    """The cells of each column, as text with decimal points."""
    at_once = _cells_at_once(body)
    if at_once is not None:
        return at_once
    columns = [list(column) for column in zip(*_rows(body, headers), strict=True)]
    if body.dialect.decimal == ",":
        return [[cell.translate(COMMA_FOR_POINT) for cell in column] for column in columns]
    return columns


def _rows(body: Body, headers: Sequence[str]) -> list[list[str]]:
    return [cells for _, cells in body.rows(headers)]


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
            csv.ReadOptions(column_names=names),
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
    """Text without spaces around cells."""
    if delimiter == b" ":
        content = content.replace(b"\t", b" ")
    for spaced in (delimiter + b" ", b" " + delimiter, b" \n", b"\n "):
        while spaced in content:
            content = content.replace(spaced, spaced.strip(b" ") or b" ")
    return content.lstrip(b" ")


def _numbers_at_once(cells: Any) -> Float[np.ndarray, " samples"] | None:
    """The numbers in an array of pyarrow; None if a cell is none, or is written unusually."""
    if isinstance(cells, list):
        return None
    from pyarrow import ArrowInvalid, float64

    try:
        return cells.cast(float64()).to_numpy()
    except ArrowInvalid:
        return None


def _as_list(cells: Any) -> list[str]:
    if isinstance(cells, list):
        return cells
    return [cell or "" for cell in cells.to_pylist()]


def _table(text: Text, name: str, options: Options) -> Table:
    """The table of a file or of a section."""
    dialect = _recognise_dialect(text, options)
    before, body = _in_front(text, dialect)
    header = _header(body, before)
    cells = _cells(body, header.headers)
    described = (header.names, header.units, header.headers, dialect.kinds, cells)
    columns = [Column(*column) for column in zip(*described, strict=True)]
    declared = RATE.search("\n".join(" ".join(row.cells) for row in before))
    rate = text.rate
    if declared and not rate > 0:
        rate = float(declared[1]) * (1000 if (declared[2] or "").lower() == "khz" else 1)
    table = Table(body, columns, header.line, header.facts, rate, name)
    return _with_case(_with_tum_names(table))


def _tables(
    path: Path, files: Mapping[str, bytes], is_file: bool, options: Options
) -> tuple[list[Table], list[str]]:
    """The tables of all files, and the names of files that have none."""
    tables, without = [], []
    error = LogError(path, "must have a table of numbers")
    names = _names_of_files(list(files))
    for file, content in files.items():
        place = path if is_file else path / file
        title = _title(place)
        for text in _sections(_decoded(place, title, content)):
            try:
                tables.append(_table(text, "" if is_file else names[file], options))
            except NoTableError as problem:
                error = problem
                label = file if text.title == title else f"section {text.title}"
                without.append(f"{label} is no table of numbers: left out.")
    if not tables:
        raise error
    return _with_px4_topics(tables), without


def _title(path: Path) -> str:
    """The name of a file, or of its folder if all files are called `data`."""
    return path.parent.name if path.stem == "data" and path.parent.name else path.stem


def _names_of_files(files: list[str]) -> dict[str, str]:
    """Short names that differ."""
    short = [_title(Path(file)) for file in files]
    if len(set(short)) < len(short):
        short = [file.rpartition(".")[0] for file in files]
    return dict(zip(files, _distinct(short), strict=True))


def _said(tables: Sequence[Table]) -> list[str]:
    """What was recognised; once, if it is so in all files."""
    files: dict[str, list[str]] = {}
    for table in tables:
        label = table.name or (table.body.text.title if table.body.text.rate > 0 else "")
        for words in dict.fromkeys(table.words):
            files.setdefault(words, []).append(label)
    return [
        words if len(labels) == len(tables) else f"{', '.join(labels)}: {words}"
        for words, labels in files.items()
    ]


# Times.


class Times(NamedTuple):
    """Times as whole ticks and parts of a tick, which float64 holds for long clocks too."""

    whole: Int[np.ndarray, " samples"]
    part: Float[np.ndarray, " samples"]
    ticks: float  # in a second
    present: Any  # (samples,), whether there is a time
    zone: str = ""  # of times since 1970: "UTC", or "local" if it is not known

    def first_second(self) -> int:
        """The second from which long times are counted; 0 for others."""
        whole = self.whole[self.present]
        second = int(whole[0] // self.ticks) if len(whole) else 0
        return second if abs(second) > LONG else 0

    def since(self, second: int) -> Float[np.ndarray, " samples"]:
        """Times, s, since a whole second."""
        return ((self.whole - int(second * self.ticks)) + self.part) / self.ticks


class Group(NamedTuple):
    """Columns that have one time."""

    times: Times
    places: list[int]  # of the columns


def _groups(table: Table, options: Options) -> list[Group]:
    """The times of a table, and the columns that they are of."""
    chosen = _given_times(table, options) or _recognised_times(table)
    if not chosen:
        return [_group_by_rate(table)]
    ends = [places[0] for places in chosen[1:]] + [len(table.columns)]
    begins = [0, *ends]
    groups = []
    for places, begin, end in zip(chosen, begins, ends, strict=False):
        columns = [i for i in range(begin, end) if not any(i in times for times in chosen)]
        groups.append(Group(_times(table, places, options), columns))
    if len(chosen) > 1:
        labels = ", ".join(f"`{table.columns[i].header}`" for places in chosen for i in places)
        table.words.append(f"Times of the sensors are the columns {labels}, taken as one clock.")
    return groups


def _given_times(table: Table, options: Options) -> list[tuple[int, ...]]:
    """The columns that the user gives, if the table has all of them."""
    places = [place for name in options.time if (place := table.find(name)) is not None]
    if len(places) < len(options.time):
        return []
    if [table.columns[i].kind for i in places] == ["date", "time of day"]:
        return [tuple(places)]
    return [(i,) for i in sorted(places)]


def _listed(names: Sequence[str]) -> str:
    more = ", ..." if len(names) > SHOWN else ""
    return ", ".join(f"`{name}`" for name in names[:SHOWN]) + more


def _recognised_times(table: Table) -> list[tuple[int, ...]]:
    """The columns of time: by documentation, unit, dates or names, in this order."""
    columns = list(enumerate(table.columns))
    numbers = [(i, column) for i, column in columns if column.kind in ("number", "missing")]
    documented = table.case.times if table.case else {}
    for i in (table.names.index(name) for name in documented if name in table.names):
        if np.any(table.numbers(i)):
            return [(i,)]
    plain = [(i, column) for i, column in numbers if _is_time(column.name)]
    if with_unit := [i for i, column in plain if _time_unit(column)]:
        return [(with_unit[0],)]
    dates = [i for i, column in columns if column.kind == "date"]
    of_day = [i for i, column in columns if column.kind == "time of day"]
    if dates and (complete := [i for i in dates if _has_time_of_day(table.columns[i])]):
        return [(complete[0],)]
    if dates and of_day:
        return [(dates[0], of_day[0])]
    if of_day:
        return [(of_day[0],)]
    if plain:
        return [(plain[0][0],)]
    sensors = [i for i, column in numbers if _is_time_of_sensor(column.name)]
    return [(i,) for i in sensors if _goes_on(table, i)]


def _words(name: str) -> list[str]:
    return re.findall(r"[a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower())


def _is_time(name: str) -> bool:
    words = _words(name)
    return bool(TIME_NAMES & set(words)) and set(words) <= TIME_NAMES | TIME_COMPANIONS


def _is_time_of_sensor(name: str) -> bool:
    words = _words(name)
    return len(words) > 1 and bool({"t", "ts", "time", "timestamp"} & {words[0], words[-1]})


def _goes_on(table: Table, place: int) -> bool:
    """Whether most numbers are larger than the one before."""
    numbers = table.numbers(place)
    steps = np.diff(numbers[np.isfinite(numbers)]) if numbers is not None else np.zeros(0)
    return len(steps) > 0 and bool(np.mean(steps > 0) > 0.5 and np.mean(steps >= 0) > 0.9)


def _has_time_of_day(column: Column) -> bool:
    date = next(filter(None, map(DATE.fullmatch, _as_list(column.cells[:SAMPLED]))), None)
    return date is not None and date[2] is not None


def _time_unit(column: Column) -> str:
    """The unit of a column of time that its header tells."""
    if column.unit in TICKS:
        return column.unit
    return next((TIME_UNITS[word] for word in _words(column.name) if word in TIME_UNITS), "")


def _group_by_rate(table: Table) -> Group:
    """Times by the rate that the file declares, and by the numbers of frames, if there are some."""
    if not table.rate > 0:
        words = f"must have a column of time: write `time=` one of {_listed(table.names)}"
        raise table.body.text.error(words, table.line)
    frames, within = (
        table.numbers(table.names.index(name)) if name in table.names else None
        for name in ("Frame", "Sub Frame")
    )
    count = len(_as_list(table.columns[0].cells))
    if frames is None:
        table.words.append(f"Times are counted by the rate of {table.rate:g} Hz.")
        frames = np.arange(count, dtype=float)
    else:
        table.words.append(f"Times are numbers of frames by the rate of {table.rate:g} Hz.")
        if within is not None and np.nanmax(within, initial=0) > 0:
            frames = frames * (np.nanmax(within) + 1) + within
    present = np.isfinite(frames) & (abs(frames) < 2**53)
    whole = np.where(present, frames, 0).astype(np.int64)
    places = [i for i, name in enumerate(table.names) if name not in ("Frame", "Sub Frame")]
    return Group(Times(whole, np.zeros(count), table.rate, present), places)


def _times(table: Table, places: Sequence[int], options: Options) -> Times:
    """The times in a column, or in one of dates and one of times of day."""
    label = " and ".join(f"`{table.columns[i].header}`" for i in places)
    if table.columns[places[0]].kind in ("date", "time of day"):
        times = _times_of_dates(table, places)
        table.words.append(f"Times are those of {label}.")
    else:
        times = _times_of_numbers(table, places[0], options)
    if absent := int(np.sum(~times.present)):
        if absent > len(times.whole) / 2:
            row = int(np.argmin(times.present))
            raise table.not_a("time", places[0], row)
        table.words.append(f"Lines without a time in {label} were left out: {absent}.")
    return times


def _times_of_numbers(table: Table, place: int, options: Options) -> Times:
    column = table.columns[place]
    numbers = table.numbers(place)
    if numbers is None:
        raise table.error("must have numbers or times of ISO 8601", place)
    whole, part, present = _whole_and_part(table, place, numbers)
    unit = _unit_of_times(table, place, options, numbers[present])
    is_dated = (table.case and table.case.since_1970) or SINCE_1970 & set(_words(column.name))
    times = Times(whole, part, TICKS[unit], present, "UTC" if is_dated else "")
    return _unwrapped(table, column, times)


def _whole_and_part(
    table: Table, place: int, numbers: Float[np.ndarray, " samples"]
) -> tuple[Int[np.ndarray, " samples"], Float[np.ndarray, " samples"], Any]:
    """Whole numbers and the rest, exact for all digits in the text."""
    present = np.isfinite(numbers)
    if np.any(wrong := ~present & ~np.isnan(numbers) | (abs(numbers) >= 2.0**62)):
        raise table.not_a("time", place, int(np.argmax(wrong)))
    whole = np.floor(np.where(present, numbers, 0)).astype(np.int64)
    part = np.where(present, numbers - whole, 0.0)
    if not np.any(whole > (LONG if part.any() else 2**53)):
        return whole, part, present
    pairs = [cell.partition(".") for cell in _as_list(table.columns[place].cells)]
    for i in np.flatnonzero(present & (whole > 0)):
        digits, _, fraction = pairs[i]
        if digits.isdecimal() and len(digits) < 20 and (not fraction or fraction.isdecimal()):
            whole[i], part[i] = int(digits), float(f"0.{fraction}") if fraction else 0.0
    return whole, part, present


def _unit_of_times(
    table: Table, place: int, options: Options, numbers: Float[np.ndarray, " samples"]
) -> str:
    """The unit of a column of time."""
    column = table.columns[place]
    documented = table.case.times.get(column.name, "") if table.case else ""
    declared = _time_unit(column) or documented
    if options.time_unit is not None:
        other = declared not in ("", options.time_unit)
        said = f", as given (the file says {declared})" if other else ", as given"
        table.words.append(f"Times are `{column.header}`, in {options.time_unit}{said}.")
        return options.time_unit
    if declared:
        table.words.append(f"Times are `{column.header}`, in {declared}.")
        return declared
    steps = np.diff(numbers)
    steps = steps[steps > 0]
    low, high = PLAIN_STEPS
    usual = len(steps) > 0 and np.any(numbers % 1) and low <= np.median(steps) <= high
    if usual and column.name.lower() in PLAIN_TIMES and not column.unit:
        table.words.append(f"Times are `{column.header}`, assumed to be in s, by their steps.")
        return "s"
    first = ", ".join(f"{number:.10g}" for number in numbers[:3])
    allowed = ", ".join(map(repr, TICKS))
    words = f"must have a unit, but the file does not tell: write `time_unit=` one of {allowed}"
    raise table.error(f"{words}; the first are {first}", place)


def _unwrapped(table: Table, column: Column, times: Times) -> Times:
    """Times of a counter that begins again after its largest value, as if it went on."""
    numbers = (times.whole + times.part)[times.present]
    steps = np.diff(numbers)
    forward, back = steps[steps > 0], steps < 0
    if not back.any() or not len(forward):
        return times
    span, usual = np.ptp(numbers), USUAL_STEPS * np.median(forward)
    in_microseconds = 2**32 / 10**6 * times.ticks  # of a counter of microseconds
    for length in (*COUNTERS, in_microseconds):
        again = steps[back] + length
        if span < length and np.all((again >= 0) & (again <= min(usual, length / 8))):
            laps = np.zeros(len(times.whole), np.int64)
            laps[np.flatnonzero(times.present)[1:]] = np.cumsum(back)
            table.words.append(
                f"`{column.header}` is a counter that begins again after {length:.10g}: its times "
                "go on."
            )
            added = laps * length
            floor = np.floor(added)
            return times._replace(
                whole=times.whole + floor.astype(np.int64), part=times.part + (added - floor)
            )
    return times


def _times_of_dates(table: Table, places: Sequence[int]) -> Times:
    """Times, ns, of dates, or of times of day, which go on at midnight."""
    whole, present, zoned = np.array(0), np.array(True), False
    for place in places:
        kind = table.columns[place].kind
        read = _read_date if kind == "date" else _read_time_of_day
        nanoseconds = np.zeros(len(cells := _as_list(table.columns[place].cells)), np.int64)
        there = np.ones(len(cells), bool)
        for i, cell in enumerate(cells):
            if cell.lower() in MISSING:
                there[i] = False
                continue
            try:
                nanoseconds[i], has_zone = read(cell)
            except ValueError:
                raise table.not_a(kind, place, i) from None
            zoned |= has_zone
        whole, present = whole + nanoseconds, present & there
    if table.columns[places[0]].kind == "time of day":
        steps = np.diff(whole[present])
        days = np.zeros(len(whole), np.int64)
        days[np.flatnonzero(present)[1:]] = np.cumsum(steps < -DAY // 2)
        if days.any():
            table.words.append("Times of day go on after midnight.")
        whole = whole + days * DAY
    has_date = table.columns[places[0]].kind == "date"
    zone = "UTC" if zoned else "local" if has_date else ""
    return Times(whole, np.zeros(len(whole)), 10**9, present, zone)


def _read_date(cell: str) -> tuple[int, bool]:
    """Nanoseconds since 1970, and whether the date has a time zone."""
    if not (date := DATE.fullmatch(cell)):
        raise ValueError
    day, of_day, zone = date.groups()
    seconds, _, fraction = (of_day or "00:00").replace(",", ".").partition(".")
    moment = datetime.fromisoformat(f"{day.replace('/', '-')}T{seconds}+00:00")
    whole = int(moment.timestamp()) * 10**9 + int(f"{fraction:0<9}")
    if zone and (offset := re.search(r"([+-])(\d\d):?(\d\d)", zone)):
        ahead = (int(offset[2]) * 60 + int(offset[3])) * 60 * 10**9
        whole -= ahead if offset[1] == "+" else -ahead
    return whole, zone is not None


def _read_time_of_day(cell: str) -> tuple[int, bool]:
    """Nanoseconds since midnight."""
    if not (time := TIME_OF_DAY.fullmatch(cell)):
        raise ValueError
    hours, minutes, seconds, fraction = time.groups()
    whole = (int(hours) * 60 + int(minutes)) * 60 + int(seconds)
    return whole * 10**9 + int(f"{fraction or '':0<9}"), False


# Signals.


class Vector(NamedTuple):
    """Columns that are one signal, or a column by itself, without components."""

    name: str
    components: tuple[str, ...]
    places: list[int]
    described: dict[str, str]  # attributes of the signal


def _signals(
    path: Path, tables: Sequence[Table], is_file: bool, options: Options
) -> tuple[dict[str, Signal], datetime | None, list[str]]:
    """The signals of all tables, the start of the log, and how times are counted."""
    for name in options.time:
        if all(table.find(name) is None for table in tables):
            first = tables[0]
            words = f"must have a column `{name}`, as `time` says, but has {_listed(first.names)}"
            raise first.body.text.error(words, first.line)
    groups = [(table, group) for table in tables for group in _groups(table, options)]
    clocks = [
        "log" if is_file or (table.case and table.case.one_clock) else table.name
        for table, _ in groups
    ]
    zeros: dict[str, int] = {}  # by clock, s
    for clock, (_, group) in zip(clocks, groups, strict=True):
        first = group.times.first_second()
        zeros[clock] = min(zeros.get(clock, first), first)
    signals: dict[str, Signal] = {}
    used: set[str] = set()  # units that were given
    for clock, (table, group) in zip(clocks, groups, strict=True):
        present = group.times.present
        times = group.times.since(zeros[clock])[present]
        numbers = {i: column for i in group.places if (column := table.numbers(i)) is not None}
        if words := [table.columns[i].header for i in group.places if i not in numbers]:
            table.words.append(f"Columns of words were left out: {_listed(words)}.")
        for vector in _vectors(table, numbers):
            values = np.stack([numbers[i][present] for i in vector.places], axis=1)
            values = values if vector.components else values[:, 0]
            name = vector.name
            if name in signals:
                name = _distinct([*signals, f"{table.body.text.title}.{name}"])[-1]
            unit = _unit_of_signal(table, vector, name, options.units, used)
            described: dict[str, Any] = vector.described | {"unit": unit, "clock": clock}
            signals[name] = Signal(name, times, values, components=vector.components, **described)
    for name in options.units:
        if name not in used:
            words = f"must have a column or signal `{name}`, as `units` says, but has"
            raise LogError(path, f"{words} {_listed(list(signals))}")
    if not signals:
        raise LogError(path, "must have a column of numbers besides the time")
    start, words = None, []
    for clock, zero in zeros.items():
        zones = {
            group.times.zone for of, (_, group) in zip(clocks, groups, strict=True) if of == clock
        }
        counted = f"{zero} s of the clock of the file"
        if zones != {""} and 0 < zero < LATEST:
            date = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=zero)
            counted = f"{date:%Y-%m-%d %H:%M:%S}, {'UTC' if 'UTC' in zones else 'of no known zone'}"
            start = date if zones == {"UTC"} and len(zeros) == 1 else None
        if zero:
            words.append(f"Times of the clock `{clock}` are counted from {counted}.")
    return signals, start, words


def _vectors(table: Table, places: Iterable[int]) -> Iterator[Vector]:
    """The columns of numbers, of which some are vectors by the documentation of a product."""
    left = [i for i in places if table.columns[i].kind != "missing" or table.names[i] != str(i)]
    prefix = f"{table.name}." if table.name else ""
    for pattern in table.case.patterns if table.case else ():
        found: dict[str, dict[str, int]] = {}
        for i in left:
            if match := re.fullmatch(pattern, f"{table.body.text.title}/{table.names[i]}"):
                found.setdefault(match["name"], {})[match["component"].lower()] = i
        for name, components in found.items():
            ordered = _ordered(components)
            units = {table.columns[i].unit for i in components.values()}
            if ordered and len(units) == 1 and table.case:
                described = {**table.case.describe(table, name, ordered)}
                name = described.pop("name", prefix + name)
                labels = tuple(described.pop("components", ordered))
                vector = [components[component] for component in ordered]
                if set(labels) == set(ordered):  # another order
                    vector = [components[component] for component in labels]
                left = [i for i in left if i not in vector]
                yield Vector(name, labels, vector, described)
    for i in left:
        yield Vector(prefix + table.names[i], (), [i], {})


def _ordered(components: Iterable[str]) -> tuple[str, ...]:
    """Components of a vector in order, of a quaternion as in the file; none if some are missing."""
    names = list(components)
    if len(names) == 4 and set(names) == set("wxyz"):
        return tuple(names)
    if set(names) == set("xyz"):
        return tuple("xyz")
    numbers = sorted(names, key=lambda name: (len(name), name))
    return tuple(numbers) if numbers == [str(i) for i in range(len(names))] else ()


def _unit_of_signal(
    table: Table, vector: Vector, name: str, units: Mapping[str, str], used: set[str]
) -> str:
    """The unit that is given, or is in the header, or is documented."""
    first = table.columns[vector.places[0]]
    labels = [name]
    for i in vector.places:
        labels += [table.columns[i].name, table.columns[i].header, f"{table.name}.{table.names[i]}"]
    known = [label for label in labels if label in units]
    used.update(known)
    if known:
        unit = standard_spelling(units[known[0]])
        said = f" (the file says {first.unit})" if first.unit not in ("", unit) else ""
        table.words.append(f"`{name}` is in {unit}, as given{said}.")
        return unit
    return first.unit or vector.described.get("unit", "")


# What the documentation of products says.


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


def _with_case(table: Table) -> Table:
    for case in CASES:
        if case.recognises(table):
            table.words.append(f"Recognised as {case.kind}.{case.remark}")
            return table._replace(case=case)
    return table


ATTITUDE = {"quantity": "attitude", "unit": "1", "direction": "body to space"}
POSITION = {"quantity": "position"}
GYROSCOPE = {"quantity": "angular_velocity"}
ACCELEROMETER = {"quantity": "specific_force"}
MAGNETOMETER = {"quantity": "magnetic_field"}

PHONE = {"frame": "phone"}  # x to the right, y up, z out of the screen
PHYPHOX = {  # sensors in headers, or in names of files
    "gyroscope": {"name": "Gyroscope"} | GYROSCOPE | PHONE,
    "acceleration": {"name": "Accelerometer"} | ACCELEROMETER | PHONE,
    "accelerometer": {"name": "Accelerometer"} | ACCELEROMETER | PHONE,
    "linear acceleration": {"name": "Linear Acceleration"} | PHONE,
    "linear accelerometer": {"name": "Linear Acceleration"} | PHONE,
    "magnetic field": {"name": "Magnetometer"} | MAGNETOMETER | PHONE,
    "magnetometer": {"name": "Magnetometer"} | MAGNETOMETER | PHONE,
}
PHYPHOX_METADATA = "meta/device.csv", "meta/time.csv"
PHYPHOX_COLUMN = r"(?i)(?:.*/)?(?P<name>[^/]+)[/ ](?P<component>[xyz])"


def _is_phyphox(table: Table) -> bool:
    names = [f"{table.body.text.title}/{name}" for name in table.names]
    matches = [re.fullmatch(PHYPHOX_COLUMN, name) for name in names]
    known = [match for match in matches if match and match["name"].lower() in PHYPHOX]
    time = table.columns[0]
    return len(known) > 2 and (time.name, time.unit) == ("Time", "s")


def _add_phyphox_metadata(
    files: Mapping[str, bytes], facts: dict[str, str], words: list[str]
) -> datetime | None:
    """Facts of the device, and the start, from the files of phyphox beside the data."""
    start = None
    for name, content in files.items():
        header, *lines = content.decode("utf-8-sig", errors="replace").splitlines() or [""]
        first = re.match(r'"(property|event)"(.)', header)
        rows = [_split(line, first[2]) for line in lines if first]
        if first and first[1] == "property":
            facts.update({row[0]: row[1] for row in rows if len(row) == 2 and row[1]})
            continue
        try:
            events = [
                (row[0], *(float(cell.replace(",", ".")) for cell in row[1:3])) for row in rows
            ]
            _, experiment, system = next(event for event in events if event[0] == "START")
            start = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=system - experiment)
            if pauses := sum(event[0] == "START" for event in events) - 1:
                words.append(f"phyphox was paused: its times leave out {pauses} pauses.")
        except (ValueError, OverflowError, StopIteration):
            words.append(f"{name} does not tell the start.")
    return start


BLACKBOX = {
    "gyroADC": GYROSCOPE | {"unit": "raw", "components": "xyz"},
    "accSmooth": ACCELEROMETER | {"unit": "raw", "components": "xyz"},
    "magADC": {"unit": "raw", "components": "xyz"},
}
PX4_TOPICS = sorted({name.partition(".")[0] for name in PX4_DOCUMENTED}, key=len, reverse=True)
PX4_FILE = rf"(?P<prefix>|.*?_)(?P<topic>{'|'.join(PX4_TOPICS)})_(?P<instance>\d+)"


def _describe_px4(table: Table, name: str, components: tuple[str, ...]) -> dict[str, Any]:
    topic = table.name.partition("[")[0]
    name = name or "xyz"
    labels = "wxyz" if name == "q" else "xyz" if len(components) == 3 else components
    described = PX4_DOCUMENTED.get(f"{topic}.{name}", {})
    return described | {"name": f"{table.name}.{name}", "components": labels}


def _with_px4_topics(tables: list[Table]) -> list[Table]:
    """Tables of ulog2csv with the names of their topics; others of the same log are so too."""
    titles = [table.body.text.title for table in tables]
    known = [re.fullmatch(PX4_FILE, title) for title in titles]
    prefixes = {
        match["prefix"]
        for match, table in zip(known, tables, strict=True)
        if match and table.case is PX4
    }
    topics = {}
    for i, title in enumerate(titles):
        prefix = next((prefix for prefix in prefixes if title.startswith(prefix)), None)
        if prefix is not None and "timestamp" in tables[i].names:
            topics[i] = re.fullmatch(r"(.+)_(\d+)", title.removeprefix(prefix))
    numbers: dict[str, set[str]] = {}
    for match in topics.values():
        if match:
            numbers.setdefault(match[1], set()).add(match[2])
    for i, match in topics.items():
        if match:
            several = numbers[match[1]] != {"0"}
            name = f"{match[1]}[{match[2]}]" if several else match[1]
            columns = [column._replace(name=column.header) for column in tables[i].columns]
            tables[i] = tables[i]._replace(name=name, columns=columns, case=PX4)
    return tables


EUROC_SIGNALS = {
    "p": POSITION | {"unit": "m"},
    "q": ATTITUDE,
    "w": GYROSCOPE | {"unit": "rad/s"},
    "a": ACCELEROMETER | {"unit": "m/s²"},
}
TUM_NAMES = "timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw"


def _describe_euroc(table: Table, name: str, components: tuple[str, ...]) -> dict[str, str]:
    described: dict[str, str] = EUROC_SIGNALS.get(name.split("_")[0], {})
    order = {"order": "".join(components)} if name.startswith("q_") else {}
    has_imu = any(other.startswith(("w_RS_S", "b_w_RS_S")) for other in table.names)
    return described | order | ({"frame": "IMU"} if has_imu else {})


def _with_tum_names(table: Table) -> Table:
    """A trajectory without a header with the names of its columns."""
    if table.line is not None or table.body.dialect.delimiter != " " or len(table.columns) != 8:
        return table
    numbers = [table.numbers(i) for i in range(4, 8)]
    lengths = np.sqrt(sum(np.nan if column is None else column**2 for column in numbers))
    if not np.nanmax(abs(lengths - 1), initial=0) < 1e-2 or np.isnan(lengths).all():
        return table
    table.words.append(
        f"Eight columns, the last four of which are unit quaternions, are {' '.join(TUM_NAMES)}."
    )
    pairs = zip(table.columns, TUM_NAMES, strict=True)
    return table._replace(columns=[column._replace(name=name) for column, name in pairs])


def _describe_tum(table: Table, name: str, components: tuple[str, ...]) -> dict[str, str]:
    if name == "t":
        return POSITION | {"name": _prefixed(table, "position")}
    return ATTITUDE | {"name": _prefixed(table, "attitude"), "order": "".join(components)}


def _prefixed(table: Table, name: str) -> str:
    return f"{table.name}.{name}" if table.name else name


MOTIVE = "Format Version"  # the first cell
MOTIVE_UNITS = {"Meters": "m", "Centimeters": "cm", "Millimeters": "mm"}


def _motive_names(names: Sequence[str], above: Sequence[list[str]]) -> list[str]:
    """Names from the lines type, name, ..., rotation or position, and the component."""
    what, bodies = above[0], above[-2]
    parts = zip(bodies, what, names, strict=True)
    return [
        ".".join([body, kind.lower(), *([name.lower()] if name else [])]) if kind else name
        for body, kind, name in parts
    ]


def _describe_motive(table: Table, name: str, components: tuple[str, ...]) -> dict[str, Any]:
    if name.endswith(".position"):
        return POSITION | {"unit": MOTIVE_UNITS.get(table.facts.get("Length Units", ""), "")}
    if len(components) == 4:
        return ATTITUDE | {"order": "".join(components)}
    order = table.facts.get("Rotation Type", "").upper()
    if set(order) != set("XYZ") or len(order) != 3:
        return {"quantity": "attitude", "unit": "deg"}
    # The angles are about axes that turn with the body, in degrees.
    described = {"unit": "deg", "order": order, "components": tuple(order.lower())}
    return ATTITUDE | described


def _describe_vicon(table: Table, name: str, components: tuple[str, ...]) -> dict[str, str]:
    body, _, part = name.rpartition(".")
    angle = re.fullmatch(r"Global Angle \((\w+).*?\) (.+)", body)
    body = angle[2] if angle else body
    if part == "T":
        return POSITION | {"name": _prefixed(table, f"{body}.position")}
    if part == "R":
        described = {"name": _prefixed(table, f"{body}.rotation"), "quantity": "attitude"}
        if len(components) == 4:
            return described | ATTITUDE | {"order": "".join(components)}
        if angle and angle[1].lower() == "helical":
            return described | {"order": "rotation_vector", "direction": "body to space"}
        return described
    is_marker = table.body.text.title == "Trajectories"
    return {"name": _prefixed(table, name), **(POSITION if is_marker else {})}


PX4 = Case(
    "CSV of ulog2csv, of PX4",
    lambda table: (
        re.fullmatch(PX4_FILE, table.body.text.title) is not None and table.names[0] == "timestamp"
    ),
    (
        r".*/(?P<name>\w+)\[(?P<component>\d+)\]",
        r".*/esc\[(?P<component>\d+)\]\.(?P<name>esc_rpm)",
        r".*/(?P<name>)(?P<component>[xyz])",
    ),
    _describe_px4,
    {"timestamp_sample": "us", "timestamp": "us"},
    one_clock=True,
)
CASES = (
    Case(
        "CSV of OptiTrack Motive",
        lambda table: MOTIVE in table.facts,
        (r"[^/]*/(?P<name>.+\.(?:rotation|position))\.(?P<component>[wxyz])",),
        _describe_motive,
    ),
    Case(
        "CSV of Vicon",
        lambda table: table.body.text.rate > 0,
        (
            r"[^/]*/(?P<name>.+\.[RT])(?P<component>[WXYZ])",
            r"[^/]*/(?P<name>.+)\.(?P<component>[XYZ])",
        ),
        _describe_vicon,
    ),
    Case(
        "CSV of phyphox",
        _is_phyphox,
        (PHYPHOX_COLUMN,),
        lambda table, name, components: PHYPHOX.get(name.lower(), {}),
        one_clock=True,
        remark=" Axes of the phone are to the right, up along the screen, and out of it.",
    ),
    Case(
        "CSV of blackbox_decode",
        lambda table: {"loopIteration", "time"} <= set(table.names),
        (r"[^/]*/(?P<name>\w+)\[(?P<component>\d+)\]",),
        lambda table, name, components: BLACKBOX.get(name, {}),
        {"time": "us"},
        remark=(
            " What has no unit in the header is raw; `--unit-rotation deg/s --unit-acceleration g` "
            "gives units. `eRPM` is the electrical speed in 100 rpm."
        ),
    ),
    PX4,
    Case(
        "a file of EuRoC",
        lambda table: _is_time(table.names[0]) and any("_RS_" in name for name in table.names),
        (
            r"[^/]*/(?P<name>(?:b_)?[a-z]_RS_[A-Z])_(?P<component>[xyz])",
            r"[^/]*/(?P<name>q_RS)_(?P<component>[wxyz])",
        ),
        _describe_euroc,
        {"timestamp": "ns"},
        one_clock=True,
    ),
    Case(
        "a trajectory of TUM",
        lambda table: set(table.names) == set(TUM_NAMES),
        (r"[^/]*/(?P<name>t)(?P<component>[xyz])", r"[^/]*/(?P<name>q)(?P<component>[wxyz])"),
        _describe_tum,
        {"timestamp": "s"},
        since_1970=True,
    ),
)
