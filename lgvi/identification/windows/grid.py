"""Pieces of recordings side by side: the grid of times on which each is simulated."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..data.formats import INPUTS
from ..data.recordings import Recordings
from ..data.samples import OfTrajectory


class Window(NamedTuple):
    """A part of a trajectory, with its end; if joined, up to the next window that continues it."""

    trajectory: int
    begin: float
    end: float
    joined: bool = False  # to the next one


def whole_trajectories(recordings: Recordings) -> list[Window]:
    """A window for each trajectory."""
    return [Window(i, -np.inf, np.inf) for i in range(len(recordings))]


Numbers = Array | np.ndarray


class Readings(eqx.Module):
    """Readings of a sensor, and the index of their times in the grid."""

    index: Int[Numbers, "*windows readings"]
    value: Float[Numbers, "..."]
    mask: Bool[Numbers, "*windows readings"]


class Windows(eqx.Module):
    """Windows side by side, padded: a step of size zero does nothing."""

    start: Float[Numbers, "*windows"]
    dt: Float[Numbers, "*windows steps"]
    parts: Float[
        Numbers, "*windows parts"
    ]  # sizes of the steps over the time offset of a sensor, in parts of the offset
    readings: dict[str, Readings]  # by channel
    body_torque: Float[Numbers, "*windows states 3"] | None
    rotor_momentum: Float[Numbers, "*windows states columns"] | None
    rotor_speed: Float[Numbers, "*windows states rotors"] | None


class UnpaddedWindow(NamedTuple):
    """A window that is not padded."""

    grid: np.ndarray  # times of all states
    readings: dict[str, tuple[np.ndarray, np.ndarray]]  # (index, value) by channel
    inputs: dict[str, np.ndarray]  # torques and rotor momenta at all times of the grid

    @property
    def size(self) -> list[int]:
        """Numbers of steps, and of readings of each channel."""
        return [len(self.grid) - 1, *(len(index) for index, _ in self.readings.values())]

    def copied(self) -> "UnpaddedWindow":
        """The same in arrays of its own."""
        readings = {name: (index, value.copy()) for name, (index, value) in self.readings.items()}
        inputs = {name: values.copy() for name, values in self.inputs.items()}
        return UnpaddedWindow(self.grid, readings, inputs)

    def pieces(self, count: int) -> list["UnpaddedWindow"]:
        """So many windows of about as many steps; a reading at an end is in the next one."""
        nodes, cuts = nodes_of_pieces(len(self.grid) - 1, count), self._cuts(count)

        def readings(k: int, channel: str) -> tuple[np.ndarray, np.ndarray]:
            part = slice(cuts[channel][k], cuts[channel][k + 1])
            index, value = self.readings[channel]
            return index[part] - nodes[k], value[part]

        parts = [slice(begin, end + 1) for begin, end in pairwise(nodes)]
        return [
            UnpaddedWindow(
                self.grid[part],
                {channel: readings(k, channel) for channel in self.readings},
                {name: values[part] for name, values in self.inputs.items()},
            )
            for k, part in enumerate(parts)
        ]

    def _cuts(self, count: int) -> dict[str, np.ndarray]:
        """The first reading of each piece, and the number of all (count+1,), by channel."""
        begins = [*nodes_of_pieces(len(self.grid) - 1, count)[:-1], len(self.grid)]
        return {
            channel: np.searchsorted(index, begins) for channel, (index, _) in self.readings.items()
        }


def nodes_of_pieces(steps: int, count: int) -> np.ndarray:
    """The nodes at which so many pieces of a grid begin, and the last node (count+1,)."""
    return np.arange(count + 1) * steps // count


def cut_window(samples: OfTrajectory, window: Window, longest_step: float) -> UnpaddedWindow:
    """The grid of a window, with what was measured and what acted on it."""
    cut, after = {}, []
    for channel, (t, value) in samples.items():
        if channel not in INPUTS:
            begin, following = np.searchsorted(t, [window.begin, window.end])
            end = following if window.joined else np.searchsorted(t, window.end, side="right")
            cut[channel] = t[begin:end], value[begin:end]
            after.append(t[following : following + 1])
    inputs = {name: samples[name] for name in INPUTS if name in samples}
    nodes = np.unique(np.concatenate([t for t, _ in cut.values()]))
    if window.joined:  # simulated up to where the next one begins
        nodes = np.append(nodes, np.min(np.concatenate(after)))
    inner = [t[(nodes[0] < t) & (t < nodes[-1])] for t, _ in inputs.values()]
    nodes = np.unique(np.concatenate([nodes, *inner]))
    # Equal parts of each interval, none longer than the longest step; nodes stay what they are.
    parts = np.maximum(np.ceil(np.diff(nodes) / longest_step * (1 - 1e-9)), 1).astype(int)
    part = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    within = np.repeat(nodes[:-1], parts) + part * np.repeat(np.diff(nodes) / parts, parts)
    grid = np.append(within, nodes[-1])
    return UnpaddedWindow(
        grid,
        {channel: (np.searchsorted(grid, t), value) for channel, (t, value) in cut.items()},
        {
            name: np.stack([np.interp(grid, t, component) for component in values.T], axis=1)
            for name, (t, values) in inputs.items()
        },
    )


def _padded(values: np.ndarray, length: int) -> np.ndarray:
    return values[np.minimum(np.arange(length), len(values) - 1)]


def stack_windows(
    rows: Sequence[UnpaddedWindow], size: Sequence[int], fillers: Mapping[str, np.ndarray]
) -> Windows:
    """Windows of so many steps, and readings of each channel.

    A window without readings of a channel gets `fillers`, readings of other windows: all that is
    padded must be computed without NaN.
    """
    windows, (steps, *readings) = len(rows), size
    dtype = jax.dtypes.canonicalize_dtype(float)

    def stacked(arrays: Sequence[np.ndarray], length: int, without: Any = 0) -> np.ndarray:
        """Pad by repeating the last entry; an array without entries gets `without`."""
        result = np.empty((windows, length, *arrays[0].shape[1:]), arrays[0].dtype)
        result[:] = without
        for row, array in zip(result, arrays, strict=True):
            if len(array):
                row[: len(array)] = array
                row[len(array) :] = array[-1]
        return result if result.dtype.kind == "i" else result.astype(dtype)

    def of_channel(channel: str, length: int) -> Readings:
        index, value = zip(*(row.readings[channel] for row in rows), strict=True)
        mask = np.arange(length) < np.array(list(map(len, index)))[:, None]
        return Readings(
            stacked(index, length), stacked(value, length, fillers.get(channel, 0)), mask
        )

    t = np.stack([_padded(row.grid, steps + 1) for row in rows])
    inputs = {
        name: stacked([row.inputs[name] for row in rows], steps + 1) for name in rows[0].inputs
    }
    return Windows(
        start=t[:, 0].astype(dtype),
        dt=np.diff(t, axis=1).astype(dtype),
        parts=np.tile(np.array([0.5, 0.5, 0, 0], dtype), (windows, 1)),
        readings={
            channel: of_channel(channel, length)
            for channel, length in zip(rows[0].readings, readings, strict=True)
        },
        body_torque=inputs.get("body_torque"),
        rotor_momentum=inputs.get("rotor_momentum"),
        rotor_speed=inputs.get("rotor_speed"),
    )
