"""HDF5 files of arrays in groups."""

import math
import mmap
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from struct import Struct
from typing import Any

import numpy as np
from jaxtyping import Bool, Shaped

from .columns import NUMBERS, Column, TimeNames, TimeUnit, make_log, require_size
from .log import Log
from .signal import LogError, foreign_reader

KIND = "HDF5"

LONGEST_FACT = 200  # characters
# Of section III.E of the format: a collection of texts.
HEAP = b"GCOL\x01\0\0\0"
HEAP_HEAD, HEAP_OBJECT = Struct("<8sQ"), Struct("<HHIQ")  # and size; number, count, _, size
LEAST_HEAP = 4096  # bytes
# Of section IV.A: the head of an object, its messages, and attributes among them.
OBJECT_HEAD = Struct("<8xI4x")  # size
WITH_CHECKSUM = b"OHDR"
MESSAGE = Struct("<HH4x")  # kind, size
CONTINUES, CONTINUATION = 0x10, Struct("<QQ")  # address, size
ATTRIBUTE, ATTRIBUTE_HEAD = 0xC, Struct("<BxHHH")  # version; sizes of name, type and dimensions
TEXT = Struct("<IQI")  # length, address of the collection, number of the object
LARGEST_BLOCK, MOST_BLOCKS = 2**24, 100
# Attributes of netCDF: numbers are packed as (number - offset) / scale.
FILL_VALUE, SCALE, OFFSET = "_FillValue", "scale_factor", "add_offset"


def read(path: Path, time: TimeNames | None = None, time_unit: TimeUnit | None = None) -> Log:
    """Read an HDF5 file: a signal for each dataset of numbers.

    A signal has the name of the dataset with its groups, such as `imu.gyro` for `/imu/gyro`. The
    fields of a compound dataset are as datasets in a group.

    Parameters
    ----------
    path
        The file.
    time
        The dataset of times, with or without its groups, such as `"imu.clock"`; or the datasets
        of times of others or of groups, as `{"imu": "imu.clock"}`. By default times are recognised
        by their name, such as `t`, `time`, `timestamp`, `time_s` or `timestamp_ns`: those in the
        group of a dataset, or else in the next larger group.
    time_unit
        The unit of the times, `"s"`, `"ms"`, `"us"` or `"ns"`. By default it is that in the
        attributes or in the name of the dataset.

    Returns
    -------
    Log
        Units and axes are those in the attributes of the datasets, `unit` or `units`, and `frame`.
        Numbers that netCDF has packed, by the attributes `scale_factor` and `add_offset`, are
        unpacked; those that are its `_FillValue`, or were never written, are NaN. Samples are along
        the axis that is as long as the times.

    Raises
    ------
    LogError
        If the file cannot be read, would need more than 2 GiB of memory, or times are not
        recognised.
    ImportError
        Without the package h5py.

    References
    ----------
    The format: <https://support.hdfgroup.org/documentation/hdf5/latest/_f_m_t3.html>. Packed
    numbers: <https://docs.unidata.ucar.edu/nug/current/attribute_conventions.html>.
    """
    columns: dict[str, Column] = {}
    lost: list[str] = []
    with open_hdf5(path, KIND) as file:
        datasets, left_out = _datasets(file)
        require_size(path, sum(map(size_to_read, datasets.values())))
        for name, dataset in datasets.items():
            try:
                columns |= _columns(name, dataset, left_out)
            except Exception as error:  # whatever the package raises for damaged parts
                lost.append(f"`{name}` ({' '.join(str(error).split())[:100]})")
        facts = {name: text for name in file.attrs if (text := attribute(file, name))}
    if len(lost) > len(columns):
        raise LogError(path, f"is damaged: {', '.join(lost)} cannot be read")
    assumed = [f"Datasets that are damaged were left out: {', '.join(lost)}."] if lost else []
    if left_out:
        words = "Datasets without numbers, or with numbers that are not in the file, were left out"
        assumed.append(f"{words}: {', '.join(left_out)}.")
    return make_log(path, KIND, columns, time, time_unit, facts, assumed)


@contextmanager
def open_hdf5(path: Path, kind: str) -> Iterator[Any]:
    """An HDF5 file to read, after a check of what the package would read without end.

    Raises
    ------
    LogError
        For a damaged file, also by what is done with the file.
    ImportError
        Without the package h5py.
    """
    try:
        import h5py
    except ImportError as error:
        words = f'Files of the kind {kind} need h5py: pip install "lgvi[logs]"'
        raise ImportError(words) from error
    with foreign_reader(path, kind):
        _check_heaps(path)
        with h5py.File(path, "r") as file:
            yield file


def _check_heaps(path: Path) -> None:
    """Refuse a file with a collection of texts that the package would read without end."""
    with open(path, "rb") as file:
        content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    with content:
        begin = content.find(HEAP)
        while begin >= 0:
            try:
                dict(_objects(content[begin : begin + LARGEST_BLOCK]))
            except ValueError as error:
                raise LogError(path, f"is damaged: {error}", f"byte {begin}") from None
            begin = content.find(HEAP, begin + 1)


def _objects(collection: bytes) -> Iterator[tuple[int, bytes]]:
    """The number and the content of each object in a collection of texts.

    See section III.E of the format, "Global Heap".
    """
    if not collection.startswith(HEAP) or len(collection) < HEAP_HEAD.size:
        raise ValueError("there must be a collection of texts")
    _, size = HEAP_HEAD.unpack_from(collection)
    if size < LEAST_HEAP or len(collection) < min(size, LARGEST_BLOCK):
        raise ValueError(f"a collection of texts has a size of {size} bytes")
    place = HEAP_HEAD.size
    while place + HEAP_OBJECT.size <= min(size, LARGEST_BLOCK):
        number, _, _, length = HEAP_OBJECT.unpack_from(collection, place)
        # The free space at the end, which has the number 0, counts its own head.
        step = HEAP_OBJECT.size + length + -length % 8 if number else length
        if step < HEAP_OBJECT.size or place + step > size:
            raise ValueError(f"a text in a collection has a size of {length} bytes")
        yield number, collection[place + HEAP_OBJECT.size : place + HEAP_OBJECT.size + length]
        place += step


def _datasets(file: Any) -> tuple[dict[str, Any], list[str]]:
    """The datasets of numbers by name, each once, and the names of others, also in other files."""
    import h5py

    datasets: dict[str, Any] = {}
    left_out: list[str] = []

    def collect(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            name = name.replace("/", ".")
            if item.shape is not None and _has_numbers(item.dtype) and is_stored(item):
                datasets[name] = item
            else:
                left_out.append(name)

    def collect_link(name: str, link: Any) -> None:
        if isinstance(link, h5py.ExternalLink):
            left_out.append(name.replace("/", "."))

    file.visititems(collect)
    file.visititems_links(collect_link)
    return datasets, left_out


def is_stored(dataset: Any) -> bool:
    """Whether the numbers of a dataset are in its file.

    They may be in other files, or nowhere: then the dataset is any number of zeros.
    """
    elsewhere = dataset.is_virtual or dataset.external
    return not elsewhere and 0 < dataset.id.get_storage_size() <= dataset.file.id.get_filesize()


def size_to_read(dataset: Any) -> int:
    """Bytes of memory that it takes to read a dataset: at least one chunk, which may be larger."""
    return max(dataset.nbytes, dataset.dtype.itemsize * math.prod(dataset.chunks or ()))


def attribute(item: Any, name: str) -> str:
    """A text or number that is an attribute; empty if there is none."""
    import h5py

    with suppress(Exception):  # of a damaged one; others may be whole
        described = item.attrs.get_id(name)
        text = h5py.check_string_dtype(described.dtype)
        if described.shape in ((), (1,)) and (text or described.dtype.kind in NUMBERS):
            if text and text.length is None:
                return _text_of_collection(item, name)[:LONGEST_FACT]
            return _as_text(np.asarray(item.attrs[name]).item())[:LONGEST_FACT]
    return ""


def _as_text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _text_of_collection(item: Any, name: str) -> str:
    """An attribute of any length, which is in a collection of texts.

    The package takes the length for true, and may read gigabytes or crash if it is damaged: the
    text is read here, except where the file has a checksum of the attribute. See section IV.A of
    the format, "Data Object Headers".
    """
    from h5py import h5o  # pyright: ignore[reportAttributeAccessIssue]

    with open(item.file.filename, "rb") as file:

        def take(address: int, size: int) -> bytes:
            file.seek(item.file.userblock_size + address)
            return file.read(min(size, LARGEST_BLOCK))

        address = h5o.get_info(item.id).addr
        head = take(address, OBJECT_HEAD.size)
        if head.startswith(WITH_CHECKSUM):
            return _as_text(np.asarray(item.attrs[name]).item())
        blocks = [(address + OBJECT_HEAD.size, *OBJECT_HEAD.unpack(head))]
        for begin, size in blocks:
            for kind, message in _messages(take(begin, size)):
                if kind == CONTINUES and len(blocks) < MOST_BLOCKS:
                    blocks.append(CONTINUATION.unpack_from(message))
                elif kind == ATTRIBUTE:
                    version, *sizes = ATTRIBUTE_HEAD.unpack_from(message)
                    title = message[ATTRIBUTE_HEAD.size :][: sizes[0]].rstrip(b"\0")
                    if version == 1 and title == name.encode():
                        place = ATTRIBUTE_HEAD.size + sum(size + -size % 8 for size in sizes)
                        length, heap, number = TEXT.unpack_from(message, place)
                        objects = dict(_objects(take(heap, LARGEST_BLOCK)))
                        return _as_text(objects[number][:length])
    return ""


def _messages(block: bytes) -> Iterator[tuple[int, bytes]]:
    """The kind and the content of each message in a part of the head of an object."""
    place = 0
    while place + MESSAGE.size <= len(block):
        kind, size = MESSAGE.unpack_from(block, place)
        place += MESSAGE.size
        yield kind, block[place : place + size]
        place += size


def _has_numbers(kind: np.dtype) -> bool:
    fields = [field for field, *_ in (kind.base.fields or {}).values()]
    return kind.base.kind in NUMBERS or any(map(_has_numbers, fields))


def _columns(name: str, dataset: Any, left_out: list[str]) -> dict[str, Column]:
    """The array of a dataset, or an array for each field, but for those that are left out."""
    fields = dataset.dtype.fields
    if fields is not None:
        # Texts of any length, which are objects, may be damaged.
        simple = [field for field, (kind, *_) in fields.items() if not kind.hasobject]
        left_out += [f"{name}.{field}" for field in fields if field not in simple]
        if not simple:
            return {}
        records = dataset.fields(simple)[()]
        return {key: Column(values) for key, values in _fields(name, records)}
    values = dataset[()]
    scale, offset = _number(dataset, SCALE, 1.0), _number(dataset, OFFSET, 0.0)
    is_missing = ~_is_written(dataset)
    if attribute(dataset, FILL_VALUE):
        is_missing |= values == np.asarray(dataset.attrs[FILL_VALUE])
    if (scale, offset) != (1, 0):
        values = values * scale + offset
    if is_missing.any():
        values = np.where(is_missing, np.nan, values)
    unit = attribute(dataset, "unit") or attribute(dataset, "units")
    return {name: Column(values, unit, attribute(dataset, "frame"))}


def _number(dataset: Any, name: str, otherwise: float) -> float:
    """A number that is an attribute."""
    try:
        return float(attribute(dataset, name))
    except ValueError:
        return otherwise


def _fields(name: str, records: Shaped[np.ndarray, "..."]) -> Iterator[tuple[str, np.ndarray]]:
    """The arrays of numbers in the fields of records, and in their fields."""
    if records.dtype.kind in NUMBERS:
        yield name, records
    for field in records.dtype.names or ():
        yield from _fields(f"{name}.{field}", records[field])


def _is_written(dataset: Any) -> Bool[np.ndarray, "..."]:
    """Which numbers were written: a dataset may be made larger than what is written later."""
    if not dataset.chunks:
        return np.ones(dataset.shape, bool)
    is_written = np.zeros(dataset.shape, bool)

    def mark(chunk: Any) -> None:
        parts = zip(chunk.chunk_offset, dataset.chunks, strict=True)
        is_written[tuple(slice(begin, begin + size) for begin, size in parts)] = True

    dataset.id.chunk_iter(mark)
    return is_written
