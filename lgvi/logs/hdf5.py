"""HDF5 files of arrays in groups."""

from pathlib import Path
from typing import Any

import numpy as np

from .columns import (
    NUMBERS,
    Column,
    TimeNames,
    TimeUnit,
    foreign_errors,
    is_stored,
    make_log,
    require_size,
)
from .log import Log
from .signal import LogError

KIND = "HDF5"

LONGEST_FACT = 200  # characters


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
    try:
        import h5py
    except ImportError as error:
        raise ImportError('HDF5 files need h5py: pip install "lgvi[logs]"') from error

    columns: dict[str, Column] = {}
    lost: list[str] = []
    datasets: dict[str, Any] = {}
    with foreign_errors(path, KIND), h5py.File(path, "r") as file:

        def collect(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset):
                datasets[name.replace("/", ".")] = item

        file.visititems(collect)  # goes to no other file, and to each item once
        facts = {name: _text(value) for name, value in file.attrs.items()}
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


def _has_numbers(dataset: Any) -> bool:
    kinds = dataset.dtype.fields or {"": (dataset.dtype, 0)}
    return dataset.shape is not None and any(
        kind.base.kind in NUMBERS for kind, *_ in kinds.values()
    )


def _columns(name: str, dataset: Any) -> dict[str, Column]:
    """The array of a dataset, or an array for each field."""
    words = {key: _text(value) for key, value in dataset.attrs.items()}
    described = words.get("unit") or words.get("units") or "", words.get("frame", "")
    fields = dataset.dtype.fields
    if fields is None:
        return {name: Column(dataset[()], *described)}
    numbers = [field for field, (kind, *_) in fields.items() if kind.base.kind in NUMBERS]
    records = dataset.fields(numbers)[()]
    return {f"{name}.{field}": Column(np.asarray(records[field])) for field in numbers}


def _text(value: Any) -> str:
    """An attribute in words."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    return (value.decode(errors="replace") if isinstance(value, bytes) else str(value))[
        :LONGEST_FACT
    ]
