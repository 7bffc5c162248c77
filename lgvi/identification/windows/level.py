"""The windows of all configurations at one stage of a fit."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..model.configuration import Configuration
from ..segments.segment import Chains, Window, lay_out, whole_trajectories
from ..together import Together
from .schedule import cut_into_levels


class Level(NamedTuple):
    """Windows of each configuration, one configuration after another, and how they are laid out."""

    windows: tuple[list[Window], ...]
    layouts: tuple[Chains, ...]

    @property
    def counts(self) -> list[int]:
        """Number of windows of each configuration."""
        return [len(windows) for windows in self.windows]

    @property
    def number(self) -> int:
        """Number of windows."""
        return sum(self.counts)

    @property
    def parts(self) -> list[slice]:
        """The place of the windows of each configuration among all."""
        ends = np.cumsum(self.counts)
        return [slice(end - count, end) for end, count in zip(ends, self.counts, strict=True)]

    @property
    def keys(self) -> list[tuple[int, Window]]:
        """The configuration, and the window of it, of each window."""
        return [(k, window) for k, windows in enumerate(self.windows) for window in windows]

    def starts_within(self, before: "Level") -> np.ndarray:
        """For each window the index of the window of a level before with the same beginning."""
        place = {(k, w.trajectory, w.begin): i for i, (k, w) in enumerate(before.keys)}
        return np.array([place[k, w.trajectory, w.begin] for k, w in self.keys])

    @property
    def is_joined(self) -> bool:
        """Whether a window continues another one."""
        return any(np.any(layout.joined) for layout in self.layouts)

    @property
    def steps(self) -> int:
        """Number of steps of all windows."""
        return sum(int(np.sum(layout.steps)) for layout in self.layouts)

    def some(self, every: int) -> tuple["Level", np.ndarray]:
        """Every so many trajectories of each configuration, and the numbers of their windows."""
        windows, layouts, numbers = [], [], []
        for of_part, layout, part in zip(self.windows, self.layouts, self.parts, strict=True):
            chosen = [i for i, window in enumerate(of_part) if window.trajectory % every == 0]
            windows.append([of_part[i] for i in chosen])
            layouts.append(layout.only(np.array(chosen)))
            numbers.append(part.start + np.array(chosen))
        return Level(tuple(windows), tuple(layouts)), np.concatenate(numbers)

    def refined(self) -> "Level":
        """With steps of half the size."""
        return self._replace(layouts=tuple(layout.halve_steps() for layout in self.layouts))

    def laid_out_again(
        self, configurations: Sequence[Configuration], longest_steps: Sequence[np.ndarray]
    ) -> "Level":
        """The same windows with other steps."""
        layouts = [
            lay_out(each.recordings, [windows], longest_step, each.model)[0]
            for each, windows, longest_step in zip(
                configurations, self.windows, longest_steps, strict=True
            )
        ]
        return Level(self.windows, tuple(layouts))


def whole_level(
    configurations: Sequence[Configuration], longest_steps: Sequence[np.ndarray]
) -> Level:
    """A window for each trajectory."""
    windows = tuple(whole_trajectories(each.recordings) for each in configurations)
    return Level(windows, ()).laid_out_again(configurations, longest_steps)


def make_levels(
    configurations: Sequence[Configuration],
    speeds: Sequence[np.ndarray],
    segment: float | None,
    longest_steps: Sequence[np.ndarray],
    together: Together,
) -> list[Level]:
    """From short windows to whole trajectories, for all configurations and processes at once."""
    cut = [
        cut_into_levels(each.recordings, speed, segment, together.number)
        for each, speed in zip(configurations, speeds, strict=True)
    ]
    most = int(together.largest(max(map(len, cut))))
    windows = [levels + levels[-1:] * (most - len(levels)) for levels in cut]
    layouts = [
        lay_out(each.recordings, levels, longest_step, each.model)
        for each, levels, longest_step in zip(configurations, windows, longest_steps, strict=True)
    ]
    each_level = zip(*windows, strict=True), zip(*layouts, strict=True)
    return [Level(of_level, laid_out) for of_level, laid_out in zip(*each_level, strict=True)]
