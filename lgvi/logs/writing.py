"""Signals as a table in a CSV or Parquet file."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from .signal import LogError, Signal

MOST_CELLS = 200_000_000  # of a table: more than this is a mistake


def write_table(signals: Sequence[Signal], path: Path, source: str) -> None:
    """Write signals of a source as a table with a row for each time; see `Log.write`."""
    if path.suffix not in (".csv", ".parquet"):
        raise ValueError(f"Argument `path` must end with .csv or .parquet, but is {str(path)!r}.")
    if not signals:
        raise LogError(source, "must have a signal to write, but has none")
    import pyarrow
    from pyarrow import csv, parquet

    times, place = np.unique(
        np.concatenate([signal.times for signal in signals]), return_inverse=True
    )
    columns = [column for signal in signals for column in _columns(signal)]
    if len(times) * len(columns) > MOST_CELLS:
        raise ValueError(
            f"Argument `signals` must name fewer signals, as {len(columns)} columns of "
            f"{len(times)} times are too many for a table."
        )
    table, first = {"t (s)": times}, 0
    for signal in signals:
        if signal.direction == "space to body":
            raise LogError(
                source,
                "must be from body to space, as a table does not tell the direction",
                f"signal `{signal.name}`",
            )
        rows = place[first : first + len(signal)]
        first += len(signal)
        if len(np.unique(rows)) < len(rows):
            raise LogError(
                source,
                "must have one sample for each time, as a row of a table does, but has several",
                f"signal `{signal.name}`",
            )
        for name, values in _columns(signal):
            column = np.full(len(times), np.nan)
            column[rows] = values
            if name in table:
                raise LogError(
                    source, "must have a name of its own in a table", f"signal `{signal.name}`"
                )
            table[name] = column
    arrays = {name: pyarrow.array(column, from_pandas=True) for name, column in table.items()}
    if path.suffix == ".csv":
        csv.write_csv(pyarrow.table(arrays), path)
    else:
        parquet.write_table(pyarrow.table(arrays), path)


def _columns(signal: Signal) -> Iterator[tuple[str, np.ndarray]]:
    """Names with units, and values, of the components."""
    unit = f" ({signal.unit})" if signal.unit else ""
    if signal.values.ndim == 1:
        yield f"{signal.name}{unit}", signal.values
        return
    values = signal.values.reshape(len(signal), -1)
    components = signal.components or tuple(map(str, range(values.shape[1])))
    for component, column in zip(components, values.T, strict=True):
        yield f"{signal.name}.{component}{unit}", column
