"""MAT files of MATLAB: version 5 to 7 by their layout, version 7.3 as HDF5."""

import math
import zlib
from collections.abc import Iterator
from pathlib import Path
from struct import Struct
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from .columns import MOST_BYTES, NUMBERS, Column, TimeNames, TimeUnit, make_log, require_size
from .hdf5 import attribute, is_stored, open_hdf5, size_to_read
from .log import Log
from .signal import LogError

KIND = "MATLAB"

HEADER = 128  # bytes, of which the last four are version and order of bytes
ORDERS = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}
VERSION_7_3 = b"\x00\x02IM"

# Kinds of elements: numbers, texts, arrays and what is compressed.
TYPES = dict(
    zip(
        (1, 2, 3, 4, 5, 6, 7, 9, 12, 13),
        ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8", "i8", "u8"),
        strict=True,
    )
)
ENCODINGS = {1: "latin1", 2: "latin1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
ARRAY, COMPRESSED = 14, 15
# Kinds of arrays.
CELL, STRUCTURE, OLD_OBJECT, CHARACTERS, OBJECT = 1, 2, 3, 4, 17
NUMERIC = range(6, 16)
COMPLEX = 0x800
OTHERS = {OLD_OBJECT: "object", 5: "sparse matrix", 16: "function"}
CLASSES = {"", "double", "single", "logical", "char", "cell", "struct"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}

MOST_PARTS = 100  # of a cell array or an array of structures
PARTS_LEFT_OUT = f"parts from number {MOST_PARTS} on"
MOST_ARRAYS = 10_000
DEEPEST = 20  # structures and cells in each other
LONGEST_FACT = 200  # characters
OBJECTS = (
    "objects, such as timetables, timeseries and data sets of Simulink, are not read: save their "
    "arrays, such as `imu.t = seconds(T.Time); imu.gyro = T.gyro;`"
)


class Unread(NamedTuple):
    """A variable that is no array, text, cell array or structure."""

    kind: str
    is_object: bool = False


Value = Shaped[np.ndarray, "..."] | str | Unread


def read(path: Path, time: TimeNames | None = None, time_unit: TimeUnit | None = None) -> Log:
    """Read a MAT file of version 5 to 7.3: a signal for each array of numbers.

    A signal has the name of the variable with its fields, such as `imu.gyro`; parts of cells and of
    arrays of structures, of which the first 100 are read, have a number from 0, as in
    `out.signals[0].values`. Objects, such as timetables, timeseries and data sets of Simulink, are
    not read.

    Parameters
    ----------
    path
        The file.
    time
        The variable of times, with or without the structures around it, such as `"imu.clock"`; or
        the variables of times of others or of structures, as `{"imu": "imu_clock"}`. By default
        times are recognised by their name, such as `t`, `time`, `tout`, `timestamp`, `time_s` or
        `t_us`: those in the structure of an array, or else in the next larger one.
    time_unit
        The unit of the times, `"s"`, `"ms"`, `"us"` or `"ns"`. By default it is that in the name;
        times without a unit are s if they have steps from 1e-5 to 1 and not only whole numbers.

    Returns
    -------
    Log
        Samples are along the dimension that is as long as the times. Single numbers and texts are
        facts.

    Raises
    ------
    LogError
        If the file cannot be read, holds no arrays, would need more than 2 GiB of memory, or times
        are not recognised.
    ImportError
        For version 7.3 without the package h5py.

    References
    ----------
    The format: <https://www.mathworks.com/help/pdf_doc/matlab/matfile_format.pdf>.
    """
    with open(path, "rb") as file:
        version = file.read(HEADER)[-4:]
    if version == VERSION_7_3:
        variables, damage = _hdf5_variables(path), []
    elif version in ORDERS:
        variables, damage = _variables(path, ORDERS[version])
    else:
        words = "must be a MAT file of version 5 to 7.3 (in MATLAB: save -v7), but is not"
        raise LogError(path, words, f"byte {HEADER - 4}")
    columns: dict[str, Column] = {}
    facts: dict[str, str] = {}
    unread: dict[str, Unread] = {}
    for name, value in variables:
        if isinstance(value, Unread):
            unread[name] = value
        elif isinstance(value, str):
            facts[name] = value[:LONGEST_FACT]
        elif value.size == 1:
            facts[name] = str(value.item())
        elif value.size:
            columns[name] = Column(value)
    left_out = ", ".join(f"`{name}` ({kind})" for name, (kind, _) in unread.items())
    if any(value.is_object for value in unread.values()):
        left_out += f"; {OBJECTS}"
    if unread and not columns:
        raise LogError(path, f"must have arrays, but has {left_out}")
    if unread:
        damage.append(f"Left out: {left_out}.")
    return make_log(path, KIND, columns, time, time_unit, facts, damage)


def _variables(path: Path, order: str) -> tuple[list[tuple[str, Value]], list[str]]:
    """The variables of a file before version 7.3, and what is damaged, in words."""
    size = path.stat().st_size
    require_size(path, size)
    elements = Elements(memoryview(path.read_bytes())[HEADER:], order)
    variables: list[tuple[str, Value]] = []
    damage: list[str] = []
    count, length = 0, size
    while elements.rest:
        begin = length - len(elements.rest)
        try:
            kind, data = elements.take()
        except ValueError as error:
            damage.append(f"The file {error} at byte {begin}: {count} variables were read.")
            break
        try:
            if kind == COMPRESSED:
                inflater = zlib.decompressobj()
                data = inflater.decompress(data, MOST_BYTES + 1 - size)
                require_size(path, size := size + len(data))
                if not inflater.eof:
                    raise ValueError("is compressed, and ends too soon")
                kind, data = Elements(memoryview(data), order).take()
            variables += list(_values("", kind, data, order))
            count += 1
        except LogError:
            raise
        except (ValueError, IndexError, RecursionError, zlib.error) as error:
            damage.append(f"A variable that is damaged was left out, at byte {begin}: {error}.")
    if len(damage) > count:
        raise LogError(path, f"is damaged: {damage[0]}")
    return variables, damage


class Elements:
    """The elements of a part of a file, one after another.

    An element is its kind, its size, and data that fill up 8 bytes; up to 4 bytes of data may
    stand in the place of the size, and the size with the kind.
    """

    def __init__(self, rest: memoryview, order: str):
        self.rest, self.order = rest, order
        self.tag = Struct(f"{order}II")

    def take(self) -> tuple[int, memoryview]:
        """The kind and the data of the next element."""
        if len(self.rest) < self.tag.size:
            raise ValueError("ends in the middle of an element")
        kind, size = self.tag.unpack_from(self.rest)
        begin, step = self.tag.size, self.tag.size
        if kind >> 16:
            kind, size, begin = kind & 0xFFFF, kind >> 16, 4
        else:
            step += size if kind == COMPRESSED else size + -size % 8
        data = self.rest[begin : begin + size]
        if len(data) < size or begin + size > step:
            raise ValueError("ends in the middle of an element")
        self.rest = self.rest[step:]
        return kind, data

    def numbers(self) -> Shaped[np.ndarray, " numbers"]:
        """The next element as numbers."""
        kind, data = self.take()
        if kind not in TYPES:
            raise ValueError(f"has an element of the kind {kind} instead of numbers")
        return np.frombuffer(data, self.order + TYPES[kind])

    def names(self) -> list[str]:
        """The next two elements as the names of fields, which all take up the same length."""
        length = max(int(self.numbers()[0]), 1)
        _, data = self.take()
        parts = (bytes(data[i : i + length]) for i in range(0, len(data), length))
        return [part.partition(b"\0")[0].decode("latin1") for part in parts]

    def text(self) -> str:
        """The next element as text."""
        kind, data = self.take()
        encoding = ENCODINGS.get(kind, "latin1")
        ending = {"<": "-le", ">": "-be"}[self.order] if encoding in ("utf-16", "utf-32") else ""
        return bytes(data).decode(encoding + ending, errors="replace")


def _values(name: str, kind: int, data: memoryview, order: str) -> Iterator[tuple[str, Value]]:
    """The arrays of numbers and the texts in an element, by name.

    The name is that of a part of a cell array or of a structure, and empty for a variable.
    """
    if kind != ARRAY:
        raise ValueError(f"has an element of the kind {kind} instead of an array")
    if not data:
        return
    elements = Elements(data, order)
    flags = int(elements.numbers()[0])
    kind = flags & 0xFF
    shape = [] if kind == OBJECT else elements.numbers().tolist()
    title = elements.text()
    name = name or title
    if not name:  # what objects share
        return
    if kind == OBJECT:
        _, class_name = elements.text(), elements.text()
        yield name, Unread(class_name, is_object=True)
        return
    if kind in OTHERS or flags & COMPLEX:
        yield name, Unread(OTHERS.get(kind, "complex numbers"), is_object=kind == OLD_OBJECT)
        return
    size = math.prod(shape)
    if min(shape, default=0) < 0 or size > len(data):
        raise ValueError(f"has {len(data)} bytes, too few for the dimensions {shape}")
    if kind in NUMERIC:
        yield name, elements.numbers().reshape(shape, order="F")
    elif kind == CHARACTERS:
        yield from _texts(name, elements.text(), shape[0])
    elif kind in (CELL, STRUCTURE):
        fields = [f".{field}" for field in elements.names()] if kind == STRUCTURE else [""]
        for i in range(min(size, MOST_PARTS)):
            part = name if kind == STRUCTURE and size == 1 else f"{name}[{i}]"
            for field in fields:
                yield from _values(f"{part}{field}", *elements.take(), order)
        if size > MOST_PARTS:
            yield name, Unread(PARTS_LEFT_OUT)
    else:
        raise ValueError(f"has an array of the kind {kind}")


def _texts(name: str, letters: str, rows: int) -> Iterator[tuple[str, str]]:
    """A text, or the texts of several rows, which are written column by column."""
    if rows < 2 or not letters:
        yield name, letters
    else:
        yield from ((f"{name}[{i}]", letters[i::rows].rstrip()) for i in range(rows))


def _hdf5_variables(path: Path) -> list[tuple[str, Value]]:
    """The variables of a file of version 7.3.

    It is an HDF5 file, where structures are groups, arrays have their dimensions reversed, and the
    parts of cells and of arrays of structures are referred to.
    """
    size, count = 0, 0

    def values(name: str, item: Any, depth: int) -> Iterator[tuple[str, Value]]:
        import h5py

        nonlocal size, count
        count += 1
        if depth > DEEPEST or count > MOST_ARRAYS:
            raise ValueError(f"structures in structures of more than {MOST_ARRAYS} arrays")
        kind = attribute(item, "MATLAB_class")
        if kind not in CLASSES:
            yield name, Unread(kind, is_object=True)
        elif "MATLAB_sparse" in item.attrs:
            yield name, Unread("sparse matrix")
        elif isinstance(item, h5py.Group):
            for key in map(str, item):
                inner = f"{name}.{key}" if name else key
                if not isinstance(item.get(key, getlink=True), h5py.HardLink):
                    yield inner, Unread("link")
                elif not key.startswith("#"):
                    yield from values(inner, item[key], depth + 1)
        elif item.shape is None or "MATLAB_empty" in item.attrs:
            pass
        elif not is_stored(item):
            yield name, Unread("array that is not in the file")
        else:
            require_size(path, size := size + size_to_read(item))
            try:
                numbers = item[()]
            except Exception:  # whatever the package raises for damaged parts
                yield name, Unread("array that is damaged")
                return
            if h5py.check_ref_dtype(item.dtype) is not None:
                group, _, field = name.rpartition(".")
                for i, reference in enumerate(numbers.ravel()[:MOST_PARTS]):
                    inner = f"{name}[{i}]" if kind or not group else f"{group}[{i}].{field}"
                    if reference:
                        yield from values(inner, item.file[reference], depth + 1)
                if numbers.size > MOST_PARTS:
                    yield name, Unread(PARTS_LEFT_OUT)
            elif item.dtype.kind not in NUMBERS:
                yield name, Unread("complex numbers")
            elif kind == "char" and item.dtype.kind == "u":
                letters = numbers.astype("<u2").tobytes().decode("utf-16-le", errors="replace")
                yield from _texts(name, letters, numbers.shape[-1])
            else:
                yield name, numbers.T

    with open_hdf5(path, KIND) as file:
        return list(values("", file["/"], 0))
