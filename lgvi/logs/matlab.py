"""MAT files of MATLAB: version 5 to 7 by their layout, version 7.3 as HDF5."""

import math
import zlib
from collections.abc import Iterator
from pathlib import Path
from struct import Struct
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from .columns import (
    MOST_BYTES,
    NUMBERS,
    Column,
    TimeNames,
    TimeUnit,
    make_log,
    require_size,
)
from .hdf5 import attribute, is_stored, open_hdf5
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
CELL, STRUCTURE, CHARACTERS, OBJECT = 1, 2, 4, 17
NUMERIC = range(6, 16)
COMPLEX = 0x800
OTHERS = {3: "object", 5: "sparse matrix", 16: "function"}
CLASSES = {"", "double", "single", "logical", "cell", "struct"} | {
    f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}

MOST_PARTS = 100  # of a cell array or an array of structures
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


Value = Any  # of a variable: an array of numbers, text, a list of parts, a dictionary of fields


def read(path: Path, time: TimeNames | None = None, time_unit: TimeUnit | None = None) -> Log:
    """Read a MAT file of version 5 to 7.3: a signal for each array of numbers.

    A signal has the name of the variable with its fields, such as `imu.gyro`; parts of cells and of
    arrays of structures have a number from 0, as in `out.signals[0].values`. Objects, such as
    timetables, timeseries and data sets of Simulink, are not read.

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
        variables, damage = _variables(path, path.read_bytes(), ORDERS[version])
    else:
        words = "must be a MAT file of version 5 to 7.3 (in MATLAB: save -v7), but is not"
        raise LogError(path, words, f"byte {HEADER - 4}")
    columns: dict[str, Column] = {}
    facts: dict[str, str] = {}
    objects: list[str] = []
    for name, value in variables:
        if isinstance(value, Unread):
            objects.append(f"`{name}` ({value.kind})")
        elif isinstance(value, str):
            facts[name] = value[:LONGEST_FACT]
        elif value.size == 1:
            facts[name] = str(value.item())
        elif value.size:
            columns[name] = Column(value)
    if objects and not columns:
        raise LogError(path, f"must have arrays, but has {', '.join(objects)}; {OBJECTS}")
    if objects:
        damage.append(f"Left out: {', '.join(objects)}; {OBJECTS}.")
    return make_log(path, KIND, columns, time, time_unit, facts, damage)


def _parts(name: str, value: Value) -> Iterator[tuple[str, Value]]:
    """The arrays of numbers and the texts in a variable, by name."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _parts(f"{name}.{key}", part)
    elif isinstance(value, list):
        for i, part in enumerate(value[:MOST_PARTS]):
            yield from _parts(f"{name}[{i}]", part)
    else:
        yield name, value


def _variables(path: Path, content: bytes, order: str) -> tuple[list[tuple[str, Value]], list[str]]:
    """The variables of a file before version 7.3, and what is damaged, in words."""
    elements = Elements(memoryview(content)[HEADER:], order)
    variables: list[tuple[str, Value]] = []
    damage: list[str] = []
    count, size = 0, 0
    while elements.rest:
        begin = len(content) - len(elements.rest)
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
            if kind != ARRAY:
                raise ValueError(f"has an element of the kind {kind} instead of an array")
            name, value = _array(data, order)
        except LogError:
            raise
        except (ValueError, IndexError, RecursionError, zlib.error) as error:
            damage.append(f"A variable that is damaged was left out, at byte {begin}: {error}.")
            continue
        count += 1
        variables += _parts(name, value) if name else ()  # what objects share has no name
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

    def text(self) -> str:
        """The next element as text."""
        kind, data = self.take()
        encoding = ENCODINGS.get(kind, "latin1")
        ending = {"<": "-le", ">": "-be"}[self.order] if encoding in ("utf-16", "utf-32") else ""
        return bytes(data).decode(encoding + ending, errors="replace")


def _array(data: memoryview, order: str) -> tuple[str, Value]:
    """The name and the value of a variable, a part of a cell array or a field."""
    if not data:
        return "", np.empty(0)
    elements = Elements(data, order)
    flags = int(elements.numbers()[0])
    kind = flags & 0xFF
    if kind == OBJECT:
        name, _, class_name = elements.text(), elements.text(), elements.text()
        return name, Unread(class_name)
    shape = tuple(map(int, elements.numbers()))
    size = math.prod(shape)
    if min(shape, default=0) < 0 or size > len(data):
        raise ValueError(f"has {len(data)} bytes, too few for the dimensions {shape}")
    name = elements.text()
    if kind in NUMERIC and not flags & COMPLEX:
        return name, elements.numbers().reshape(shape, order="F")
    if kind == CHARACTERS:
        return name, _rows(elements.text(), shape[0])
    if kind == CELL:
        return name, [_inner(elements) for _ in range(size)]
    if kind == STRUCTURE:
        length = int(elements.numbers()[0])
        _, names = elements.take()
        fields = [
            bytes(names[i : i + length]).partition(b"\0")[0].decode("latin1")
            for i in range(0, len(names), max(length, 1))
        ]
        parts = [{field: _inner(elements) for field in fields} for _ in range(size)]
        return name, parts[0] if size == 1 else parts
    return name, Unread(OTHERS.get(kind, "complex numbers"))


def _inner(elements: Elements) -> Value:
    """A part of a cell array, or a field."""
    kind, data = elements.take()
    if kind != ARRAY:
        raise ValueError(f"has an element of the kind {kind} instead of an array")
    return _array(data, elements.order)[1]


def _rows(text: str, count: int) -> Value:
    """A text, or a list of texts if there are several rows, which are written letter by letter."""
    return text if count <= 1 else [text[i::count].rstrip() for i in range(count)]


def _hdf5_variables(path: Path) -> list[tuple[str, Value]]:
    """The variables of a file of version 7.3.

    It is an HDF5 file, where structures are groups, arrays have their dimensions reversed, and the
    parts of cells and of arrays of structures are referred to.
    """
    size, count = 0, 0

    def parts(name: str, item: Any, depth: int) -> Iterator[tuple[str, Value]]:
        import h5py

        nonlocal size, count
        count += 1
        if depth > DEEPEST or count > MOST_ARRAYS:
            raise ValueError(f"structures in structures of more than {MOST_ARRAYS} arrays")
        kind = attribute(item, "MATLAB_class")
        if isinstance(item, h5py.Group):
            if "MATLAB_sparse" in item.attrs:
                yield name, Unread("sparse matrix")
                return
            for key in map(str, item):
                inner = f"{name}.{key}" if name else key
                if not isinstance(item.get(key, getlink=True), h5py.HardLink):
                    yield inner, Unread("link")
                elif not key.startswith("#"):
                    yield from parts(inner, item[key], depth + 1)
            return
        if item.shape is None or "MATLAB_empty" in item.attrs:
            return
        if not is_stored(item, path.stat().st_size):
            yield name, Unread("array that is not in the file")
            return
        require_size(path, size := size + item.nbytes)
        if h5py.check_ref_dtype(item.dtype) is not None:
            group, _, field = name.rpartition(".")
            for i, reference in enumerate(item[()].ravel()[:MOST_PARTS]):
                inner = f"{name}[{i}]" if kind or not group else f"{group}[{i}].{field}"
                yield from parts(inner, item.file[reference], depth + 1)
        elif kind == "char":
            yield from _parts(name, _rows("".join(map(chr, item[()].ravel())), item.shape[-1]))
        elif kind not in CLASSES or item.dtype.kind not in NUMBERS:
            yield name, Unread(kind if kind not in CLASSES else "complex numbers")
        else:
            yield name, item[()].T

    with open_hdf5(path, KIND) as file:
        return list(parts("", file["/"], 0))
