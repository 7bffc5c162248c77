"""A signal of a log, and what is wrong with a log."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike

import numpy as np
from jaxtyping import Float

MOST_NAMED = 40  # names in a message


class LogError(ValueError):
    """A log that cannot be read, in words.

    Parameters
    ----------
    path
        The file.
    words
        What is wrong, and what it must be.
    place
        Where in the file, such as "line 12, column `gyro_x`", "byte 1024" or "signal `gyro`".
    """

    def __init__(self, path: str | PathLike[str], words: str, place: str = ""):
        super().__init__(f"{path}{', ' if place else ''}{place}: {words}")
        self.path, self.words, self.place = path, words, place

    def __reduce__(self):
        return type(self), (self.path, self.words, self.place)


def list_names(names: Iterable[str]) -> str:
    """The first of some names, for a message."""
    every = list(names)
    more = ", ..." if len(every) > MOST_NAMED else ""
    return ", ".join(every[:MOST_NAMED]) + more


@contextmanager
def foreign_reader(path: str | PathLike[str], kind: str) -> Iterator[None]:
    """Turn what a package raises for a damaged file, which may be anything, into a `LogError`."""
    try:
        yield
    except LogError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.filename is not None:  # no file, or no permission
            raise
        words = " ".join(str(error).split())[:200] or type(error).__name__
        raise LogError(path, f"cannot be read as {kind}: {words}") from error


@dataclass(frozen=True)
class Signal:
    """Samples of one quantity, as they are in the file.

    Attributes
    ----------
    name
        Name, as in the file or by its documentation.
    times
        Times (samples,), s, since the zero of the log. They are as in the file: they may repeat
        or go back.
    values
        Values (samples,) or (samples, components). NaN is no reading.
    unit
        Unit of the values, `"1"` for pure numbers; empty if the file does not tell.
    frame
        The axes of the body: `"FLU"` (forward, left, up), `"FRD"` (forward, right, down), or
        another name; empty if the file does not tell.
    space
        For attitudes and positions, the axes of space: `"NED"`, `"ENU"`, or another name.
    clock
        The clock of the times; signals of one clock can be compared.
    quantity
        What the signal is by the documentation of the format, as a quantity of
        [`Recordings`][lgvi.identification.Recordings], such as `"angular_velocity"`; empty if it
        is none of these, or the file does not tell.
    components
        Names of the components.
    order
        For attitudes: `"wxyz"`, `"xyzw"`, `"rotation_vector"` or angles such as `"ZYX"`, as for
        `Recordings.from_csv`; empty if the file does not tell.
    direction
        For attitudes: `"body to space"` or `"space to body"`; empty if the file does not tell.
    limit
        The largest absolute value that the sensor can read, in `unit`; NaN if not known.
    """

    name: str
    times: Float[np.ndarray, " samples"]
    values: Float[np.ndarray, "samples *components"]
    unit: str = ""
    frame: str = ""
    space: str = ""
    clock: str = "log"
    quantity: str = ""
    components: tuple[str, ...] = ()
    order: str = ""
    direction: str = ""
    limit: float = float("nan")

    def __len__(self) -> int:
        return len(self.times)
