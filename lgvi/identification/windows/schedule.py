"""From short windows to whole trajectories, so that a bad start does not end in a bad minimum.

An error of a rate or of the inertia makes the simulated motion run ahead of the recorded motion. In
a window in which the body turns a radian the error stays small; each fit gives the states with
which windows of eight times the length begin. For multiple shooting windows grow up to the
segments.
"""

from typing import NamedTuple

import numpy as np

from ..data.recordings import Recordings
from ..segments.segment import Window

SHORTEST_TURN = 1.5  # rad, in the shortest windows
FEWEST_SAMPLES = 8  # in the shortest windows
GROWTH = 8
LAST_GROWTH = 1.5 * GROWTH  # at most, to the whole trajectory
MOST = 2000  # shortest windows at most whose data are used in a level before the last


class Cuts(NamedTuple):
    """How a trajectory is cut, in units of its shortest window, from its first sample."""

    first: float  # times of its first and last sample, s
    last: float
    unit: float  # s
    pieces: int  # number of shortest windows
    levels: int  # number of levels before that of the whole trajectory
    stride: int  # from segment to segment; the length of the trajectory if there is one segment
    enough: np.ndarray  # (pieces,), whether there are samples enough for a window to begin there

    @property
    def nested(self) -> int:
        """The largest power of GROWTH that divides the beginnings of all later windows."""
        return self.levels if self.stride >= self.pieces else self.levels - 1

    def spacing(self, level: int, sparse: int) -> int:
        """From one beginning to the next; data are left out if `sparse` is above the level."""
        return GROWTH ** max(level, min(sparse, self.nested))

    def pieces_of(self, level: int, sparse: int) -> float:
        """The data of the level, about, in numbers of shortest windows."""
        return self.pieces * GROWTH**level / self.spacing(level, sparse)

    def begins(self, numbers: np.ndarray) -> list[float]:
        """The times of such beginnings, where samples follow."""
        return (self.first + self.unit * numbers[self.enough[numbers]]).tolist()

    def windows_begin(self, level: int, sparse: int) -> list[float]:
        """Where windows of a level before the last begin.

        A last one that is half of the others or less is left out, if no later window begins there:
        it would need a program of its own.
        """
        numbers = np.arange(0, self.pieces, self.spacing(level, sparse))
        size, of_next = GROWTH**level, self.spacing(level + 1, 0)
        short = 2 * (self.pieces - numbers) <= size
        last = level + 1 == self.levels and self.stride >= self.pieces
        later = numbers == 0 if last else numbers % of_next == 0
        return self.begins(numbers[later | ~short])


def cut_into_levels(
    recordings: Recordings, speeds: np.ndarray, segment: float | None = None, processes: int = 1
) -> list[list[Window]]:
    """The windows of each level; in the last level they are the trajectories, or their segments.

    So many processes share the work of the levels before.
    """
    cuts = [
        _cuts(recordings.times_of(each), speed, segment)
        for each, speed in zip(recordings, speeds, strict=True)
    ]
    found, sparse, most = [], 0, max(MOST // processes, len(cuts))
    for level in range(max(cut.levels for cut in cuts) + 1):
        growing = [cut for cut in cuts if level < cut.levels]
        while any(sparse < cut.nested for cut in growing) and most < sum(
            cut.pieces_of(level, sparse) for cut in growing
        ):
            sparse += 1
        windows = []
        for i, cut in enumerate(cuts):
            if level >= cut.levels:
                windows += _segments(i, cut)
                continue
            for begin in cut.windows_begin(level, sparse):
                end = begin + GROWTH**level * cut.unit
                windows.append(Window(i, begin, min(end, cut.last)))
        found.append(windows)
    return found


def _cuts(t: np.ndarray, speed: float, segment: float | None) -> Cuts:
    interval = np.median(np.diff(t)) if len(t) > 1 else 1.0
    unit = max(SHORTEST_TURN / max(speed, 1e-300), FEWEST_SAMPLES * interval)
    duration = t[-1] - t[0]
    pieces = max(1, int(np.ceil(duration / unit)))
    segments = 1
    if segment is not None and pieces > 2:
        segments = min(round(duration / segment), len(t) // FEWEST_SAMPLES)
    if segments <= 1:
        count = 0
        while pieces > (2 if count == 0 else LAST_GROWTH * GROWTH ** (count - 1)):
            count += 1
        return _with_times(t, unit, pieces, count, pieces)
    # Of equal length, and each a whole number of the longest windows before.
    ratio = max(duration / segments / unit, 1)
    grown = int(np.log(ratio) / np.log(GROWTH))
    stride = round(ratio / GROWTH**grown) * GROWTH**grown
    pieces = segments * stride
    return _with_times(t, duration / pieces, pieces, grown + 1, stride)


def _with_times(t: np.ndarray, unit: float, pieces: int, levels: int, stride: int) -> Cuts:
    begins = t[0] + unit * np.arange(pieces)
    ends = np.searchsorted(t, [begins, begins + unit])
    enough = ends[1] - ends[0] >= FEWEST_SAMPLES // 2
    enough[0] = True
    return Cuts(float(t[0]), float(t[-1]), unit, pieces, levels, stride, enough)


def _segments(trajectory: int, cut: Cuts) -> list[Window]:
    """The parts of a trajectory, each joined to the next one."""
    begins = cut.begins(np.arange(0, cut.pieces, cut.stride))
    ends = [*begins[1:], cut.last]
    last = len(begins) - 1
    return [
        Window(trajectory, begin, end, k < last)
        for k, (begin, end) in enumerate(zip(begins, ends, strict=True))
    ]
