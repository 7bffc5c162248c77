"""From short windows to whole trajectories, so that a bad start does not end in a bad minimum.

An error of a rate or of the inertia makes the simulated motion run ahead of the recorded one. Over
a window in which the body turns a radian it cannot get lost; each fit gives the states with which
windows of eight times the length begin.
"""

import numpy as np

from .recordings import Recordings
from .samples import SENSED
from .windows import FEWEST, TURN, Window

GROWTH = 8
MOST = 2000  # windows, unless there are more trajectories


def levels(recordings: Recordings, speeds: np.ndarray) -> list[list[Window]]:
    """Windows of each level; those of the last are the trajectories."""
    times = [
        np.unique(np.concatenate([each[0] for each in map(samples.get, SENSED) if each]))
        for samples in recordings
    ]
    shortest, count = [], []
    for t, speed in zip(times, speeds, strict=True):
        sample = np.median(np.diff(t)) if len(t) > 1 else 1.0
        shortest.append(max(TURN / max(speed, 1e-300), FEWEST * sample))
        pieces = (t[-1] - t[0]) / shortest[-1]
        count.append(0 if pieces <= 2 else int(np.ceil(np.log(pieces) / np.log(GROWTH))))
    apart = 0  # windows begin at multiples of GROWTH**apart shortest ones, or of their own length
    while sum(GROWTH ** max(n - apart, 0) for n in count) > max(MOST, len(times)) and apart < max(
        count
    ):
        apart += 1
    found = []
    for level in range(max(count) + 1):
        windows = []
        for i, (t, length, last) in enumerate(zip(times, shortest, count, strict=True)):
            if level >= last:
                windows.append(Window(i, t[0], t[-1]))
                continue
            stride = GROWTH ** max(level, min(apart, last))
            for k in range(0, GROWTH**last, stride):
                begin = t[0] + k * length
                end = begin + GROWTH**level * length
                first, enough = np.searchsorted(t, [begin, begin + length])
                if k == 0 or enough - first >= FEWEST // 2:
                    windows.append(Window(i, begin, min(end, t[-1])))
        found.append(windows)
    return found


def starts_within(before: list[Window], after: list[Window]) -> np.ndarray:
    """For each window the one before that begins with it."""
    place = {(window.trajectory, window.begin): i for i, window in enumerate(before)}
    return np.array([place[window.trajectory, window.begin] for window in after])
