"""From short windows to whole trajectories, so that a bad start does not end in a bad minimum.

An error of a rate or of the inertia makes the simulated motion run ahead of the recorded motion. In
a window in which the body turns a radian the error stays small; each fit gives the states with
which windows of eight times the length begin. For multiple shooting windows grow up to the
segments.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...modules.arguments import require_instance
from ...modules.integrator import MoserVeselovIntegrator
from ...modules.torques.law import as_law
from ..data.formats import INPUTS
from ..data.recordings import Recordings
from ..model.configuration import Configuration
from ..model.model import Model
from ..running.processes import ProcessGroup
from .segment import Chains, Window, lay_out, whole_trajectories

SHORTEST_TURN = 1.5  # rad, in the shortest windows
FEWEST_SAMPLES = 8  # in the shortest windows
GROWTH = 8
LAST_GROWTH = 1.5 * GROWTH  # at most, to the whole trajectory
MOST = 2000  # shortest windows at most whose data are used in a level before the last
SAMPLE_TRAJECTORIES, SAMPLE_STEPS = 100, 50_000  # of a configuration in a sample, at least


class Cuts(NamedTuple):
    """How a trajectory is cut, in units of its shortest window, from its first sample."""

    first: float  # times of its first and last sample, s
    last: float
    unit: float  # s
    pieces: int  # number of shortest windows
    levels: int  # number of levels before that of the whole trajectory
    stride: int  # from segment to segment; the length of the trajectory if there is one segment
    enough: np.ndarray  # (pieces,), whether there are samples enough for a window to begin there

    @property
    def nested(self) -> int:
        """The largest power of GROWTH that divides the beginnings of all later windows."""
        return self.levels if self.stride >= self.pieces else self.levels - 1

    def spacing(self, level: int, sparse: int) -> int:
        """From one beginning to the next; data are left out if `sparse` is above the level."""
        return GROWTH ** max(level, min(sparse, self.nested))

    def pieces_of(self, level: int, sparse: int) -> float:
        """The data of the level, about, in numbers of shortest windows."""
        return self.pieces * GROWTH**level / self.spacing(level, sparse)

    def begins(self, numbers: np.ndarray) -> list[float]:
        """The times of such beginnings, where samples follow."""
        return (self.first + self.unit * numbers[self.enough[numbers]]).tolist()

    def windows_begin(self, level: int, sparse: int) -> list[float]:
        """Where windows of a level before the last begin.

        A last one that is half of the others or less is left out, if no later window begins there.
        """
        numbers = np.arange(0, self.pieces, self.spacing(level, sparse))
        size, of_next = GROWTH**level, self.spacing(level + 1, 0)
        short = 2 * (self.pieces - numbers) <= size
        last = level + 1 == self.levels and self.stride >= self.pieces
        later = numbers == 0 if last else numbers % of_next == 0
        return self.begins(numbers[later | ~short])


def cut_into_levels(
    recordings: Recordings, speeds: np.ndarray, segment: float | None = None, process_count: int = 1
) -> list[list[Window]]:
    """The windows of each level; in the last level they are the trajectories, or their segments.

    So many processes share the work of the levels before.
    """
    cuts = [
        _cuts(times, speed, segment)
        for times, speed in zip(map(recordings.times_of, recordings), speeds, strict=True)
    ]
    levels, sparse, most = [], 0, max(MOST // process_count, len(cuts))
    for level in range(max(cut.levels for cut in cuts) + 1):
        growing = [cut for cut in cuts if level < cut.levels]
        while any(sparse < cut.nested for cut in growing) and most < sum(
            cut.pieces_of(level, sparse) for cut in growing
        ):
            sparse += 1
        windows = []
        for i, cut in enumerate(cuts):
            if level >= cut.levels:
                windows += _segments(i, cut)
                continue
            for begin in cut.windows_begin(level, sparse):
                end = begin + GROWTH**level * cut.unit
                windows.append(Window(i, begin, min(end, cut.last)))
        levels.append(windows)
    return levels


def _cuts(t: np.ndarray, speed: float, segment: float | None) -> Cuts:
    interval = np.median(np.diff(t)) if len(t) > 1 else 1.0
    unit = max(SHORTEST_TURN / max(speed, 1e-300), FEWEST_SAMPLES * interval)
    duration = t[-1] - t[0]
    pieces = max(1, int(np.ceil(duration / unit)))
    segments = 1
    if segment is not None and pieces > 2:
        segments = min(round(duration / segment), len(t) // FEWEST_SAMPLES)
    if segments <= 1:
        count = 0
        while pieces > (2 if count == 0 else LAST_GROWTH * GROWTH ** (count - 1)):
            count += 1
        return _with_times(t, unit, pieces, count, pieces)
    # Of equal length, and each a whole number of the longest windows before.
    ratio = max(duration / segments / unit, 1)
    grown = int(np.log(ratio) / np.log(GROWTH))
    stride = round(ratio / GROWTH**grown) * GROWTH**grown
    pieces = segments * stride
    return _with_times(t, duration / pieces, pieces, grown + 1, stride)


def _with_times(t: np.ndarray, unit: float, pieces: int, levels: int, stride: int) -> Cuts:
    begins = t[0] + unit * np.arange(pieces)
    ends = np.searchsorted(t, [begins, begins + unit])
    enough = ends[1] - ends[0] >= FEWEST_SAMPLES // 2
    enough[0] = True
    return Cuts(float(t[0]), float(t[-1]), unit, pieces, levels, stride, enough)


def _segments(trajectory: int, cut: Cuts) -> list[Window]:
    """The parts of a trajectory, each joined to the next one."""
    begins = cut.begins(np.arange(0, cut.pieces, cut.stride))
    ends = [*begins[1:], cut.last]
    last = len(begins) - 1
    return [
        Window(trajectory, begin, end, k < last)
        for k, (begin, end) in enumerate(zip(begins, ends, strict=True))
    ]


def scalar_step(integrator: MoserVeselovIntegrator) -> float:
    """The longest step, s, of an argument `integrator`."""
    require_instance("integrator", integrator, MoserVeselovIntegrator)
    dt = integrator.dt
    if dt is None or dt.ndim:
        what = "it is None" if dt is None else f"its shape is {dt.shape}"
        raise ValueError(
            f"Argument `integrator` must have a scalar `dt`, the longest step, but {what}."
        )
    if not 0 < float(dt) < np.inf:
        raise ValueError(
            "Argument `integrator` must have a `dt` above 0 s, the longest step, but it is "
            f"{float(dt)}."
        )
    return float(dt)


def choose_method(
    model: Model, recordings: Recordings, integrator: MoserVeselovIntegrator | None
) -> MoserVeselovIntegrator:
    """An integrator that does not raise, by default of the order that is cheapest for an accuracy.

    Its step is not used: see `first_steps`.
    """
    if integrator is not None:
        return replace(integrator, throw=False)
    order = 6
    if any(name in recordings.quantities for name in INPUTS):
        order = 2
    elif model.torque is not None:
        law = as_law("torque", model.torque)
        order = 2 if law.depends_on_rate else min(4, law.highest_order)
    method = MoserVeselovIntegrator(1.0, order=order, throw=False)
    return replace(method, order=order_of_motion(method, model))


def order_of_motion(method: MoserVeselovIntegrator, model: Model) -> int:
    """The order of the motion, of which that of the centre of mass under forces is of order 2."""
    moves_by_forces = model.mass is not None and model.gravity is not None
    return 2 if moves_by_forces else method.order


def first_steps(
    integrator: MoserVeselovIntegrator | None, speeds: np.ndarray, turn: float
) -> np.ndarray:
    """The longest step of each trajectory (trajectories,), s.

    By default the body turns by at most `turn`, rad, at the angular speed of the trajectory.
    """
    if integrator is not None:
        return np.full(len(speeds), scalar_step(integrator))
    return turn / np.maximum(speeds, 1e-300)


def mean_intervals(recordings: Recordings) -> np.ndarray:
    """The mean time from sample to sample of each trajectory (trajectories,), s."""
    return np.array([np.mean(np.diff(t)) for t in map(recordings.times_of, recordings)])


class Level(NamedTuple):
    """The windows of all configurations at one stage of a fit, one configuration after another."""

    chains: tuple[Chains, ...]  # of each configuration

    @property
    def windows(self) -> list[Sequence[Window]]:
        """The windows of each configuration."""
        return [chains.windows for chains in self.chains]

    @property
    def longest_steps(self) -> list[np.ndarray]:
        """The longest steps (trajectories,), s, of each configuration."""
        return [chains.longest_step for chains in self.chains]

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

    def first_windows_of(self, k: int) -> np.ndarray:
        """The number, among all, of the first window of each trajectory of a configuration."""
        _, first = np.unique(self.chains[k].trajectory, return_index=True)
        return self.parts[k].start + first

    @property
    def first_windows(self) -> np.ndarray:
        """The number of the first window of each trajectory, one configuration after another."""
        return np.concatenate([self.first_windows_of(k) for k in range(len(self.windows))])

    @property
    def is_joined(self) -> bool:
        """Whether a window continues another one."""
        return any(np.any(chains.joined) for chains in self.chains)

    @property
    def steps(self) -> int:
        """Number of steps of all windows."""
        return sum(int(np.sum(chains.steps)) for chains in self.chains)

    def power_of_steps(self, order: float) -> float:
        """The integral over time, in all windows, of a power of the step."""
        return sum(chains.power_of_steps(order) for chains in self.chains)

    def only(self, numbers: np.ndarray) -> "Level":
        """Some of the windows, whose numbers increase."""
        if len(numbers) == self.number:
            return self
        chains = [
            of_part.only(numbers[(part.start <= numbers) & (numbers < part.stop)] - part.start)
            for of_part, part in zip(self.chains, self.parts, strict=True)
        ]
        return Level(tuple(chains))

    def sampled(self, size: int = 1) -> list[np.ndarray]:
        """Trajectories of each configuration: some at random where there are many, or all.

        A larger `size` makes the sample so many times as large.
        """
        least = size * SAMPLE_TRAJECTORIES, size * SAMPLE_STEPS
        return [chains.sampled(*least) for chains in self.chains]

    def of_trajectories(self, trajectories: Sequence[np.ndarray]) -> np.ndarray:
        """The numbers of the windows of some trajectories of each configuration."""
        chosen = [
            part.start + np.flatnonzero(np.isin(chains.trajectory, some))
            for chains, part, some in zip(self.chains, self.parts, trajectories, strict=True)
        ]
        return np.concatenate(chosen)

    def refined(self) -> "Level":
        """With steps of half the size."""
        return Level(tuple(chains.halve_steps() for chains in self.chains))

    def laid_out_again(
        self, configurations: Sequence[Configuration], longest_steps: Sequence[np.ndarray]
    ) -> "Level":
        """The same windows with other steps."""
        return _lay_out(configurations, [self.windows], longest_steps)[0]


def _lay_out(
    configurations: Sequence[Configuration],
    windows: Sequence[Sequence[Sequence[Window]]],
    longest_steps: Sequence[np.ndarray],
) -> list[Level]:
    """Levels of windows, for each level and in it for each configuration."""
    by_configuration = zip(configurations, zip(*windows, strict=True), longest_steps, strict=True)
    chains = [
        lay_out(configuration.recordings, levels, longest_step, configuration.model)
        for configuration, levels, longest_step in by_configuration
    ]
    return [Level(of_level) for of_level in zip(*chains, strict=True)]


def whole_level(
    configurations: Sequence[Configuration], longest_steps: Sequence[np.ndarray]
) -> Level:
    """A window for each trajectory."""
    windows = [whole_trajectories(configuration.recordings) for configuration in configurations]
    return _lay_out(configurations, [windows], longest_steps)[0]


def make_levels(
    configurations: Sequence[Configuration],
    speeds: Sequence[np.ndarray],
    segment: float | None,
    longest_steps: Sequence[np.ndarray],
    processes: ProcessGroup,
) -> list[Level]:
    """From short windows to whole trajectories, for all configurations and processes at once."""
    cut = [
        cut_into_levels(configuration.recordings, speed, segment, processes.number)
        for configuration, speed in zip(configurations, speeds, strict=True)
    ]
    most = int(processes.largest(max(map(len, cut))))
    windows = [levels + levels[-1:] * (most - len(levels)) for levels in cut]
    return _lay_out(configurations, list(zip(*windows, strict=True)), longest_steps)
