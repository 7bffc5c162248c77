"""Pieces of recordings side by side: the grid of times on which each is simulated."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .recordings import Recordings
from .samples import GIVEN, SENSED, OfTrajectory

TURN = 1.5  # rad, in the shortest windows
FEWEST = 8  # samples in them
SMALL = 200_000  # steps, which take less time than compiling another program


class Window(NamedTuple):
    """A part of a trajectory, with its end; or up to the next one, where that continues it."""

    trajectory: int
    begin: float
    end: float
    joined: bool = False  # to the next one


def whole(recordings: Recordings) -> list[Window]:
    """A window for each trajectory."""
    return [Window(i, -np.inf, np.inf) for i in range(len(recordings))]


class Readings(eqx.Module):
    """What a sensor read, and at which times of the grid."""

    index: Int[Array, "*windows readings"]
    value: Float[Array, "..."]
    mask: Bool[Array, "*windows readings"]


class Windows(eqx.Module):
    """Windows side by side, padded: a step of size zero does nothing."""

    start: Float[Array, "*windows"]
    dt: Float[Array, "*windows steps"]
    parts: Float[Array, "*windows parts"]  # steps over a time offset of a sensor, parts of it
    attitude: Readings | None
    angular_velocity: Readings | None
    body_torque: Float[Array, "*windows states 3"] | None
    rotor_momentum: Float[Array, "*windows states 3"] | None
    position: Int[Array, "*windows"] | None  # how many are before that it continues; None: no one

    @property
    def joined(self) -> Bool[Array, " windows"] | None:
        """Whether the next window continues each."""
        return None if self.position is None else jnp.roll(self.position, -1) > 0

    @property
    def readings(self) -> tuple[Readings | None, Readings | None]:
        """Of each sensor."""
        return self.attitude, self.angular_velocity


def lay_out(
    recordings: Recordings, levels: Sequence[Sequence[Window]], longest_step: np.ndarray
) -> list[Windows]:
    """Windows side by side for each level, with no step longer than that of their trajectory.

    Consecutive levels get one shape while that is not too large, and shapes are rounded up, so
    that one compiled program serves many: windows, steps and readings are padded. That of the
    last ones has room for `refined` steps, if it is not too large then.
    """
    trajectories = list(recordings)
    rows = [
        [_row(trajectories[w.trajectory], w, longest_step[w.trajectory]) for w in windows]
        for windows in levels
    ]
    groups: list[list[list[_Row]]] = []
    for of_level in rows:
        if groups and np.prod(_size([*groups[-1], of_level])[:2]) <= SMALL:
            groups[-1].append(of_level)
        else:
            groups.append([of_level])
    sizes = [_size(group) for group in groups for _ in group]
    with_room = _size(groups[-1], refinable=True)
    if np.prod(with_room[:2]) <= SMALL:
        sizes[-len(groups[-1]) :] = [with_room] * len(groups[-1])
    return [
        _stacked(of_level, size, _position(windows, size[0]))
        for windows, of_level, size in zip(levels, rows, sizes, strict=True)
    ]


def _position(windows: Sequence[Window], length: int) -> Array | None:
    """How many windows are before each that it continues."""
    if not any(window.joined for window in windows):
        return None
    position = np.zeros(length, int)
    for i, window in enumerate(windows[:-1]):
        position[i + 1] = position[i] + 1 if window.joined else 0
    return jnp.asarray(position)


def _size(levels: Sequence[Sequence["_Row"]], refinable: bool = False) -> list[int]:
    """Windows, steps, and readings of each sensor that hold all levels, and the last `refined`."""
    sizes = [[len(rows), *np.max([row.size for row in rows], axis=0)] for rows in levels]
    if refinable:
        sizes[-1][1] *= 2
    return [_rounded_up(int(size)) for size in np.max(sizes, axis=0)]


def _rounded_up(size: int) -> int:
    """To a multiple of a power of two, by a quarter at most."""
    unit = 2 ** max(0, size.bit_length() - 3)
    return -(-size // unit) * unit


def _stacked(rows: Sequence["_Row"], size: Sequence[int], position: Array | None) -> Windows:
    windows, steps, *readings = size

    def stacked(arrays: Sequence[np.ndarray], length: int, without: Any = 0) -> Array:
        """Pad by repeating the last entry, and windows without one by what is given."""
        result = np.empty((windows, length, *arrays[0].shape[1:]), arrays[0].dtype)
        result[:] = without
        for row, array in zip(result, arrays, strict=False):
            if len(array):
                row[: len(array)] = array
                row[len(array) :] = array[-1]
        return jnp.asarray(result)

    def of_sensor(i: int) -> Readings | None:
        found = [row.readings[i] for row in rows]
        if any(each is None for each in found):
            return None
        found = [each for each in found if each is not None]
        count = np.array([len(index) for index, _ in found])
        mask = np.zeros((windows, readings[i]), bool)
        mask[: len(rows)] = np.arange(readings[i]) < count[:, None]
        index, value = zip(*found, strict=True)
        length, without = readings[i], 0 if i else np.eye(3)  # zeros are no attitude
        return Readings(stacked(index, length), stacked(value, length, without), jnp.asarray(mask))

    # Those without a row stand still at a time that a law knows.
    t = np.full((windows, steps + 1), rows[-1].grid[0])
    for of_window, row in zip(t, rows, strict=False):
        of_window[:] = _padded(row.grid, steps + 1)
    inputs = [
        None if row is None else stacked(column, steps + 1)
        for row, column in zip(
            rows[0].inputs, zip(*(row.inputs for row in rows), strict=True), strict=True
        )
    ]
    start, dt = jnp.asarray(t[:, 0]), jnp.asarray(np.diff(t, axis=1))
    parts = jnp.tile(jnp.array([0.5, 0.5, 0, 0], dt.dtype), (windows, 1))
    return Windows(start, dt, parts, of_sensor(0), of_sensor(1), *inputs, position=position)


def refined(windows: Windows) -> Windows:
    """The same with steps of half the size; in the same shape, if that has room for them."""
    steps = windows.dt.shape[1]
    dt = np.repeat(np.asarray(windows.dt) / 2, 2, axis=1)
    if dt[:, steps:].any():
        steps *= 2

    def readings(given: Readings | None) -> Readings | None:
        return given and Readings(2 * given.index, given.value, given.mask)

    def inputs(given: Array | None) -> Array | None:
        """Linear between the ends of a step."""
        if given is None:
            return None
        states = np.repeat(np.asarray(given), 2, axis=1)[:, :-1]
        states[:, 1::2] += (states[:, 2::2] - states[:, 1::2]) / 2
        return jnp.asarray(states[:, : steps + 1])

    return Windows(
        windows.start,
        jnp.asarray(dt[:, :steps]),
        jnp.full_like(windows.parts, 0.25),
        readings(windows.attitude),
        readings(windows.angular_velocity),
        inputs(windows.body_torque),
        inputs(windows.rotor_momentum),
        windows.position,
    )


class _Row(NamedTuple):
    """A window that is not padded."""

    grid: np.ndarray  # times of all states
    readings: tuple[tuple[np.ndarray, np.ndarray] | None, ...]  # (index, value) of each sensor
    inputs: tuple[np.ndarray | None, ...]  # torques and rotor momenta at all times of the grid

    @property
    def size(self) -> list[int]:
        return [
            len(self.grid) - 1,
            *(0 if each is None else len(each[0]) for each in self.readings),
        ]


def _row(samples: OfTrajectory, window: Window, longest_step: float) -> _Row:
    """The grid of a window, with what was measured and what acted on it."""
    measured, inputs = [samples[kind] for kind in SENSED], [samples[kind] for kind in GIVEN]
    cut, after = [], []
    for of_sensor in measured:
        if of_sensor is not None:
            t, value = of_sensor
            begin, following = np.searchsorted(t, [window.begin, window.end])
            end = following if window.joined else np.searchsorted(t, window.end, side="right")
            of_sensor = t[begin:end], value[begin:end]
            after.append(t[following : following + 1])
        cut.append(of_sensor)
    nodes = np.unique(np.concatenate([each[0] for each in cut if each is not None]))
    if window.joined:  # simulated up to where the next one begins
        nodes = np.append(nodes, np.min(np.concatenate(after)))
    inner = [t[(nodes[0] < t) & (t < nodes[-1])] for t, _ in filter(None, inputs)]
    nodes = np.unique(np.concatenate([nodes, *inner]))
    # Equal parts of each interval, none longer than the longest step; nodes stay what they are.
    parts = np.maximum(np.ceil(np.diff(nodes) / longest_step * (1 - 1e-9)), 1).astype(int)
    part = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    within = np.repeat(nodes[:-1], parts) + part * np.repeat(np.diff(nodes) / parts, parts)
    grid = np.append(within, nodes[-1])
    return _Row(
        grid,
        tuple(each if each is None else (np.searchsorted(grid, each[0]), each[1]) for each in cut),
        tuple(
            each if each is None else np.stack([np.interp(grid, each[0], v) for v in each[1].T], 1)
            for each in inputs
        ),
    )


def _padded(values: np.ndarray, length: int) -> np.ndarray:
    return values[np.minimum(np.arange(length), len(values) - 1)]
