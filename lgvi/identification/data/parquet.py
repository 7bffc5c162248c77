"""Trajectories in Parquet files, one per file, which are read when needed."""

from collections.abc import Iterator, Mapping
from os import PathLike
from pathlib import Path

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .samples import AbstractSamples, OfTrajectory
from .table import (
    CellError,
    Cells,
    Columns,
    Table,
    Timing,
    make_table,
    require_counts,
    require_timing,
)


class Folder:
    """The trajectories in the Parquet files of a folder; the last trajectory read stays in memory.

    Raises
    ------
    ValueError, TypeError
        If the folder has no files, or the columns do not fit the quantities.
    """

    def __init__(self, folder: str | PathLike[str], columns: Mapping[str, Columns], timing: Timing):
        require_counts(columns)
        require_timing(timing)
        if not isinstance(folder, (str, PathLike)):
            raise TypeError(f"Argument `folder` must be the path of a folder, but is {folder!r}.")
        paths = sorted(Path(folder).absolute().glob("*.parquet"))
        self.files = [path for path in paths if path.is_file() and path.name[0] != "."]
        if not self.files:
            raise ValueError(
                "Argument `folder` must be a folder with a file `*.parquet` for each trajectory, "
                f"but is {str(folder)!r}."
            )
        self._columns, self._timing = columns, timing
        self._last: tuple[int, OfTrajectory] | None = None
        self._versions = list(map(_version, self.files))

    def read(self, file: int) -> OfTrajectory:
        """The samples of a trajectory, by quantity.

        Raises
        ------
        ValueError
            For a malformed file; the message names the row and the column.
        """
        if self._last is None or self._last[0] != file:
            (samples,) = self.read_table(file).trajectories.values()
            for arrays in samples.values():
                for array in arrays:
                    array.setflags(write=False)
            self._last = file, samples
        return self._last[1]

    def read_table(self, file: int) -> Table:
        """The samples of a trajectory, by quantity, and the numbers of changed samples."""
        path = self.files[file]
        if _version(path) != self._versions[file]:
            raise ValueError(f"{path} has changed since its folder was opened: open it again.")
        try:
            return make_table(_read_cells(path, self._names()), self._columns, self._timing)
        except CellError as error:
            row = "" if error.line is None else f", row {error.line}"
            column = "" if error.column is None else f", column `{error.column}`"
            raise ValueError(f"{path}{row}{column}: {error.words}") from None

    def _names(self) -> list[str]:
        names = (str(name) for group in self._columns.values() for name in group.names)
        return list(dict.fromkeys([str(self._timing.t), *names]))


def _version(path: Path) -> tuple[int, int]:
    """The size of a file and the time of the last change."""
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def _read_cells(path: Path, names: list[str]) -> Cells:
    import pyarrow
    from pyarrow import parquet

    try:
        with parquet.ParquetFile(path) as file:
            header = file.schema_arrow.names
            for name in names:
                if (times := header.count(name)) != 1:
                    words = "is missing" if times == 0 else f"occurs {times} times"
                    words += f"; the file has the columns {', '.join(header)}"
                    raise CellError(None, name, words)
            table = file.read(names, use_threads=False)
    except (FileNotFoundError, PermissionError):  # errors that name the file
        raise
    except (pyarrow.ArrowException, OSError) as error:
        words = f"must be a Parquet file, but cannot be read as one: {error}"
        raise CellError(None, None, words) from None
    numbers, empty = {}, {}
    for name in names:
        column = table[name]
        if not (pyarrow.types.is_floating(column.type) or pyarrow.types.is_integer(column.type)):
            words = f"must hold numbers, but holds {column.type}"
            if pyarrow.types.is_temporal(column.type):
                words += ": take seconds since the start"
            raise CellError(None, name, words)
        empty[name] = column.is_null().to_numpy()
        numbers[name] = column.to_numpy().astype(float)
    if not len(table):
        raise CellError(None, None, "there is no sample")
    rows = np.arange(len(table))
    return Cells(rows, numbers, empty, (path.stem,), np.zeros(len(table), int))


class StoredSamples(AbstractSamples, eqx.Module):
    """Samples of one quantity in files, which are read on each access.

    `times` and `values` read all files.

    Attributes
    ----------
    count
        Number of samples of each trajectory (trajectories,).
    files
        The number of each trajectory's file in the folder (trajectories,).
    """

    count: Int[np.ndarray, " trajectories"]
    files: Int[np.ndarray, " trajectories"]
    folder: Folder = eqx.field(static=True)
    quantity: str = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one value."""
        return self.of(0)[1].shape[1:]

    @property
    def times(  # pyright: ignore[reportIncompatibleVariableOverride]
        self,
    ) -> Float[np.ndarray, " samples"]:
        """Times (samples,), s, of all trajectories one after another."""
        return np.concatenate([t for t, _ in self])

    @property
    def values(  # pyright: ignore[reportIncompatibleVariableOverride]
        self,
    ) -> Float[np.ndarray, "samples *shape"]:
        """Values (samples, ...) of all trajectories one after another."""
        return np.concatenate([values for _, values in self])

    def of(self, trajectory: int) -> tuple[np.ndarray, np.ndarray]:
        """Times (samples,) and values (samples, ...) of a trajectory."""
        return self.folder.read(int(self.files[trajectory]))[self.quantity]

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Times and values of each trajectory."""
        return (self.of(i) for i in range(len(self.count)))

    def only(self, trajectories: np.ndarray) -> "StoredSamples":
        """The samples of some trajectories, by their numbers."""
        count, files = self.count[trajectories], self.files[trajectories]
        return StoredSamples(count, files, self.folder, self.quantity)
