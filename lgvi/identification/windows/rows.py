"""The windows of a level without padding, cut out of recordings when they are needed."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from ..data.formats import INPUTS
from ..data.recordings import Recordings
from .grid import UnpaddedWindow, Window, cut_window

KEPT = 2_000_000  # steps of the windows of a level that stay in memory


class Rows(NamedTuple):
    """Windows that are not padded."""

    sizes: np.ndarray  # (windows, 1+channels), numbers of steps, and of readings of each channel
    channels: tuple[str, ...]
    inputs: tuple[str, ...]  # of torques and rotor momenta, those that are recorded
    cut: Callable[[int], UnpaddedWindow]  # a window by its number

    @classmethod
    def of(cls, windows: Sequence[UnpaddedWindow]) -> "Rows":
        """Windows that stay in memory."""
        sizes = np.array([window.size for window in windows])
        channels, inputs = tuple(windows[0].readings), tuple(windows[0].inputs)
        return cls(sizes, channels, inputs, list(windows).__getitem__)

    def only(self, some: np.ndarray) -> "Rows":
        """Some of the windows, by their numbers."""
        return self._replace(sizes=self.sizes[some], cut=partial(_cut_of_some, self.cut, some))


def _cut_of_some(
    cut: Callable[[int], UnpaddedWindow], some: np.ndarray, number: int
) -> UnpaddedWindow:
    return cut(int(some[number]))


def _cut_again(
    recordings: Recordings, windows: Sequence[Window], longest_step: np.ndarray, number: int
) -> UnpaddedWindow:
    window = windows[number]
    trajectory = window.trajectory
    return cut_window(recordings.of(trajectory), window, longest_step[trajectory])


def cut_levels(
    recordings: Recordings, levels: Sequence[Sequence[Window]], longest_step: np.ndarray
) -> list[Rows]:
    """The windows of each level, with no step longer than that of their trajectory.

    The windows of a level that has many steps do not stay in memory; they are cut again. So each
    trajectory is looked at once, for all levels.
    """
    where: list[list[list[int]]] = [[[] for _ in recordings.names] for _ in levels]
    for windows, of_level in zip(levels, where, strict=True):
        for number, window in enumerate(windows):
            of_level[window.trajectory].append(number)
    counts = 1 + len(recordings.channels)
    sizes = [np.zeros((len(windows), counts), int) for windows in levels]
    kept: list[dict[int, UnpaddedWindow] | None] = [{} for _ in levels]
    steps = np.zeros(len(levels), int)
    for trajectory, samples in enumerate(recordings):
        for level, windows in enumerate(levels):
            for number in where[level][trajectory]:
                cut = cut_window(samples, windows[number], longest_step[trajectory])
                sizes[level][number] = cut.size
                steps[level] += cut.size[0]
                if (of_level := kept[level]) is not None:
                    # A view of what was read from a file would keep all of that.
                    of_level[number] = cut.copied() if recordings.are_stored else cut
            if steps[level] > KEPT:
                kept[level] = None
    channels = tuple(recordings.channels)
    inputs = tuple(name for name in INPUTS if name in recordings.quantities)
    return [
        Rows(
            of_level,
            channels,
            inputs,
            partial(_cut_again, recordings, windows, longest_step)
            if in_memory is None
            else in_memory.__getitem__,
        )
        for of_level, windows, in_memory in zip(sizes, levels, kept, strict=True)
    ]
