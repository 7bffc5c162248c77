"""Windows of trajectories as segments of one shape: times, readings and what acts there.

A window is a path of nodes: the times of readings, with intervals divided where a step would be too
long. It is cut into segments of so many steps; the last one is padded with steps of size zero.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np

from ...modules.sensors.sensor import time_offset_of
from ..data.formats import INPUTS
from ..data.recordings import Recordings
from ..data.samples import OfTrajectory
from ..model.model import Model
from .programs import Segment


class Window(NamedTuple):
    """A part of a trajectory, with its end; if joined, up to the next window that continues it."""

    trajectory: int
    begin: float
    end: float
    joined: bool = False  # to the next one


def whole_trajectories(recordings: Recordings) -> list[Window]:
    """A window for each trajectory."""
    return [Window(i, -np.inf, np.inf) for i in range(len(recordings))]


class Sizes(NamedTuple):
    """How windows are laid out for the programs. Results do not depend on these sizes."""

    steps: int = 32  # of a segment: more make shorter segments wait, fewer make more of them
    lanes: int = 128  # segments side by side on a device: more do not fit in its cache
    quick_lanes: int = 32  # the same, of programs that are compiled quickly
    quick: int = 256  # segments, up to which optimised programs take longer to compile than to run
    least_lanes: int = 8  # the same, where so few long windows are side by side ...
    long: int = 200  # ... of so many segments, which take longer than compiling
    at_once: int = 200_000  # steps that are in memory


DEFAULT_SIZES = Sizes()
MOST_STEPS = 2e8  # of a window: more are no recording, and no memory holds them


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

    def nodes(self, shifts: np.ndarray) -> "Nodes":
        """The nodes, where clocks are `shifts` (clocks,) later, s."""
        anchors = self.anchors + shifts[self.clocks] if shifts.any() else self.anchors
        if len(anchors) == 1 + self.steps.sum():  # no interval is divided
            return Nodes(anchors, self.readings, self.inputs)
        first = np.cumsum(self.steps) - self.steps
        part = np.arange(self.steps.sum()) - np.repeat(first, self.steps)
        lengths = np.repeat(np.diff(anchors) / self.steps, self.steps)
        t = np.append(np.repeat(anchors[:-1], self.steps) + part * lengths, anchors[-1])
        nodes = np.append(0, np.cumsum(self.steps))
        readings = {channel: (nodes[at], value) for channel, (at, value) in self.readings.items()}
        return Nodes(t, readings, self.inputs)


class Nodes(NamedTuple):
    """The nodes of a window in the order in which they are passed."""

    t: np.ndarray  # (nodes,), recorded s
    readings: dict[str, tuple[np.ndarray, np.ndarray]]  # (node, value) by channel
    inputs: dict[str, tuple[np.ndarray, np.ndarray]]  # (t, value) of the trajectory

    def count_segments(self, length: int) -> int:
        """Number of segments of so many steps; a window without steps is one too."""
        return max(-(-(len(self.t) - 1) // length), 1)


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
    if clocks and np.sum(steps) > MOST_STEPS:
        gone = ", ".join(f"`{channel}.time_offset` {late[channel]:.3g} s" for channel in clocks)
        raise RuntimeError(
            f"A time offset has gone far beyond the recordings ({gone}): the readings of the "
            "sensors may not belong together, or the offset needs `bounds`."
        )
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


def tabulate(
    windows: Sequence[Nodes],
    delays: np.ndarray,
    fillers: Mapping[str, np.ndarray],
    length: int,
    begin: int = 0,
    most: int | None = None,
) -> Table:
    """The segments of windows, of `length` steps, from number `begin` on, and so many at most.

    Rotors have what is recorded of their momentum later, by the `delays` (windows,). Where there is
    no reading, there is a filler: all that is padded must be computed without NaN.
    """
    counts = np.array([nodes.count_segments(length) for nodes in windows]) - begin
    counts = counts if most is None else np.minimum(counts, most)
    first = np.cumsum(counts) - counts
    total, dtype = int(counts.sum()), jax.dtypes.canonicalize_dtype(float)
    start, dt = np.zeros(total), np.zeros((total, length), dtype)
    channels, names = windows[0].readings, windows[0].inputs
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
    for nodes, delay, at, count in zip(windows, delays, first, counts, strict=True):
        part, last = slice(at, at + count), len(nodes.t) - 1
        index = length * np.arange(begin, begin + count)[:, None] + np.arange(length + 1)
        index = np.minimum(index, last)
        t = nodes.t[index]
        start[part], dt[part] = t[:, 0], t[:, 1:] - t[:, :-1]
        # A reading at the node between two segments belongs to the second one.
        ends = [length * begin, length * (begin + count)]
        if ends[1] >= last:
            ends[1] = last + 1
        for channel, (node, value) in nodes.readings.items():
            some = slice(*np.searchsorted(node, ends))
            of_part = node[some] - ends[0]
            segment = np.minimum(of_part // length, count - 1)
            place = at + segment, of_part - length * segment
            readings[channel][place], mask[channel][place] = value[some], True
        for name, (recorded, values) in nodes.inputs.items():
            times = nodes.t[index[0, 0] : index[-1, -1] + 1]
            if name == "rotor_momentum":
                of_nodes = _line_at(recorded, values, times - delay)
            else:
                of_nodes = _held_at(recorded, values, times)
            for array, at_nodes in zip((inputs[name], rates[name]), of_nodes, strict=True):
                array[part] = at_nodes[index - index[0, 0]]
    segments = Segment(start.astype(dtype), dt, readings, mask, inputs, rates)
    return Table(segments, first, counts)


def _line_at(
    recorded: np.ndarray, values: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What was recorded at some times, and its slope, along lines that go on beyond the record.

    At a sample the line is the one that ends there.
    """
    if len(recorded) == 1:
        return np.repeat(values, len(t), axis=0), np.zeros((len(t), values.shape[1]))
    i = np.clip(np.searchsorted(recorded, t) - 1, 0, len(recorded) - 2)
    slope = (values[i + 1] - values[i]) / (recorded[i + 1] - recorded[i])[:, None]
    return values[i] + slope * (t - recorded[i])[:, None], slope


def _held_at(
    recorded: np.ndarray, values: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What was recorded at some times, and its slope; constant beyond the record."""
    inside = np.clip(t, recorded[0], recorded[-1])
    at, slope = _line_at(recorded, values, inside)
    return at, np.where((inside == t)[:, None], slope, 0)


@dataclass(frozen=True)
class Chains:
    """Windows of recordings as chains of segments, which are cut when they are needed."""

    recordings: Recordings
    windows: Sequence[Window]
    longest_step: np.ndarray  # (trajectories,), s
    channels: tuple[str, ...]  # with a clock of their own
    optimised: bool  # whether there is so much to compute that compiling is worth the time
    finer: int = 1  # parts into which each step is divided
    sizes: Sizes = DEFAULT_SIZES
    # The paths of windows, where no clock is late; not of recordings in files.
    kept: dict[Window, Path] = field(default_factory=dict)

    @property
    def clocks(self) -> dict[str, int]:
        """The number of the clock of each channel that has one."""
        return {channel: k + 1 for k, channel in enumerate(self.channels)}

    def halve_steps(self) -> "Chains":
        """The same windows with steps of half the size."""
        return replace(self, finer=2 * self.finer, kept={})

    def only(self, some: np.ndarray) -> "Chains":
        """Some of the windows, whose numbers increase."""
        return replace(self, windows=[self.windows[i] for i in some])

    @property
    def number(self) -> int:
        """Number of windows."""
        return len(self.windows)

    @property
    def trajectory(self) -> np.ndarray:
        """The number of the trajectory of each window (windows,)."""
        return np.array([window.trajectory for window in self.windows], int)

    def sampled(self, trajectories: int, steps: int) -> np.ndarray:
        """Trajectories, chosen at random: no fewer, and with no fewer steps, than these; or all."""
        number = len(self.recordings)
        every = min(number // trajectories, int(np.sum(self.steps)) // steps)
        return np.sort(np.random.default_rng(0).permutation(number)[: number // max(every, 1)])

    @property
    def joined(self) -> np.ndarray:
        """Whether the next window continues a window (windows,)."""
        return np.array([window.joined for window in self.windows])

    @cached_property
    def position(self) -> np.ndarray:
        """Number of windows that each window continues, one after another."""
        position = np.zeros(len(self.windows), int)
        for i, window in enumerate(self.windows[:-1]):
            position[i + 1] = position[i] + 1 if window.joined else 0
        return position

    @property
    def steps(self) -> np.ndarray:
        """Number of steps of each window (windows,)."""
        return self._counts[:, 0]

    @property
    def mean_steps(self) -> np.ndarray:
        """The mean step of each trajectory (trajectories,), s; infinite without a step."""
        durations = np.array([window.end - window.begin for window in self.windows])
        duration, steps = (
            np.bincount(self.trajectory, numbers, minlength=len(self.recordings))
            for numbers in (durations, self.steps)
        )
        return np.where(duration > 0, duration, np.inf) / np.maximum(steps, 1)

    def power_of_steps(self, order: float) -> float:
        """The integral over time, in all windows, of a power of the step."""
        return sum(
            float(np.sum(abs(np.diff(path.anchors)) ** (1 + order) / path.steps**order))
            for path in self._paths_on_time
        )

    def count_readings(self, channel: str) -> np.ndarray:
        """Number of readings of each window (windows,)."""
        return self._counts[:, 1 + list(self.recordings.channels).index(channel)]

    @property
    def _paths_on_time(self) -> Iterable[Path]:
        """The paths of all windows, where no clock is late."""
        missing = [window for window in self.windows if window not in self.kept]
        paths = self._paths(missing, np.zeros((len(missing), 1 + len(self.channels))))
        if self.recordings.are_stored:
            return paths
        self.kept.update(zip(missing, paths, strict=True))
        return [self.kept[window] for window in self.windows]

    @cached_property
    def _counts(self) -> np.ndarray:
        """Numbers of steps, and of readings of each channel (windows, 1 + channels)."""
        return np.array(
            [
                [path.steps.sum(), *(len(path.readings[c][0]) for c in self.recordings.channels)]
                for path in self._paths_on_time
            ]
        )

    def groups(self, lanes: int) -> Iterator[np.ndarray]:
        """Numbers of windows that are simulated side by side: as many as are in memory.

        But no fewer than there are lanes, or these would be idle; unless recordings are in files.
        """
        ends, begin = np.cumsum(self.steps), 0
        lanes = 1 if self.recordings.are_stored else lanes
        while begin < self.number:
            most = ends[begin] - self.steps[begin] + self.sizes.at_once
            end = max(int(np.searchsorted(ends, most, side="right")), begin + lanes)
            yield np.arange(begin, min(end, self.number))
            begin = end

    def parts(
        self, numbers: np.ndarray, late: np.ndarray, delays: np.ndarray
    ) -> Iterator[tuple[np.ndarray, Table]]:
        """Segments of some windows in the order of time, as many at once as are in memory.

        With them are the positions among `numbers` of the windows that they belong to. Clocks are
        `late` (windows, clocks), and rotors have what is recorded `delays` (windows,) later.
        """
        every = np.arange(len(numbers))
        if len(numbers) == self.number and not self.channels and not delays.any() and self._is_kept:
            yield every, self._table
            return
        windows = self._nodes(numbers, late)
        length, at_once = self.sizes.steps, self.sizes.at_once
        counts = np.array([nodes.count_segments(length) for nodes in windows])
        most = max(at_once // (length * len(windows)), 1)
        if np.sum(counts) * length <= at_once:
            most = int(np.max(counts))
        for begin in range(0, int(np.max(counts)), most):
            some = np.flatnonzero(counts > begin)
            of_some = [windows[i] for i in some]
            yield some, tabulate(of_some, delays[some], self._fillers, length, begin, most)

    def table(self, shift: np.ndarray) -> Table:
        """The segments of all windows, with clocks later by `shift` (clocks,), and as many."""
        nodes = [path.nodes(shift) for path in self._paths_on_time]
        return tabulate(nodes, np.zeros(self.number), self._fillers, self.sizes.steps)

    @property
    def _is_kept(self) -> bool:
        return bool(np.sum(self.steps) <= self.sizes.at_once)

    @cached_property
    def _table(self) -> Table:
        return self.table(np.zeros(1))

    def _nodes(self, numbers: np.ndarray, late: np.ndarray) -> list[Nodes]:
        some = replace(self, windows=[self.windows[i] for i in numbers])
        if not late.any():
            return [path.nodes(late[0]) for path in some._paths_on_time]
        longest = self.longest_step[some.trajectory][:, None]
        about = np.round(late / longest) * longest
        paths = self._paths(some.windows, about)
        return [path.nodes(shift) for path, shift in zip(paths, late - about, strict=True)]

    @cached_property
    def _fillers(self) -> dict[str, np.ndarray]:
        channels = self.recordings.channels.items()
        return {
            channel: samples.of(int(np.argmax(samples.count > 0)))[1][0]
            if samples.count.any()
            else np.zeros(samples.shape)
            for channel, samples in channels
        }

    def _paths(self, windows: Iterable[Window], offsets: np.ndarray) -> Iterator[Path]:
        """The paths of some windows, with clocks late by about `offsets` (windows, clocks)."""
        before, samples, clocks, read = -1, {}, self.clocks, self.recordings.reader()
        for window, of_window in zip(windows, offsets, strict=True):
            if window.trajectory != before:
                before, samples = window.trajectory, read(window.trajectory)
            longest = float(self.longest_step[window.trajectory])
            path = cut_path(samples, window, longest, clocks, of_window)
            yield path._replace(steps=self.finer * path.steps)


def lay_out(
    recordings: Recordings,
    levels: Sequence[Sequence[Window]],
    longest_step: np.ndarray,
    model: Model,
) -> list[Chains]:
    """The windows of each level, with no step longer than that of their trajectory."""
    channels = tuple(
        channel for channel, sensor in model.sensors.items() if time_offset_of(sensor) is not None
    )
    chains = [Chains(recordings, windows, longest_step, channels, False) for windows in levels]
    segments = max(np.sum(-(-level.steps // level.sizes.steps)) for level in chains)
    optimised = bool(segments > DEFAULT_SIZES.quick)
    return [replace(level, optimised=optimised) for level in chains]
