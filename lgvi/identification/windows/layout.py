"""Windows of about equal length side by side, in few shapes."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from ..data.recordings import Recordings
from .grid import Window
from .group import SMALL, Group
from .rows import Rows, cut_levels

OfReadings = dict[str, np.ndarray]  # something of each reading (readings, ...), by channel

FEW = 10_000  # steps with the padding, which take less time than optimising their program


class Layout(NamedTuple):
    """The windows of a level, in groups of about equal length side by side."""

    groups: tuple[Group, ...]
    position: np.ndarray | None  # number of windows that each continues; None if none does
    few: bool  # whether compiling takes longer than the few steps

    @property
    def joined(self) -> Bool[np.ndarray, " windows"] | None:
        """Whether the next window continues a window."""
        return None if self.position is None else np.roll(self.position, -1) > 0

    @property
    def number(self) -> int:
        """Number of windows."""
        return sum(map(len, self.groups))

    @property
    def steps(self) -> int:
        """Number of steps of all windows, with the padding."""
        return sum(len(group) * group.steps for group in self.groups)

    def count_readings(self, channel: str) -> np.ndarray:
        """Number of readings of each window (windows,)."""
        counts = np.zeros(self.number, int)
        for group in self.groups:
            counts[group.index] = group.counts(channel)
        return counts

    def in_order(
        self, padded: Sequence[Mapping[str, np.ndarray]], channels: Sequence[str]
    ) -> OfReadings:
        """Something of each reading of each group, with padding, in the order of the windows."""
        found = {}
        for channel in channels:
            count = self.count_readings(channel)
            first = np.cumsum(count) - count
            values = [np.asarray(each[channel]) for each in padded]
            found[channel] = np.zeros((count.sum(), *values[0].shape[2:]))
            for group, value in zip(self.groups, values, strict=True):
                number = np.arange(value.shape[1])
                mask = number < count[group.index, None]
                found[channel][(first[group.index, None] + number)[mask]] = value[mask]
        return found

    def only(self, some: np.ndarray) -> "Layout":
        """Some of the windows, whose numbers increase, in the same shapes."""
        groups = (group.only(some) for group in self.groups)
        position = None if self.position is None else self.position[some]
        return Layout(tuple(group for group in groups if len(group)), position, self.few)

    def halve_steps(self) -> "Layout":
        """The layout with steps of half the size; in the same shapes if there is room."""
        return self._replace(groups=tuple(group.halve_steps() for group in self.groups))


def lay_out(
    recordings: Recordings, levels: Sequence[Sequence[Window]], longest_step: np.ndarray
) -> list[Layout]:
    """Windows side by side for each level, with no step longer than that of their trajectory.

    Shapes are rounded up, and consecutive levels get one shape while that is not too large, so
    that one compiled program serves many: steps and readings are padded. That of the last ones has
    room for halved steps, if it is not too large then. Where the padding would be too large,
    windows of different lengths are put apart.
    """
    fillers = {
        channel: samples.of(int(np.argmax(samples.count > 0)))[1][0]
        for channel, samples in recordings.channels.items()
        if samples.count.any()
    }
    rows = cut_levels(recordings, levels, longest_step)
    groups: list[list[Rows]] = []
    for of_level in rows:
        if groups and _steps([*groups[-1], of_level]) <= SMALL:
            groups[-1].append(of_level)
        else:
            groups.append([of_level])
    layouts: list[Layout] = []
    for group in groups:
        size, few = _size(_all(group)), _steps(group) <= FEW
        if group is groups[-1]:
            with_room = _size(_all(group), refinable=True)
            most = max(len(of_level.sizes) for of_level in group)
            size = with_room if most * with_room[0] <= SMALL else size
        for of_level in group:
            sizes = of_level.sizes
            alike = [np.arange(len(sizes))] if _steps(group) <= SMALL else _alike(sizes[:, 0])
            parts = []
            for index in alike:
                of_some = size if len(alike) == 1 else _size([sizes[index]])
                most = int(np.max(sizes[index, 0]))
                parts.append(Group(index, of_level, len(index), most, of_some, fillers))
            layouts.append(Layout(tuple(parts), _position(levels[len(layouts)]), few))
    return layouts


def _position(windows: Sequence[Window]) -> np.ndarray | None:
    """Number of windows that each window continues, one after another."""
    if not any(window.joined for window in windows):
        return None
    position = np.zeros(len(windows), int)
    for i, window in enumerate(windows[:-1]):
        position[i + 1] = position[i] + 1 if window.joined else 0
    return position


def _all(levels: Sequence[Rows]) -> list[np.ndarray]:
    """The sizes of all windows of each level."""
    return [of_level.sizes for of_level in levels]


def _steps(levels: Sequence[Rows]) -> int:
    """Largest number of steps of a level, with the padding."""
    return max(len(of_level.sizes) for of_level in levels) * _size(_all(levels))[0]


def _alike(steps: np.ndarray) -> list[np.ndarray]:
    """Groups of windows, by index, whose numbers of steps differ by a factor of four at most."""
    shorter = (np.log(np.max(steps) / np.maximum(steps, 1)) / np.log(4)).astype(int)
    return [np.flatnonzero(shorter == each) for each in np.unique(shorter)]


def _size(levels: Sequence[np.ndarray], refinable: bool = False) -> list[int]:
    """Numbers of steps, and of readings of each channel, with room for all levels.

    `levels` are the sizes (windows, 1+channels) of the windows of each. If `refinable`, with room
    for the last level after its steps are halved.
    """
    sizes = np.stack([np.max(of_level, axis=0) for of_level in levels])
    if refinable:
        sizes[-1, 0] *= 2
    return [_rounded_up(int(size)) for size in np.max(sizes, axis=0)]


def _rounded_up(size: int) -> int:
    """To a multiple of a power of two, by a quarter at most."""
    unit = 2 ** max(0, size.bit_length() - 3)
    return -(-size // unit) * unit
