"""What readings do not tell of initial states, and what is tried instead."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..model.states import InitialStates

TURNS = 8  # about a vector
# About a vector, over the speed across.
RATES = 0.0, 0.4, -0.4, 0.8, -0.8, 1.5, -1.5, 3.0, -3.0


class Trials(NamedTuple):
    """What is not known of the state of each window."""

    unknown: np.ndarray  # (windows,), whether nothing tells the attitude
    # (windows, 3), a unit vector in the body frame, about which the turn is not known; or zero.
    axis: np.ndarray
    turning: np.ndarray  # (windows, 3), the part of the rate that this turn turns the other way
    turns: np.ndarray  # (windows,), whether readings depend on that turn
    rate: np.ndarray  # (windows,), whether the rate about that vector is not known
    speed: np.ndarray  # (windows,), rad/s
    told: np.ndarray  # (windows,), whether readings tell anything of the trajectory's motion

    @property
    def any(self) -> bool:
        """Whether there is something to try."""
        return bool(np.any(self.unknown) or np.any(self.axis))

    def choose(
        self, costs: Callable[[InitialStates], np.ndarray], states: InitialStates
    ) -> InitialStates:
        """The states with the least of `costs`, all (windows,), of those that are tried."""
        best, least = states, np.nan_to_num(np.asarray(costs(states)), nan=np.inf)
        for trial in self._tried(states):
            found = np.asarray(costs(trial))
            better = np.flatnonzero(found < least)
            best, least = best.put(better, trial.at(better)), np.fmin(least, found)
        return best

    def _tried(self, states: InitialStates) -> Iterator[InitialStates]:
        dtype = states.omega.dtype
        if np.any(self.unknown):
            for R in Rotation.create_group("O").as_matrix().astype(dtype):
                yield replace(states, R=np.where(self.unknown[:, None, None], R, states.R))
        if not np.any(self.axis):
            return
        turns = np.arange(TURNS if np.any(self.turns) else 1) * (2 * np.pi / TURNS)
        rates = RATES if np.any(self.axis[self.rate]) else (0.0,)
        for turn in turns:
            about = Rotation.from_rotvec(turn * self.turns[:, None] * self.axis)
            R = states.R @ about.as_matrix()
            across = states.omega - self.turning + about.inv().apply(self.turning)
            for rate in rates:
                along = (rate * self.speed * self.rate)[:, None] * self.axis
                yield replace(states, R=R.astype(dtype), omega=(across + along).astype(dtype))
