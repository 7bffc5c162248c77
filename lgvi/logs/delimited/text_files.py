"""Files of text, in zip files and folders too, decoded."""

import io
import os
import re
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from ..signal import LogError, foreign_reader, list_names

SUFFIXES = ".csv", ".tsv", ".txt", ".tum", ".dat"
LARGEST = 1 << 30  # bytes of text
RATIO, SMALL = 100, 1 << 24  # a zip file with more text than SMALL may hold RATIO times its size
MOST_FILES = 1000
SHOWN = 40  # characters of a cell in an error
OTHER_KINDS = {  # by the first bytes
    **dict.fromkeys((b"\x89PNG", b"\xff\xd8\xff", b"GIF8"), "a picture"),
    b"%PDF-": "a PDF document",
    b"\xd0\xcf\x11\xe0": "a spreadsheet or document: save its sheets as CSV",
    **dict.fromkeys((b"\x1f\x8b", b"7z\xbc\xaf", b"Rar!"), "compressed: unpack it"),
}
SECTION = re.compile(
    rb"(?m)^\"?(Devices|Joints|Segments|Trajectories|Objects|Model Outputs|Events)\"?[,;\t ]*\n"
    rb"\"?([0-9]+(?:[.,][0-9]+)?)\"?[,;\t ]*$"
)


class Options(NamedTuple):
    """What a user says of files; None or empty for what is to be recognised."""

    delimiter: str | None
    decimal: str | None
    time: tuple[str, ...]
    time_unit: str | None
    units: Mapping[str, str]


def is_zip(path: Path) -> bool:
    """Whether a file is a zip file, by its first bytes."""
    with open(path, "rb") as file:
        return file.read(4) in (b"PK\x03\x04", b"PK\x05\x06")


def read_files(path: Path) -> dict[str, bytes]:
    """The content of each file of text, by its path in the folder or zip file."""
    if path.is_dir():
        names = sorted(
            Path(folder, name).relative_to(path).as_posix()
            for folder, _, inside in os.walk(path)
            for name in inside
        )
        return {name: _content(path / name) for name in _names_of_texts(path, names)}
    return _members(path) if is_zip(path) else {path.name: _content(path)}


def _content(path: Path) -> bytes:
    if path.stat().st_size > LARGEST:
        raise LogError(path, f"must have at most {LARGEST} bytes of text")
    return path.read_bytes()


def _members(path: Path) -> dict[str, bytes]:
    """The files of text in a zip file, which may be larger than it declares."""
    left = min(LARGEST, max(SMALL, RATIO * path.stat().st_size))
    files = {}
    content = io.BytesIO(_content(path))
    if not zipfile.is_zipfile(content):
        raise LogError(path, "must be a whole zip file, but its end is missing: copy it again")
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


def shorten(cell: str) -> str:
    """A cell for a message."""
    return repr(cell if len(cell) <= SHOWN else f"{cell[:SHOWN]}...")


def list_columns(names: Iterable[str]) -> str:
    """The first of some names of columns, for a message."""
    return list_names(f"`{name}`" for name in names)


class NoTableError(LogError):
    """A file without a table of numbers, or without times: other files of a folder may do."""


def decode(path: Path, title: str, content: bytes) -> Text:
    """The text of a file, by its byte-order mark, or as UTF-8, or as Latin-1."""
    text = Text(path, title, b"", 1, float("nan"), [])
    for begin, kind in OTHER_KINDS.items():
        if content.startswith(begin):
            raise text.error(f"must be text, but is {kind}")
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
        words = "must be text in UTF-8, in Latin-1, or in UTF-16 with a byte-order mark"
        raise text.error(f"{words}, but has the byte {control[0][0]}", line)
    try:
        content.decode()
    except UnicodeDecodeError:
        content = content.decode("latin-1").encode()
        text.words.append("The text is not UTF-8: read as Latin-1.")
    return text._replace(content=content)


def divide(text: Text) -> list[Text]:
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
