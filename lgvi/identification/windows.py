"""Pieces of recordings side by side: the grid of times on which each is simulated."""

from collections.abc import Sequence
from typing import NamedTuple

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
    that one compiled program serves many: windows, steps and readings are padded.
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


def _size(levels: Sequence[Sequence["_Row"]]) -> list[int]:
    """Windows, steps, and readings of each sensor that hold all levels."""
    sizes = [[len(rows), *np.max([row.size for row in rows], axis=0)] for rows in levels]
    return [_rounded_up(int(size)) for size in np.max(sizes, axis=0)]


def _rounded_up(size: int) -> int:
    """To a multiple of a power of two, by a quarter at most."""
    unit = 2 ** max(0, size.bit_length() - 3)
    return -(-size // unit) * unit


def _stacked(rows: Sequence["_Row"], size: Sequence[int], position: Array | None) -> Windows:
    windows, steps, *readings = size

    def stacked(arrays: Sequence[np.ndarray], length: int) -> Array:
        """Pad by repeating the last entry, and by windows of zeros."""
        index = np.minimum(np.arange(length), np.array([len(x) - 1 for x in arrays])[:, None])
        result = np.zeros((windows, length, *arrays[0].shape[1:]), arrays[0].dtype)
        for row, array, at in zip(result, arrays, index, strict=False):
            if len(array):
                row[:] = array[at]
        return jnp.asarray(result)

    def of_sensor(i: int) -> Readings | None:
        found = [row.readings[i] for row in rows]
        if any(each is None for each in found):
            return None
        found = [each for each in found if each is not None]
        count = np.array([len(index) for index, _ in found])
        mask = np.zeros((windows, readings[i]), bool)
        mask[: len(rows)] = np.arange(readings[i]) < count[:, None]
        index, value = (stacked(column, readings[i]) for column in zip(*found, strict=True))
        if i == 0:  # zeros are no attitude
            value = jnp.where(mask[:, :, None, None], value, jnp.eye(3, dtype=value.dtype))
        return Readings(index, value, jnp.asarray(mask))

    t = np.zeros((windows, steps + 1))
    for of_window, row in zip(t, rows, strict=False):
        of_window[:] = _padded(row.grid, steps + 1)
    inputs = [
        None if row is None else stacked(column, steps + 1)
        for row, column in zip(
            rows[0].inputs, zip(*(row.inputs for row in rows), strict=True), strict=True
        )
    ]
    start, dt = jnp.asarray(t[:, 0]), jnp.asarray(np.diff(t, axis=1))
    return Windows(start, dt, of_sensor(0), of_sensor(1), *inputs, position=position)


def coarsened(windows: Windows) -> Windows:
    """The same with steps of twice the size, in the same shape: each second one is of size zero."""

    def inputs(given: Array | None) -> Array | None:
        # The end of a step of twice the size is where the next one begins.
        return None if given is None else given.at[:, 1::2].set(given[:, 2::2])

    pairs = windows.dt.reshape(len(windows.dt), -1, 2).sum(2, keepdims=True)
    dt = jnp.concatenate([pairs, jnp.zeros_like(pairs)], 2).reshape(windows.dt.shape)
    return Windows(
        windows.start,
        dt,
        windows.attitude,
        windows.angular_velocity,
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
            inside = (window.begin <= t) & (t < window.end if window.joined else t <= window.end)
            of_sensor = t[inside], value[inside]
            after.append(t[t >= window.end][:1])
        cut.append(of_sensor)
    nodes = np.unique(np.concatenate([each[0] for each in cut if each is not None]))
    if window.joined:  # simulated up to where the next one begins
        nodes = np.append(nodes, np.min(np.concatenate(after)))
    inner = [t[(nodes[0] < t) & (t < nodes[-1])] for t, _ in filter(None, inputs)]
    nodes = np.unique(np.concatenate([nodes, *inner]))
    # Equal parts of each interval, none longer than the longest step; nodes stay what they are.
    # Their number is even, for `coarsened`.
    parts = 2 * np.maximum(np.ceil(np.diff(nodes) / longest_step / 2 * (1 - 1e-9)), 1).astype(int)
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
