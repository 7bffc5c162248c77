"""Residuals at a minimum, and what sensors read without noise, simulated when asked for."""

from collections.abc import Iterator

import numpy as np

from .data.recordings import Recordings
from .model.states import InitialStates
from .problem import FitProblem
from .windows.layout import OfReadings
from .windows.level import Level
from .windows.readings import Which, simulate_readings_of

AT_ONCE = 2_000_000  # steps of windows of which something of each reading is in memory


class Simulated:
    """The minimum of some windows, which are simulated again: memory may not hold all readings."""

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
        self._all: dict[Which, list[OfReadings]] = {}

    def of_configuration(self, number: int, which: Which) -> OfReadings:
        """Something of all readings of a configuration, in their order."""
        parts = [found for _, found in self.in_parts(number, which)]
        if len(parts) == 1:
            return parts[0]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def in_parts(self, number: int, which: Which) -> Iterator[tuple[Recordings, OfReadings]]:
        """The same of some trajectories after others, with the recordings of these."""
        problem, level = self._problem, self._level
        configuration, method = problem.configurations[number], problem.methods[number]
        if self._are_kept:
            yield configuration.recordings, self._at_once(which)[number]
            return
        layout, first = level.layouts[number], level.parts[number].start
        at = configuration.at(problem.parameters, problem.free, self._theta)
        trajectory = np.array([window.trajectory for window in level.windows[number]])
        parts = -(-layout.steps // AT_ONCE)
        for some in np.array_split(np.unique(trajectory), parts):
            windows = np.flatnonzero(np.isin(trajectory, some))
            given = self._states.at(first + windows), layout.only(windows), method, which
            if len(some):
                found = simulate_readings_of(at, *given, problem.mesh)
                yield configuration.recordings.only(some), found

    @property
    def _are_kept(self) -> bool:
        """Whether readings are so few that they are kept, and their program is that of the fit."""
        return all(group.is_small for each in self._level.layouts for group in each.groups)

    def _at_once(self, which: Which) -> list[OfReadings]:
        """Something of all readings of all configurations."""
        if which not in self._all:
            point = self._level, self._theta, self._states, self._width
            parts = self._problem.linearise(*point, keep=which).parts
            self._all[which] = [part.readings for part in parts]
        return self._all[which]
