"""A long fit in a file, from which it goes on after it was stopped or killed."""

import os
import re
import zipfile
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ... import __version__
from ..model.configuration import Configuration
from ..model.states import InitialStates
from ..running.processes import SINGLE_PROCESS, ProcessGroup
from .levenberg_marquardt import Point


class Checkpoint:
    """Where each minimisation of a fit began its last iteration, kept in a file.

    A fit that is begun again makes the same minimisations in the same order. Each goes on from
    where its last iteration began, so that those that were done end at once.

    Parameters
    ----------
    file
        The file. It is written anew in each iteration, and read here if there is one.
    fit
        The hash of the fit, of `name_fit`.
    together
        Processes that fit together. Where JAX knows of several processes, each has a file of its
        own, with the number of the process before the ending: `fit.0.npz`, `fit.1.npz`.

    Raises
    ------
    ValueError, TypeError
        If the file is of another fit, or of none, or its folder does not exist.
    """

    def __init__(
        self, file: str | os.PathLike[str], fit: str, processes: ProcessGroup = SINGLE_PROCESS
    ):
        if not isinstance(file, (str, os.PathLike)):
            raise TypeError(f"Argument `checkpoint` must be the path of a file, but is {file!r}.")
        self._file, self._fit, self._together = Path(file), fit, processes
        if jax.process_count() > 1:
            ending = f".{jax.process_index()}{self._file.suffix}"
            self._file = self._file.with_suffix(ending)
        # Of each minimisation the last point; if processes fit together the one before too, as
        # another process may have been killed before it wrote the last.
        self._points: dict[int, list[Point]] = {}
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
        points = self._points.get(self._number, [])
        # As far as all processes have come.
        done = self._together.smallest(max((point.iteration for point in points), default=-1))
        return next((point for point in points if point.iteration == done), start)

    def keep(self, point: Point) -> None:
        """Write where an iteration of the minimisation begins."""
        kept = self._points.get(self._number, []) if self._together.are_several else []
        self._points[self._number] = [*kept[-1:], point]
        arrays: dict[str, Any] = {"fit": np.array(self._fit)}
        for number, points in self._points.items():
            for point in points:
                for name, value in _as_arrays(point).items():
                    arrays[f"{number}/{point.iteration}/{name}"] = value
        # Whole at any time: a fit may be killed while it writes.
        unfinished = self._file.with_name(f"{self._file.name}.unfinished")
        with unfinished.open("wb") as stream:
            np.savez(stream, **arrays)
            stream.flush()
            os.fsync(stream.fileno())
        unfinished.replace(self._file)

    def _read(self) -> None:
        try:
            with zipfile.ZipFile(self._file), np.load(self._file) as arrays:
                entries = dict(arrays)
            fit = str(entries.pop("fit"))
            points: dict[tuple[int, int], dict[str, Any]] = {}
            for name, value in entries.items():
                number, iteration, what = name.split("/")
                points.setdefault((int(number), int(iteration)), {})[what] = value
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"Argument `checkpoint` must be a file that a fit wrote, but {self._file} is not."
            ) from error
        if fit != self._fit:
            raise ValueError(
                f"Argument `checkpoint` must be a file of the same fit, but {self._file} is of one "
                "with another model, other recordings, other options, another precision or another "
                "version of this library: remove it to begin anew, or take another file."
            )
        for (number, _), of in sorted(points.items()):
            states = InitialStates(of.pop("R"), of.pop("omega"), of.pop("own", None))
            rest = {name: value[()] for name, value in of.items()}
            self._points.setdefault(number, []).append(Point(states=states, **rest))


def _as_arrays(point: Point) -> dict[str, np.ndarray]:
    states, rest = point.states, point._asdict()
    del rest["states"]
    values = {"R": states.R, "omega": states.omega, "own": states.own, **rest}
    return {name: np.asarray(value) for name, value in values.items() if value is not None}


def name_fit(configurations: Sequence[Configuration], *arguments: Any) -> str:
    """A hash of all arguments of a fit and of all readings, which recognises its file."""
    digest = sha256(name_arguments(configurations, __version__, *arguments).encode())
    for configuration in configurations:
        digest.update(repr(configuration.recordings.names).encode())
        for trajectory in configuration.recordings:
            for t, values in trajectory.values():
                digest.update(len(t).to_bytes(8, "big"))
                digest.update(t.tobytes())
                digest.update(values.tobytes())
    return digest.hexdigest()


def name_arguments(configurations: Sequence[Configuration], *arguments: Any) -> str:
    """A hash of models and options, without what was recorded.

    Of functions the name alone, as that is all of a function that another process can tell.
    """
    chosen = [
        (
            configuration.name,
            configuration.model,
            configuration.selected,
            configuration.own,
            tuple(configuration.recordings.quantities),
        )
        for configuration in configurations
    ]
    # What is no array, such as the order of an integrator, without the addresses of objects.
    text = eqx.tree_pformat((chosen, arguments), short_arrays=True)
    digest = sha256(re.sub(r"0x[0-9a-f]+", "", text).encode())
    for leaf in jax.tree.leaves(eqx.filter((chosen, arguments), eqx.is_array)):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()
