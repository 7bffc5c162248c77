"""HDF5 files of arrays in groups."""

import mmap
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from struct import Struct
from typing import Any

import numpy as np

from .columns import (
    NUMBERS,
    Column,
    TimeNames,
    TimeUnit,
    make_log,
    require_size,
)
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
        Samples are along the axis that is as long as the times.

    Raises
    ------
    LogError
        If the file cannot be read, would need more than 2 GiB of memory, or times are not
        recognised.
    ImportError
        Without the package h5py.

    References
    ----------
    The format: <https://support.hdfgroup.org/documentation/hdf5/latest/_f_m_t3.html>.
    """
    columns: dict[str, Column] = {}
    lost: list[str] = []
    with open_hdf5(path, KIND) as file:
        datasets = _datasets(file)
        size = path.stat().st_size
        inside = {
            name: dataset
            for name, dataset in datasets.items()
            if _has_numbers(dataset) and is_stored(dataset, size)
        }
        require_size(path, sum(dataset.nbytes for dataset in inside.values()))
        for name, dataset in inside.items():
            try:
                columns |= _columns(name, dataset)
            except Exception as error:  # whatever the package raises for damaged parts
                lost.append(f"`{name}` ({' '.join(str(error).split())[:100]})")
        facts = {name: text for name in file.attrs if (text := attribute(file, name))}
    left_out = [name for name in datasets if name not in inside]
    if len(lost) > len(columns):
        raise LogError(path, f"is damaged: {', '.join(lost)} cannot be read")
    assumed = [f"Datasets that are damaged were left out: {', '.join(lost)}."] if lost else []
    if left_out:
        words = (
            "Datasets without numbers, or with numbers that are not in the file, were left out: "
        )
        assumed.append(f"{words}{', '.join(left_out)}.")
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


def _datasets(file: Any) -> dict[str, Any]:
    """The datasets by name: of this file, and each once."""
    import h5py

    datasets: dict[str, Any] = {}

    def collect(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            datasets[name.replace("/", ".")] = item

    file.visititems(collect)
    return datasets


def is_stored(dataset: Any, size: int) -> bool:
    """Whether the numbers of a dataset are in its file, of a size in bytes.

    They may be in other files, or nowhere: then the dataset is any number of zeros.
    """
    elsewhere = dataset.is_virtual or dataset.external
    return not elsewhere and (dataset.chunks is not None or dataset.nbytes <= size)


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


def _has_numbers(dataset: Any) -> bool:
    kinds = dataset.dtype.fields or {"": (dataset.dtype, 0)}
    return dataset.shape is not None and any(
        kind.base.kind in NUMBERS for kind, *_ in kinds.values()
    )


def _columns(name: str, dataset: Any) -> dict[str, Column]:
    """The array of a dataset, or an array for each field."""
    unit = attribute(dataset, "unit") or attribute(dataset, "units")
    described = unit, attribute(dataset, "frame")
    fields = dataset.dtype.fields
    if fields is None:
        return {name: Column(dataset[()], *described)}
    numbers = [field for field, (kind, *_) in fields.items() if kind.base.kind in NUMBERS]
    records = dataset.fields(numbers)[()]
    return {f"{name}.{field}": Column(np.asarray(records[field])) for field in numbers}
