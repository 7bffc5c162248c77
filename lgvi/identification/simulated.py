"""Residuals at a minimum, and what sensors read without noise, simulated when asked for."""

from collections.abc import Iterator

import numpy as np

from .data.recordings import Recordings
from .model.states import InitialStates
from .problem import FitProblem
from .segments.chain import Followed, OfReadings, Which, follow
from .windows.level import Level


class Simulated:
    """The minimum of some windows, which are simulated again: memory may not hold all readings."""

    def __init__(self, problem: FitProblem, level: Level, theta: np.ndarray, states: InitialStates):
        """At `theta` and the `states` of the windows."""
        self._problem, self._level, self._theta, self._states = problem, level, theta, states
        self._kept: dict[int, Followed] = {}

    def of_configuration(self, number: int, which: Which) -> OfReadings:
        """Something of all readings of a configuration, in their order."""
        parts = [found for _, found in self.in_parts(number, which)]
        if len(parts) == 1:
            return parts[0]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def in_parts(self, number: int, which: Which) -> Iterator[tuple[Recordings, OfReadings]]:
        """The same of some trajectories after others, with the recordings of these."""
        layout, recordings = (
            self._level.layouts[number],
            self._problem.configurations[number].recordings,
        )
        parts = -(-int(np.sum(layout.steps)) // layout.sizes.at_once)
        if parts <= 1:
            if number not in self._kept:
                self._kept[number] = self._follow(number, np.arange(layout.number))
            yield recordings, getattr(self._kept[number], which)
            return
        trajectory = np.array([window.trajectory for window in layout.windows])
        for some in np.array_split(np.unique(trajectory), parts):
            if len(some):
                windows = np.flatnonzero(np.isin(trajectory, some))
                yield recordings.only(some), getattr(self._follow(number, windows), which)

    def _follow(self, number: int, windows: np.ndarray) -> Followed:
        problem, level = self._problem, self._level
        at = problem.configurations[number].at(problem.parameters, problem.free, self._theta)
        states = self._states.at(level.parts[number].start + windows)
        chains = level.layouts[number].only(windows)
        return follow(at, states, chains, problem.methods[number], problem.mesh)
