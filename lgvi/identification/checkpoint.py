"""A long fit in a file, from which it goes on after it was stopped or killed."""

import os
import re
import zipfile
from collections.abc import Iterator, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .least_squares.levenberg_marquardt import Point
from .model.configuration import Configuration
from .model.free import Free
from .model.states import InitialStates


class Checkpoint:
    """Where each minimisation of a fit began its last iteration, kept in a file.

    A fit that is begun again makes the same minimisations in the same order. Each goes on from
    where its last iteration began, so that those that were done end at once.

    Parameters
    ----------
    file
        The file. It is written anew in each iteration, and read here if there is one.
    fit
        What tells the fit from others; see `name_fit`.

    Raises
    ------
    ValueError, TypeError
        If the file is of another fit, or of none, or its folder does not exist.
    """

    def __init__(self, file: str | os.PathLike[str], fit: str):
        if not isinstance(file, (str, os.PathLike)):
            raise TypeError(f"Argument `checkpoint` must be the path of a file, but is {file!r}.")
        self._file, self._fit = Path(file), fit
        self._points: dict[int, Point] = {}
        self._number = -1
        if not self._file.parent.is_dir():
            raise ValueError(
                f"Argument `checkpoint` must be a file in a folder that exists, but is {file!r}."
            )
        if self._file.exists():
            self._read()

    def begin(self, start: Point) -> Point:
        """Where the next minimisation begins: where it was, or at its start."""
        self._number += 1
        return self._points.get(self._number, start)

    def keep(self, point: Point) -> None:
        """Write where an iteration of the minimisation begins."""
        self._points[self._number] = point
        arrays = {"fit": np.array(self._fit)}
        for number, each in self._points.items():
            for name, value in _as_arrays(each).items():
                arrays[f"{number}/{name}"] = value
        # Whole at any time: a fit may be killed while it writes.
        unfinished = self._file.with_name(f"{self._file.name}.unfinished")
        with unfinished.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **arrays)
            stream.flush()
            os.fsync(stream.fileno())
        unfinished.replace(self._file)

    def _read(self) -> None:
        try:
            with zipfile.ZipFile(self._file), np.load(self._file) as arrays:
                found = dict(arrays)
            fit = str(found.pop("fit"))
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"Argument `checkpoint` must be a file that a fit wrote, but {self._file} is not."
            ) from error
        if fit != self._fit:
            raise ValueError(
                f"Argument `checkpoint` must be a file of the same fit, but {self._file} is of one "
                "with another model, other recordings, other options or another precision: remove "
                "it to begin anew, or take another file."
            )
        for number in {int(name.partition("/")[0]) for name in found}:
            start = f"{number}/"
            of = {
                name.removeprefix(start): x for name, x in found.items() if name.startswith(start)
            }
            states = InitialStates(of.pop("R"), of.pop("omega"), of.pop("own", None))
            rest = {name: value[()] for name, value in of.items()}
            self._points[number] = Point(states=states, **rest)


def _as_arrays(point: Point) -> dict[str, np.ndarray]:
    states, rest = point.states, point._asdict()
    del rest["states"]
    given = {"R": states.R, "omega": states.omega, "own": states.own, **rest}
    return {name: np.asarray(value) for name, value in given.items() if value is not None}


def name_fit(configurations: Sequence[Configuration], free: Free, *others: Any) -> str:
    """What tells a fit from others: all that is given, and what was recorded.

    Of the readings those of the first and the last trajectory alone, as there may be many. Of
    functions the name alone, as that is all of a function that another process can tell.
    """
    digest = sha256()
    for part in _parts(configurations, free, others):
        digest.update(part)
        digest.update(b"|")
    return digest.hexdigest()


def _parts(configurations: Sequence[Configuration], free: Free, others: Any) -> Iterator[bytes]:
    for each in configurations:
        yield repr((each.name, each.recordings.names)).encode()
        for quantity, samples in each.recordings.quantities.items():
            yield quantity.encode()
            yield samples.count.tobytes()
            for trajectory in (0, len(samples.count) - 1):
                for values in samples.of(trajectory):
                    yield values.tobytes()
    chosen = [(each.model, each.selected, each.own) for each in configurations]
    given = chosen, free._asdict(), others
    # What is no array, such as the order of an integrator, without the addresses of objects.
    text = eqx.tree_pformat(given, short_arrays=True)
    yield re.sub(r"0x[0-9a-f]+", "", text).encode()
    for leaf in jax.tree.leaves(eqx.filter(given, eqx.is_array)):
        yield np.asarray(leaf).tobytes()
