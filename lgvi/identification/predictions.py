"""What sensors read without noise at a minimum, simulated when it is asked for."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .model.states import InitialStates
from .problem import FitProblem
from .windows.grid import Window
from .windows.level import Level


class Predictions(NamedTuple):
    """The minimum of some windows. Of many readings the predictions are too many to be kept."""

    problem: FitProblem
    windows: tuple[list[Window], ...]
    longest_steps: Sequence[np.ndarray]  # (trajectories,) of each configuration, s
    theta: np.ndarray
    states: InitialStates
    width: np.ndarray | None  # of the gaps between segments

    def of_configuration(self, number: int) -> dict[str, np.ndarray]:
        """What the sensors of a configuration read (samples, ...), by channel."""
        level = Level(self.windows, ()).laid_out_again(
            self.problem.configurations, self.longest_steps
        )
        point = level, self.theta, self.states, self.width
        return self.problem.linearise(*point, keep="predicted").parts[number].readings()
