"""Delimited text: CSV files of any origin, and zip files and folders of them."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..log import Log
from ..signal import LogError
from .dialect import DECIMALS, DELIMITERS, find_samples, recognise_dialect
from .header import make_distinct, read_header
from .products import (
    PHYPHOX_METADATA,
    add_phyphox_metadata,
    name_px4_topics,
    name_tum_columns,
    recognise_product,
)
from .text_files import NoTableError, Options, Text, decode, divide, is_zip, read_files
from .text_signals import make_signals
from .text_table import Column, Table, read_cells
from .times import TICKS

KIND = "delimited text"
RATE = re.compile(
    r"\b(?:frame|sampl\w*|data|capture|export)[ _]?(?:rate|frequency)\b[^\w.]{1,12}"
    r"(\d+(?:\.\d+)?) ?(k?Hz|fps)?(?![\w.])",
    re.A | re.I,
)


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
        several sensors, each of which is that of the columns up to the next. Columns of time with
        one name, such as `t [s]` twice, are taken as those of several sensors.
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
    files = read_files(path)
    metadata = {name: files.pop(name) for name in list(files) if name.endswith(PHYPHOX_METADATA)}
    is_file = not path.is_dir() and not is_zip(path)
    tables, assumed = _tables(path, files, is_file, options)
    signals, start, zeros = make_signals(path, tables, is_file, options)
    assumed += _said(tables) + zeros
    facts: dict[str, str] = {}
    for table in reversed(tables):
        facts.update(table.facts)
    start = add_phyphox_metadata(metadata, facts, assumed) or start
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
    times = tuple(time) if isinstance(time, (list, tuple)) else () if time is None else (time,)
    if not all(isinstance(name, str) for name in times):
        raise ValueError(f"Argument `time` must be names of columns, but is {time!r}.")
    return Options(delimiter, decimal, times, time_unit, units)


def _table(text: Text, name: str, options: Options) -> Table:
    """The table of a file or of a section."""
    dialect = recognise_dialect(text, options)
    before, body = find_samples(text, dialect)
    header = read_header(body, before)
    cells = read_cells(body, header.headers)
    described = (header.names, header.units, header.headers, dialect.kinds, cells)
    columns = [Column(*column) for column in zip(*described, strict=True)]
    declared = RATE.search("\n".join(" ".join(row.cells) for row in before))
    rate = text.rate
    if declared and not rate > 0:
        rate = float(declared[1]) * (1000 if (declared[2] or "").lower() == "khz" else 1)
    table = Table(body, columns, header.line, header.facts, rate, name)
    return recognise_product(name_tum_columns(table))


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
        for text in divide(decode(place, title, content)):
            try:
                tables.append(_table(text, "" if is_file else names[file], options))
            except NoTableError as problem:
                error = problem
                label = file if text.title == title else f"section {text.title}"
                without.append(f"{label} is no table of numbers: left out.")
    if not tables:
        raise error
    return name_px4_topics(tables), without


def _title(path: Path) -> str:
    """The name of a file, or of its folder if all files are called `data`."""
    return path.parent.name if path.stem == "data" and path.parent.name else path.stem


def _names_of_files(files: list[str]) -> dict[str, str]:
    """Short names that differ."""
    short = [_title(Path(file)) for file in files]
    if len(set(short)) < len(short):
        short = [file.rpartition(".")[0] for file in files]
    return dict(zip(files, make_distinct(short), strict=True))


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
