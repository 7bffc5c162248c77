"""Residuals at a minimum, and what sensors read without noise, simulated when asked for."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from .data.recordings import Recordings
from .least_squares.window_qr import OfReadings
from .model.states import InitialStates
from .problem import FitProblem
from .windows.layout import Layout
from .windows.level import Level

AT_ONCE = 2_000_000  # steps of windows of which something of each reading is in memory
OfReading = dict[str, np.ndarray]  # (readings, ...) by channel


class Simulated:
    """The minimum of some windows. Of many readings too much would have to be kept."""

    def __init__(
        self,
        problem: FitProblem,
        level: Level,
        theta: np.ndarray,
        states: InitialStates,
        width: np.ndarray | None,
    ):
        """At `theta` and the `states` of the windows, with gaps between segments of some width."""
        self._problem, self._level = problem, level
        self._theta, self._states, self._width = theta, states, width
        self._all: dict[OfReadings, list[OfReading]] = {}

    def of_configuration(self, number: int, which: OfReadings) -> OfReading:
        """Something of all readings of a configuration, in their order."""
        parts = [found for _, found in self.in_parts(number, which)]
        if len(parts) == 1:
            return parts[0]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def in_parts(self, number: int, which: OfReadings) -> Iterator[tuple[Recordings, OfReading]]:
        """The same of some trajectories after others, with the recordings of these."""
        problem, level = self._problem, self._level
        configuration = problem.configurations[number]
        if self._are_few:
            yield configuration.recordings, self._at_once(which)[number]
            return
        alone = replace(problem, configurations=[configuration], methods=[problem.methods[number]])
        layout, first = level.layouts[number], level.parts[number].start
        trajectory = np.array([window.trajectory for window in level.windows[number]])
        parts = -(-_count_steps(layout) // AT_ONCE)
        for some in np.array_split(np.unique(trajectory), parts):
            if not len(some):
                continue
            windows = np.flatnonzero(np.isin(trajectory, some))
            part = Level((level.windows[number][windows[0] : windows[-1] + 1],), ())
            part = part._replace(layouts=(layout.only(windows),))
            point = part, self._theta, self._states.at(first + windows), self._width
            found = alone.linearise(*point, keep=which).parts[0].readings()
            yield configuration.recordings.only(some), found

    @property
    def _are_few(self) -> bool:
        """Whether something of all readings of all configurations can be kept."""
        return sum(map(_count_steps, self._level.layouts)) <= AT_ONCE

    def _at_once(self, which: OfReadings) -> list[OfReading]:
        """Something of all readings of all configurations, which are few."""
        if which not in self._all:
            point = self._level, self._theta, self._states, self._width
            parts = self._problem.linearise(*point, keep=which).parts
            self._all[which] = [part.readings() for part in parts]
        return self._all[which]


def _count_steps(layout: Layout) -> int:
    """Number of steps of all windows, with the padding."""
    return sum(len(group) * group.steps for group in layout.groups)
