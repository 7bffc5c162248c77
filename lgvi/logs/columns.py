"""Logs that are named arrays: which are times, and which are signals. Parquet files."""

import math
import re
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Shaped

from ..modules.units import TIME_UNITS
from .delimited.times import PLAIN_STEPS, TICKS
from .log import Log
from .signal import LogError, Signal, foreign_reader, list_names

KIND = "Parquet"

TimeUnit = Literal["s", "ms", "us", "ns"]
TimeNames = str | Mapping[str, str]

MOST_BYTES = 2**31  # of all arrays of a file
MOST_COMPONENTS = 100
LATE, LATEST = 1e6, 1e11  # s: times from then on have another zero; there are no later ones
TIME = re.compile(
    r"(?:t(?![a-z])|tout|times?|time_?stamps?)"
    rf"(?:[_ ]*[\[(]?(?P<unit>{'|'.join(TIME_UNITS)})[\])]?)?",
    re.IGNORECASE,
)
IN_BRACKETS = re.compile(r".+?[\[(]([^\[\]()]+)[\])]")
NUMBERS = "fiub"  # kinds of arrays: floating, integer, unsigned, boolean
DATES = "Mm"  # dates, durations


class Column(NamedTuple):
    """An array of a file, with what the file says of it.

    Attributes
    ----------
    values
        The array; of dates and durations as datetime64 and timedelta64.
    unit
        The unit of the values; of dates `"UTC"`, if they are of that time zone.
    frame
        The axes of the body.
    """

    values: Shaped[np.ndarray, "..."]
    unit: str = ""
    frame: str = ""


def make_log(
    path: Path,
    kind: str,
    columns: Mapping[str, Column],
    time: TimeNames | None,
    time_unit: TimeUnit | None,
    facts: Mapping[str, str],
    assumed: list[str],
) -> Log:
    """A log from named arrays.

    The name of an array begins with the names of its groups, separated by points: `imu.gyro` is in
    the group `imu`.

    Parameters
    ----------
    path, kind, facts, assumed
        As for `Log`.
    columns
        The arrays.
    time
        The name of the times, with or without its groups; or the names of times for the names of
        arrays or groups, such as `{"imu": "imu_time"}`. By default, times are recognised by names
        such as `t`, `time`, `timestamp`, `time_s` and `timestamp_ns`, and arrays have the times of
        their group, or else of the next larger group.
    time_unit
        The unit of the times. By default it is that of the file or in the name; times without a
        unit are s if they have steps from 1e-5 to 1, and not only whole numbers.

    Returns
    -------
    Log
        A signal for each array that has as many samples as its times, along the first axis or
        else the last.

    Raises
    ------
    LogError
        If times or their unit cannot be recognised, or there is no signal.
    """
    if time_unit is not None and time_unit not in TICKS:
        allowed = ", ".join(map(repr, TICKS))
        raise ValueError(f"Argument `time_unit` must be one of {allowed}, but is {time_unit!r}.")
    assumed = list(assumed)
    names_of_times = _assign_times(path, columns, time)
    used = [name for name in dict.fromkeys(names_of_times.values()) if name]
    units = {name: _unit(path, name, columns[name], time_unit, assumed) for name in used}
    begins = [_begin(path, name, columns[name], units[name]) for name in used]
    zero = math.floor(min(begins)) if begins and abs(min(begins)) > LATE else 0
    times = {name: _seconds(columns[name].values, units[name], zero) for name in used}
    signals: dict[str, Signal] = {}
    unfit: list[str] = []
    for name, name_of_times in names_of_times.items():
        t = times.get(name_of_times)
        values = None if t is None else _samples(name, columns[name].values, len(t), assumed)
        if t is None or values is None:
            unfit.append(_shown(name, columns[name]))
            continue
        components = () if values.ndim == 1 else tuple(map(str, range(values.shape[1])))
        _, unit, frame = columns[name]
        signals[name] = Signal(name, t, values, unit=unit, frame=frame, components=components)
    if not signals:
        others = [_shown(name, column) for name, column in columns.items() if name not in used]
        words = (
            "must have times and arrays of their length, but has the times "
            f"{', '.join(used) or '(none)'} and the arrays {list_names(others) or '(none)'}: say "
            "which are the times by `time=`"
        )
        raise LogError(path, ". ".join([words, *assumed]))
    listed = ", ".join(f"`{name}`, in {units[name]}" for name in used)
    assumed.append(f"The times are {listed}.")
    if len(used) > 1:
        assumed.append("All times are taken as times of one clock.")
    if unfit:
        assumed.append(
            "Arrays that have no times of their length, or more than "
            f"{MOST_COMPONENTS} components, were left out: {list_names(unfit)}."
        )
    start = None
    if zero:
        assumed.append(f"The zero of the times is {zero} s of the times in the file.")
        if all(columns[name].unit == "UTC" for name in used):
            start = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=zero)
    return Log(str(path), kind, signals, start, dict(facts), assumed=tuple(assumed))


def _shown(name: str, column: Column) -> str:
    return f"`{name}` {column.values.shape}"


def _assign_times(
    path: Path, columns: Mapping[str, Column], time: TimeNames | None
) -> dict[str, str]:
    """The name of the times of each array that is not itself times; empty if it has none."""
    told = dict(time) if isinstance(time, Mapping) else {}
    if isinstance(time, str):
        times = [name for name in columns if time in (name, _last(name))]
    else:
        vectors = {name: column.values for name, column in columns.items() if _is_vector(column)}
        times = [name for name in vectors if TIME.fullmatch(_last(name))]
        times = times or [name for name in vectors if vectors[name].dtype.kind in DATES]
    known = {group for name in columns for group in _larger_groups(name)}
    unknown = [name for name in told if name not in known]
    unknown += [name for name in told.values() if name not in columns]
    unknown += [time] if isinstance(time, str) and not times else []
    if unknown:
        words = f"is not there; there are {list_names(columns)}"
        raise LogError(path, words, f"`{unknown[0]}`")
    assigned = {}
    for name, column in columns.items():
        if name in times or name in told.values():
            continue
        if chosen := [told[group] for group in _larger_groups(name) if group in told]:
            assigned[name] = chosen[0]
            continue
        groups = *list(_larger_groups(name))[1:], ""
        nearest = ([i for i in times if i.rpartition(".")[0] == group] for group in groups)
        near = next(filter(None, nearest), times if isinstance(time, str) else [])
        fitting = [i for i in near if columns[i].values.size in column.values.shape]
        if any(
            not np.array_equal(columns[fitting[0]].values, columns[i].values) for i in fitting[1:]
        ):
            words = "may belong to several times: say to which by `time=`; there are "
            raise LogError(path, words + list_names(fitting), f"array `{name}`")
        assigned[name] = fitting[0] if fitting else ""
    return assigned


def _last(name: str) -> str:
    """The name without its groups."""
    return name.rpartition(".")[2]


def _larger_groups(name: str) -> Iterator[str]:
    """The name, and the names of its groups, from the smallest."""
    while name:
        yield name
        name = name.rpartition(".")[0]


def _is_vector(column: Column) -> bool:
    values = column.values
    return values.size > 1 and values.size == max(values.shape) and values.dtype.kind in "fiuMm"


def _unit(
    path: Path, name: str, column: Column, time_unit: TimeUnit | None, assumed: list[str]
) -> str:
    """The unit of times."""
    values = column.values
    if values.dtype.kind in DATES:
        return np.datetime_data(values.dtype)[0]
    if time_unit is not None:
        return time_unit
    words = column.unit.split()  # such as "seconds since 2000-01-01"
    match = TIME.fullmatch(_last(name))
    declared = words[0] if words else (match and match["unit"]) or ""
    if declared.lower() in TIME_UNITS:
        return TIME_UNITS[declared.lower()]
    least, most = PLAIN_STEPS
    known = values[np.isfinite(values)]
    if not declared and values.dtype.kind == "f" and len(known) > 1 and np.any(known % 1):
        step = float(np.median(np.diff(known)))
        if least <= step <= most:
            assumed.append(f"`{name}` is taken in s: it has no unit, and its steps are {step:.3g}.")
            return "s"
    raise LogError(
        path,
        "must have a unit of time: say 's', 'ms', 'us' or 'ns' by `time_unit=`; "
        f"the file says {declared!r}",
        f"`{name}`",
    )


def _begin(path: Path, name: str, column: Column, unit: str) -> float:
    """The least time, s."""
    seconds = _seconds(column.values, unit, 0)
    begin = float(np.nanmin(seconds)) if np.any(np.isfinite(seconds)) else math.nan
    if not abs(begin) < LATEST:
        words = f"must begin within {LATEST:.0e} s, but begins at {begin:.4g} s: check the unit"
        raise LogError(path, words, f"`{name}`")
    return begin


def _seconds(
    values: Shaped[np.ndarray, "..."], unit: str, zero: int
) -> Float[np.ndarray, " samples"]:
    """Times since the zero, s, from whole numbers where the file has these."""
    per_second, values = TICKS[unit], values.ravel()
    if values.dtype.kind == "f":
        return (values.astype(float) - zero * per_second) / per_second
    seconds = (values.astype(np.int64) - zero * per_second) / per_second
    if values.dtype.kind in DATES:
        seconds[np.isnat(values)] = np.nan
    return seconds


def _samples(
    name: str, values: Shaped[np.ndarray, "..."], count: int, assumed: list[str]
) -> Float[np.ndarray, "samples *components"] | None:
    """The samples along the first axis; None if there are not as many as times."""
    if values.dtype.kind not in NUMBERS or not 1 <= values.ndim <= 3 or not values.size:
        return None
    if values.shape[0] != count:
        if values.shape[-1] != count:
            return None
        values = np.moveaxis(values, -1, 0)
        if values.size > count:
            assumed.append(f"`{name}` has its samples along the last axis.")
    elif values.shape[1:] and values.shape[-1] == count > 1:
        assumed.append(f"`{name}`, whose axes are alike, is taken with samples along the first.")
    if values.ndim == 3 and min(values.shape[1:]) > 1:
        assumed.append(f"The matrices of `{name}` are signals of their elements, row by row.")
    samples = values.reshape(count, -1).astype(float)
    if samples.shape[1] > MOST_COMPONENTS:
        return None
    return samples if samples.shape[1] > 1 else samples[:, 0]


def read(path: Path, time: TimeNames | None = None, time_unit: TimeUnit | None = None) -> Log:
    """Read a Parquet file: a signal for each column of numbers, or of lists of one length.

    Parameters
    ----------
    path
        The file.
    time
        The column of times, or such columns for others, as `{"gyro_x": "t_gyro"}`. By default it
        is recognised by its name, such as `t`, `time`, `timestamp`, `time_s` or `timestamp_ns`, or
        as the only column of dates.
    time_unit
        The unit of the times, `"s"`, `"ms"`, `"us"` or `"ns"`. By default it is that of the file
        or in the name of the column.

    Returns
    -------
    Log
        Units and axes are those in the metadata of the columns, `unit` or `units`, and `frame`, or
        units in brackets in their names, such as `gyro_x (deg/s)`. Empty cells and lists are NaN.

    Raises
    ------
    LogError
        If the file cannot be read, or times are not recognised.
    ImportError
        Without the package pyarrow.

    References
    ----------
    The format: <https://parquet.apache.org/docs/file-format/>.
    """
    try:
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError('Parquet files need pyarrow: pip install "lgvi[logs]"') from error

    with foreign_reader(path, KIND), parquet.ParquetFile(path) as file:
        columns, left_out = _columns(path, file)
    assumed = [f"Columns of other values were left out: {', '.join(left_out)}."] if left_out else []
    return make_log(path, KIND, columns, time, time_unit, {}, assumed)


def _columns(path: Path, file: Any) -> tuple[dict[str, Column], list[str]]:
    """The columns of numbers and dates, and the names of the others."""
    from pyarrow import types

    def may_hold_numbers(kind: Any) -> bool:
        if types.is_struct(kind):
            return any(may_hold_numbers(field.type) for field in kind)
        return _is_number(kind) or _is_date(kind) or _is_list_of_numbers(kind)

    metadata, schema = file.metadata, file.schema_arrow
    names = [column.name for column in schema if may_hold_numbers(column.type)]
    cells = metadata.num_rows * metadata.num_columns
    columns = range(metadata.num_columns)
    if lists := [i for i in columns if file.schema.column(i).max_repetition_level]:
        file.scan_contents(lists)  # what is damaged must not reach `column`, which would abort
        groups = map(metadata.row_group, range(metadata.num_row_groups))
        cells += sum(group.column(i).num_values for group in groups for i in lists)
    require_size(path, 8 * cells)
    table = file.read(names, use_threads=False).flatten()
    while any(types.is_struct(column.type) for column in table.schema):
        table = table.flatten()
    arrays = {column.name: _column(table[column.name], column) for column in table.schema}
    left_out = [name for name in schema.names if name not in names]
    left_out += [name for name, column in arrays.items() if column is None]
    return {name: column for name, column in arrays.items() if column is not None}, left_out


def _is_number(kind: Any) -> bool:
    from pyarrow import types

    is_of = types.is_floating, types.is_integer, types.is_boolean, types.is_decimal
    return any(is_it(kind) for is_it in is_of)


def _is_list_of_numbers(kind: Any) -> bool:
    from pyarrow import types

    is_list = types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)
    return is_list and _is_number(kind.value_type)


def _is_date(kind: Any) -> bool:
    from pyarrow import types

    return types.is_timestamp(kind) or types.is_duration(kind)


def _column(cells: Any, described: Any) -> Column | None:
    """A column; None if it is not of numbers, dates or lists of numbers of one length."""
    from pyarrow.compute import call_function

    kind = described.type
    if _is_date(kind):
        return Column(cells.to_numpy(), "UTC" if getattr(kind, "tz", None) else "")
    words = described.metadata or {}
    words = {key.decode(errors="replace"): x.decode(errors="replace") for key, x in words.items()}
    in_name = IN_BRACKETS.fullmatch(described.name)
    unit = words.get("unit") or words.get("units") or (in_name[1] if in_name else "")
    if _is_number(kind):
        return Column(_numbers(cells), unit, words.get("frame", ""))
    if not _is_list_of_numbers(kind):
        return None
    lengths = call_function("list_value_length", [cells]).drop_null().unique().to_pylist()
    if len(lengths) != 1 or not lengths[0]:
        return None
    values = np.full((len(cells), lengths[0]), np.nan)
    numbers = _numbers(call_function("list_flatten", [cells]))
    values[cells.is_valid().to_numpy()] = numbers.reshape(-1, lengths[0])
    return Column(values, unit, words.get("frame", ""))


def _numbers(cells: Any) -> Shaped[np.ndarray, " cells"]:
    """Cells as numbers; NaN where there is none."""
    from pyarrow import types

    if types.is_boolean(cells.type) or types.is_decimal(cells.type):
        cells = cells.cast("float64")
    return cells.to_numpy()


def require_size(path: Path, size: int) -> None:
    """Refuse arrays that would fill the memory, as the size that a file declares may be wrong.

    Raises
    ------
    LogError
        If they are larger than 2 GiB.
    """
    if size > MOST_BYTES:
        words = f"must have arrays of less than {MOST_BYTES:.2g} bytes in all, but has {size:.2g}"
        raise LogError(path, words)
