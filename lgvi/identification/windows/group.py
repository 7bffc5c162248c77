"""Windows of about equal length, which are put side by side when they are needed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np

from .grid import Windows, nodes_of_pieces, stack_windows
from .rows import Rows

MULTIPLE = 32  # of the readings of pieces, so that one compiled program serves more
AT_ONCE = 500_000  # steps of windows that are in memory
SMALL = 200_000  # steps, which take less time than compiling another program


@dataclass(frozen=True)
class Group:
    """Windows of a layout that have one shape, side by side.

    Many windows are put side by side some at a time, when they are asked for: beside the
    recordings, whose readings they are, they then take little memory.
    """

    index: np.ndarray  # of the windows, among all of the layout
    rows: Rows  # of all windows of the layout
    total: int  # number of windows of the group, of which these may be some
    most: int  # steps of the longest of all, without the padding
    size: Sequence[int]  # steps, and readings of each channel, with the padding
    fillers: Mapping[str, np.ndarray]  # readings where a window has none
    halved: bool = False  # whether the steps of the rows are halved

    def __len__(self) -> int:
        return len(self.index)

    @property
    def is_small(self) -> bool:
        """Whether the windows stay side by side."""
        return self.total * self.steps <= SMALL

    def count_at_once(self) -> int:
        """How many windows are in memory at a time, about as many each time."""
        times = -(-self.total * self.steps // AT_ONCE)
        return min(len(self), -(-self.total // times))

    @property
    def longest(self) -> int:
        """Steps of the longest window of the group, without the padding."""
        return self.most * (2 if self.halved else 1)

    @property
    def steps(self) -> int:
        """Steps of each window, with the padding."""
        return self.size[0]

    def counts(self, channel: str) -> np.ndarray:
        """Number of readings of each window (windows,)."""
        return self.rows.sizes[self.index, 1 + self.rows.channels.index(channel)]

    def windows(self, some: np.ndarray) -> Windows:
        """Some of the windows side by side, by their numbers in this group."""
        if self._all is not None:
            return jax.tree.map(lambda x: x[some], self._all)
        return self._stacked(some)

    def halve_steps(self) -> "Group":
        """The same windows with steps of half the size; in the same shape if there is room."""
        steps, *readings = self.size
        return replace(self, size=[max(steps, 2 * self.longest), *readings], halved=True)

    def cut(self, some: np.ndarray) -> "Group":
        """Some of the windows, cut once for all that is asked of them."""
        rows = Rows.of([self.rows.cut(int(i)) for i in self.index[some]])
        return replace(self, index=np.arange(len(some)), rows=rows)

    def nodes_of_pieces(self, count: int) -> np.ndarray:
        """Where each of so many pieces of a window begins in its grid (windows, count)."""
        steps = self.rows.sizes[self.index, 0]
        nodes = np.stack([nodes_of_pieces(each, count)[:-1] for each in steps])
        return nodes * (2 if self.halved else 1)

    def in_pieces(self, count: int, steps: int) -> "Group":
        """All windows, each in so many pieces one after another, padded to so many steps."""
        rows = [piece for i in self.index for piece in self.rows.cut(int(i)).pieces(count)]
        pieces = Rows.of(rows)
        most = np.max(pieces.sizes[:, 1:], axis=0)
        size = [steps, *(-(-int(each) // MULTIPLE) * MULTIPLE for each in most)]
        index, most = np.arange(len(rows)), int(np.max(pieces.sizes[:, 0]))
        return Group(index, pieces, len(rows), most, size, self.fillers, self.halved)

    def beginnings(self, some: np.ndarray, parts: int) -> "Group":
        """The first of so many parts of some windows, in the same shape."""
        cut = self.cut(some)
        rows = [cut.rows.cut(i).pieces(parts)[0] for i in range(len(some))]
        return replace(cut, rows=Rows.of(rows))

    def only(self, some: np.ndarray) -> "Group":
        """Those among some windows of the layout, whose numbers increase, in the same shape."""
        index = np.searchsorted(some, self.index[np.isin(self.index, some)])
        return replace(self, index=index, rows=self.rows.only(some))

    @cached_property
    def _all(self) -> Windows | None:
        return self._stacked(np.arange(len(self))) if self.is_small else None

    def _stacked(self, some: np.ndarray) -> Windows:
        rows = [self.rows.cut(int(i)) for i in self.index[some]]
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
        rotor_speed=inputs(windows.rotor_speed),
    )
