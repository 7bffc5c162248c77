"""Pieces of recordings side by side: the grid of times on which each is simulated."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..data.recordings import Recordings
from ..data.samples import GIVEN, SENSED, OfTrajectory

TURN = 1.5  # rad, in the shortest windows
FEWEST = 8  # samples in them


class Window(NamedTuple):
    """A part of a trajectory, with its end; or up to the next one, where that continues it."""

    trajectory: int
    begin: float
    end: float
    joined: bool = False  # to the next one


def whole(recordings: Recordings) -> list[Window]:
    """A window for each trajectory."""
    return [Window(i, -np.inf, np.inf) for i in range(len(recordings))]


Numbers = Array | np.ndarray


class Readings(eqx.Module):
    """What a sensor read, and at which times of the grid."""

    index: Int[Numbers, "*windows readings"]
    value: Float[Numbers, "..."]
    mask: Bool[Numbers, "*windows readings"]


class Windows(eqx.Module):
    """Windows side by side, padded: a step of size zero does nothing."""

    start: Float[Numbers, "*windows"]
    dt: Float[Numbers, "*windows steps"]
    parts: Float[Numbers, "*windows parts"]  # steps over a time offset of a sensor, parts of it
    attitude: Readings | None
    angular_velocity: Readings | None
    body_torque: Float[Numbers, "*windows states 3"] | None
    rotor_momentum: Float[Numbers, "*windows states 3"] | None

    @property
    def readings(self) -> tuple[Readings | None, Readings | None]:
        """Of each sensor."""
        return self.attitude, self.angular_velocity


class Row(NamedTuple):
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


def row_of(samples: OfTrajectory, window: Window, longest_step: float) -> Row:
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
    return Row(
        grid,
        tuple(each if each is None else (np.searchsorted(grid, each[0]), each[1]) for each in cut),
        tuple(
            each if each is None else np.stack([np.interp(grid, each[0], v) for v in each[1].T], 1)
            for each in inputs
        ),
    )


def _padded(values: np.ndarray, length: int) -> np.ndarray:
    return values[np.minimum(np.arange(length), len(values) - 1)]


def stacked_rows(rows: Sequence[Row], size: Sequence[int]) -> Windows:
    windows, (steps, *readings) = len(rows), size
    dtype = jax.dtypes.canonicalize_dtype(float)

    def stacked(arrays: Sequence[np.ndarray], length: int, without: Any = 0) -> np.ndarray:
        """Pad by repeating the last entry, and those without one by what is given."""
        result = np.empty((windows, length, *arrays[0].shape[1:]), arrays[0].dtype)
        result[:] = without
        for row, array in zip(result, arrays, strict=True):
            if len(array):
                row[: len(array)] = array
                row[len(array) :] = array[-1]
        return result if result.dtype.kind == "i" else result.astype(dtype)

    def of_sensor(i: int) -> Readings | None:
        found = [row.readings[i] for row in rows]
        if any(each is None for each in found):
            return None
        found = [each for each in found if each is not None]
        count = np.array([len(index) for index, _ in found])
        mask = np.arange(readings[i]) < count[:, None]
        index, value = zip(*found, strict=True)
        length, without = readings[i], 0 if i else np.eye(3)  # zeros are no attitude
        return Readings(stacked(index, length), stacked(value, length, without), mask)

    t = np.stack([_padded(row.grid, steps + 1) for row in rows])
    inputs = [
        None if row is None else stacked(column, steps + 1)
        for row, column in zip(
            rows[0].inputs, zip(*(row.inputs for row in rows), strict=True), strict=True
        )
    ]
    start, dt = t[:, 0].astype(dtype), np.diff(t, axis=1).astype(dtype)
    parts = np.tile(np.array([0.5, 0.5, 0, 0], dtype), (windows, 1))
    return Windows(start, dt, parts, of_sensor(0), of_sensor(1), *inputs)
