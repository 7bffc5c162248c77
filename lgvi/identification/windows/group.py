"""Windows of about equal length, which are put side by side when they are needed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np

from .grid import UnpaddedWindow, Windows, stack_windows

MULTIPLE = 32  # of the readings of pieces, so that one compiled program serves more
SMALL = 200_000  # steps, which take less time than compiling another program


@dataclass(frozen=True)
class Group:
    """Windows of a layout that have one shape, side by side.

    Many windows are put side by side some at a time, when they are asked for: beside the
    recordings, whose readings they are, they then take little memory.
    """

    index: np.ndarray  # of the windows, among all of the layout
    rows: Sequence[UnpaddedWindow]
    size: Sequence[int]  # steps, and readings of each channel, with the padding
    fillers: Mapping[str, np.ndarray]  # readings where a window has none
    halved: bool = False  # whether the steps of the rows are halved

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def is_small(self) -> bool:
        """Whether the windows stay side by side."""
        return len(self) * self.steps <= SMALL

    @property
    def longest(self) -> int:
        """Steps of the longest window, without the padding."""
        return max(row.size[0] for row in self.rows) * (2 if self.halved else 1)

    @property
    def steps(self) -> int:
        """Steps of each window, with the padding."""
        return self.size[0]

    @property
    def shape(self) -> tuple[int, ...]:
        """Numbers of steps, and of readings of each channel, with the padding."""
        return tuple(self.size)

    def counts(self, channel: str) -> np.ndarray:
        """Number of readings of each window (windows,)."""
        return np.array([len(row.readings[channel][0]) for row in self.rows])

    def windows(self, some: np.ndarray) -> Windows:
        """Some of the windows side by side, by their numbers in this group."""
        if self._all is not None:
            return jax.tree.map(lambda x: x[some], self._all)
        return self._stacked([self.rows[i] for i in some])

    def halve_steps(self) -> "Group":
        """The same windows with steps of half the size; in the same shape if there is room."""
        steps, *readings = self.size
        return replace(self, size=[max(steps, 2 * self.longest), *readings], halved=True)

    def nodes_of_pieces(self, window: int, count: int) -> np.ndarray:
        """Where each of so many pieces of a window begins, in its grid (count,)."""
        return self.rows[window].nodes_of_pieces(count)[:-1] * (2 if self.halved else 1)

    def in_pieces(self, some: np.ndarray, count: int, steps: int) -> "Group":
        """Some windows, each in so many pieces one after another, padded to so many steps."""
        rows = [piece for i in some for piece in self.rows[i].pieces(count)]
        of_rows = [row.readings_of_pieces(count) for row in self.rows]
        readings = (max(map(np.max, counts)) for counts in zip(*of_rows, strict=True))
        size = [steps, *(-(-int(most) // MULTIPLE) * MULTIPLE for most in readings)]
        return Group(np.arange(len(rows)), rows, size, self.fillers, self.halved)

    @cached_property
    def _all(self) -> Windows | None:
        return self._stacked(self.rows) if self.is_small else None

    def _stacked(self, rows: Sequence[UnpaddedWindow]) -> Windows:
        windows = stack_windows(rows, self.size, self.fillers)
        return _with_halved_steps(windows) if self.halved else windows


def _with_halved_steps(windows: Windows) -> Windows:
    """The same, in the same shape; the second half of the steps must be padding."""
    steps = windows.dt.shape[1]

    def inputs(given: Any) -> np.ndarray | None:
        """Linear between the ends of a step."""
        if given is None:
            return None
        states = np.repeat(given, 2, axis=1)[:, :-1]
        states[:, 1::2] += (states[:, 2::2] - states[:, 1::2]) / 2
        return states[:, : steps + 1]

    return replace(
        windows,
        dt=np.repeat(windows.dt / 2, 2, axis=1)[:, :steps],
        parts=np.full_like(windows.parts, 0.25),
        readings={
            channel: replace(readings, index=2 * readings.index)
            for channel, readings in windows.readings.items()
        },
        body_torque=inputs(windows.body_torque),
        rotor_momentum=inputs(windows.rotor_momentum),
    )
