"""Windows of trajectories as segments of one shape: times, readings and what acts there.

A window is a path of nodes: the times of readings, with intervals divided where a step would be too
long. It is cut into segments of so many steps; the last one is padded with steps of size zero.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np

from ..data.formats import INPUTS
from ..data.recordings import Recordings
from ..data.samples import OfTrajectory
from ..windows.grid import Window
from .programs import Segment


class Sizes(NamedTuple):
    """How windows are laid out for the programs. Results do not depend on these sizes."""

    steps: int = 32  # of a segment: more make shorter segments wait, fewer make more of them
    lanes: int = 64  # segments side by side on a device: with more, their arrays leave the cache
    few_lanes: int = 32  # the same, of programs that are compiled quickly
    at_once: int = 2_000_000  # steps of windows that are in memory
    kept: int = 200_000  # steps of windows that stay in memory


DEFAULT_SIZES = Sizes()


class Path(NamedTuple):
    """The nodes of a window, and what was read there.

    Anchors are times of readings, by the clock of their sensor: clocks may be set, and the anchors
    and the nodes between them move with them.
    """

    anchors: np.ndarray  # (anchors,), s
    clocks: np.ndarray  # (anchors,), number of the clock; 0 is that of the recordings
    steps: np.ndarray  # (anchors - 1,), of each interval
    readings: dict[str, tuple[np.ndarray, np.ndarray]]  # (anchor, value) by channel
    inputs: dict[str, tuple[np.ndarray, np.ndarray]]  # (t, value) of the trajectory

    def times(self, shifts: np.ndarray) -> np.ndarray:
        """Times of the nodes, where clocks are `shifts` (clocks,) later, s."""
        anchors = self.anchors + shifts[self.clocks] if shifts.any() else self.anchors
        first = np.cumsum(self.steps) - self.steps
        part = np.arange(self.steps.sum()) - np.repeat(first, self.steps)
        lengths = np.repeat(np.diff(anchors) / np.maximum(self.steps, 1), self.steps)
        return np.append(np.repeat(anchors[:-1], self.steps) + part * lengths, anchors[-1])


def cut_path(
    samples: OfTrajectory,
    window: Window,
    longest_step: float,
    clocks: Mapping[str, int],
    offsets: np.ndarray,
) -> Path:
    """The path of a window.

    `clocks` are the numbers of the clocks of channels that have one, `offsets` what they are late
    by, about; by half a step more or less the steps stay as they are.
    """
    cut, following = {}, []
    for channel, (t, value) in samples.items():
        if channel not in INPUTS:
            begin, after = np.searchsorted(t, [window.begin, window.end])
            end = after if window.joined else np.searchsorted(t, window.end, side="right")
            cut[channel] = t[begin:end], value[begin:end]
            following.append(t[after : after + 1])
    inputs = {name: samples[name] for name in INPUTS if name in samples}
    first = min(t[0] for t, _ in cut.values() if len(t))
    last = np.min(np.concatenate(following)) if window.joined else None
    late = {channel: offsets[clocks[channel]] if channel in clocks else 0.0 for channel in cut}
    parts = [
        (np.array([first]), 0),
        *((t + late[c], clocks.get(c, 0)) for c, (t, _) in cut.items()),
    ]
    if last is not None:
        parts.append((np.array([last]), 0))
    end = max(np.max(t, initial=first) for t, _ in parts)
    parts += [(t[(first < t) & (t < end)], 0) for t, _ in inputs.values()]
    times = np.concatenate([t for t, _ in parts])
    clock = np.concatenate([np.full(len(t), number) for t, number in parts])
    # The first node is where the state is, the last where the next window begins.
    key = np.where((times == first) & (clock == 0), -np.inf, times)
    if last is not None:
        key = np.where((times == last) & (clock == 0), np.inf, key)
    order = np.lexsort((clock, key))
    sorted_key, sorted_clock = key[order], clock[order]
    new = (sorted_key[1:] != sorted_key[:-1]) | (sorted_clock[1:] != sorted_clock[:-1])
    new = np.append(True, new)
    anchor = np.empty(len(order), int)
    anchor[order] = np.cumsum(new) - 1
    anchors, clock = times[order][new], sorted_clock[new]
    # Equal parts of each interval, none longer than the longest step.
    steps = np.ceil(abs(np.diff(anchors)) / longest_step * (1 - 1e-9))
    steps = np.maximum(steps, 1).astype(int)
    readings, begin = {}, 1
    for channel, (t, value) in cut.items():
        readings[channel] = anchor[begin : begin + len(t)], value
        begin += len(t)
    return Path(anchors, clock, steps, readings, inputs)


class Table(NamedTuple):
    """Segments of some windows, one window after another."""

    segments: Segment
    first: np.ndarray  # (windows,), number of the first segment of each window
    counts: np.ndarray  # (windows,), numbers of segments
    steps: np.ndarray  # (windows,), of each window, without the padding


def tabulate(
    paths: Sequence[Path],
    shifts: np.ndarray,
    delay: float | None,
    fillers: Mapping[str, np.ndarray],
    length: int,
) -> Table:
    """The segments of windows, of so many steps, with clocks `shifts` (windows, clocks) later.

    Rotors have what is recorded of their momentum a `delay` later. Where there is no reading, there
    is a filler: all that is padded must be computed without NaN.
    """
    steps = np.array([path.steps.sum() for path in paths])
    count = np.maximum(-(-steps // length), 1)
    first = np.cumsum(count) - count
    total, dtype = int(count.sum()), jax.dtypes.canonicalize_dtype(float)
    start, dt = np.zeros(total), np.zeros((total, length), dtype)
    channels, names = paths[0].readings, paths[0].inputs
    readings = {
        channel: np.broadcast_to(
            fillers[channel].astype(dtype), (total, length + 1, *fillers[channel].shape)
        ).copy()
        for channel in channels
    }
    mask = {channel: np.zeros((total, length + 1), bool) for channel in channels}
    inputs, rates = (
        {
            name: np.zeros((total, length + 1, values.shape[1]), dtype)
            for name, (_, values) in names.items()
        }
        for _ in range(2)
    )
    nodes = np.arange(length + 1) + length * np.arange(int(count.max()))[:, None]
    for path, begin, number, last, shift in zip(paths, first, count, steps, shifts, strict=True):
        t, part = path.times(shift), slice(begin, begin + number)
        index = np.minimum(nodes[:number], last)
        start[part] = t[index[:, 0]]
        dt[part] = np.diff(t[index], axis=1)
        nodes_of_anchors = np.append(0, np.cumsum(path.steps))
        for channel, (anchor, value) in path.readings.items():
            node = nodes_of_anchors[anchor]
            at = np.minimum(node // length, number - 1)
            readings[channel][begin + at, node - length * at] = value
            mask[channel][begin + at, node - length * at] = True
        for name, (recorded, values) in path.inputs.items():
            late = delay if name == "rotor_momentum" else None
            of_nodes = _inputs_at(recorded, values, t, late)
            for array, at_nodes in zip((inputs[name], rates[name]), of_nodes, strict=True):
                array[part] = at_nodes[index]
    segments = Segment(start.astype(dtype), dt, readings, mask, inputs, rates)
    return Table(segments, first, count, steps)


def _inputs_at(
    recorded: np.ndarray, values: np.ndarray, t: np.ndarray, delay: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """What was recorded at some times, and its slope: that of the interval which ends there.

    Beyond the record it is constant; with a delay it goes on along a line.
    """
    at = t if delay is None else t - delay
    if len(recorded) == 1:
        return np.repeat(values, len(t), axis=0), np.zeros((len(t), values.shape[1]))
    i = np.clip(np.searchsorted(recorded, at) - 1, 0, len(recorded) - 2)
    slope = (values[i + 1] - values[i]) / (recorded[i + 1] - recorded[i])[:, None]
    if delay is None:
        inside = np.clip(at, recorded[0], recorded[-1])
        slope = np.where(((recorded[0] <= at) & (at <= recorded[-1]))[:, None], slope, 0)
        at = inside
    return values[i] + slope * (at - recorded[i])[:, None], slope


@dataclass(frozen=True)
class Chains:
    """Windows of recordings as chains of segments, which are cut when they are needed."""

    recordings: Recordings
    windows: Sequence[Window]
    longest_step: np.ndarray  # (trajectories,), s
    channels: tuple[str, ...]  # with a clock of their own
    few: bool  # whether there is so little to compute that compiling takes longer
    finer: int = 1  # parts into which each step is divided
    sizes: Sizes = DEFAULT_SIZES

    @property
    def clocks(self) -> dict[str, int]:
        """The number of the clock of each channel that has one."""
        return {channel: k + 1 for k, channel in enumerate(self.channels)}

    def halve_steps(self) -> "Chains":
        """The same windows with steps of half the size."""
        return replace(self, finer=2 * self.finer)

    def only(self, some: np.ndarray) -> "Chains":
        """Some of the windows, whose numbers increase."""
        return replace(self, windows=[self.windows[i] for i in some])

    @cached_property
    def position(self) -> np.ndarray:
        """Number of windows that each window continues, one after another."""
        position = np.zeros(len(self.windows), int)
        for i, window in enumerate(self.windows[:-1]):
            position[i + 1] = position[i] + 1 if window.joined else 0
        return position

    @cached_property
    def steps(self) -> np.ndarray:
        """Number of steps of each window (windows,)."""
        late = np.zeros((len(self.windows), 1 + len(self.channels)))
        numbers = np.arange(len(self.windows))
        return np.array([path.steps.sum() for path in self._paths(numbers, late)])

    def groups(self) -> list[np.ndarray]:
        """Numbers of windows, as many at a time as are in memory."""
        group = (np.cumsum(self.steps) - self.steps) // self.sizes.at_once
        return np.split(np.arange(len(group)), np.flatnonzero(np.diff(group)) + 1)

    def table(self, numbers: np.ndarray, late: np.ndarray, delay: float | None) -> Table:
        """The segments of some windows, with clocks that are `late` (windows, clocks)."""
        are_all = len(numbers) == len(self.windows)
        is_fixed = are_all and not self.channels and delay is None
        if is_fixed and np.sum(self.steps) <= self.sizes.kept:
            return self._table
        return self._tabulated(numbers, late, delay)

    @cached_property
    def _table(self) -> Table:
        """The segments of all windows, of recordings without clocks."""
        numbers = np.arange(len(self.windows))
        return self._tabulated(numbers, np.zeros((len(numbers), 1)), None)

    def _tabulated(self, numbers: np.ndarray, late: np.ndarray, delay: float | None) -> Table:
        longest = np.array([self.longest_step[self.windows[i].trajectory] for i in numbers])
        about = np.round(late / longest[:, None]) * longest[:, None]
        paths = self._paths(numbers, about)
        given = late - about, delay, self._fillers, self.sizes.steps
        return tabulate(list(paths), *given)

    @cached_property
    def _fillers(self) -> dict[str, np.ndarray]:
        channels = self.recordings.channels.items()
        return {
            channel: samples.of(int(np.argmax(samples.count > 0)))[1][0]
            if samples.count.any()
            else np.zeros(samples.shape)
            for channel, samples in channels
        }

    def _paths(self, numbers: np.ndarray, offsets: np.ndarray) -> Iterator[Path]:
        """The paths of some windows, with clocks late by about `offsets` (windows, clocks)."""
        before, samples = -1, {}
        for i, of_window in zip(numbers, offsets, strict=True):
            window = self.windows[i]
            if window.trajectory != before:
                before, samples = window.trajectory, self.recordings.of(window.trajectory)
            longest = float(self.longest_step[window.trajectory])
            path = cut_path(samples, window, longest, self.clocks, of_window)
            yield path._replace(steps=self.finer * path.steps)
