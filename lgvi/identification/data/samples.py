"""Samples of one quantity in all trajectories, and parts of them."""

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from typing import Self

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Bool, Float, Int

from .formats import INPUTS

OfTrajectory = dict[str, tuple[np.ndarray, np.ndarray]]  # (t, values) by quantity


def reading_times(readings: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The times of `(t, values)` of several sensors, without duplicates, increasing."""
    return np.unique(np.concatenate([t for t, _ in readings]))


class AbstractSamples(ABC):
    """Samples of one quantity in all trajectories, in memory or in files.

    Attributes
    ----------
    count
        Number of samples of each trajectory (trajectories,).
    times
        Times (samples,), s, increasing within a trajectory, of all trajectories one after another.
    values
        Values (samples, ...).
    """

    count: Int[np.ndarray, " trajectories"]
    times: Float[np.ndarray, " samples"]
    values: Float[np.ndarray, "samples *shape"]

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Shape of one value."""

    @abstractmethod
    def of(self, trajectory: int) -> tuple[np.ndarray, np.ndarray]:
        """Times (samples,) and values (samples, ...) of a trajectory."""

    @abstractmethod
    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Times and values of each trajectory."""

    @abstractmethod
    def only(self, trajectories: np.ndarray) -> "AbstractSamples":
        """The samples of some trajectories, by their numbers."""

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """Values of all samples (samples, ...), as one array for each trajectory."""
        return np.split(values, np.cumsum(self.count)[:-1])

    @property
    def mask(self) -> Bool[np.ndarray, "trajectories longest"]:
        """True where there is a sample in the padded arrays `t` and `value`."""
        return np.arange(self.count.max(initial=0)) < self.count[:, None]

    @property
    def t(self) -> Float[np.ndarray, "trajectories longest"]:
        """Times side by side, padded with the last one of each trajectory."""
        return self._padded(self.times)

    @property
    def value(self) -> Float[np.ndarray, "trajectories longest *shape"]:
        """Values side by side, padded with the last one of each trajectory."""
        return self._padded(self.values)

    def _padded(self, values: np.ndarray) -> np.ndarray:
        longest, first = self.count.max(initial=0), np.cumsum(self.count) - self.count
        kept = np.minimum(np.arange(longest), np.maximum(self.count - 1, 0)[:, None])
        result = values[np.minimum(first[:, None] + kept, len(values) - 1)]
        result[self.count == 0] = 0
        result.setflags(write=False)
        return result


class Samples(AbstractSamples, eqx.Module):
    """Samples of one quantity in all trajectories, one after another.

    Attributes
    ----------
    times
        Times (samples,), s, increasing within a trajectory.
    values
        Values (samples, ...).
    count
        Number of samples of each trajectory (trajectories,).
    """

    times: Float[np.ndarray, " samples"]
    values: Float[np.ndarray, "samples *shape"]
    count: Int[np.ndarray, " trajectories"]

    @classmethod
    def stack(cls, samples: Sequence[tuple[np.ndarray, np.ndarray]]) -> "Samples":
        """Put `(t, value)` of each trajectory one after another."""
        count = np.array([len(t) for t, _ in samples])
        columns = zip(*samples, strict=True)
        times, values = (x[0] if len(x) == 1 else np.concatenate(x) for x in columns)
        for array in (times, values, count):
            array.setflags(write=False)
        return cls(times, values, count)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one value."""
        return self.values.shape[1:]

    @cached_property
    def _ends(self) -> np.ndarray:
        return np.cumsum(self.count)

    def of(self, trajectory: int) -> tuple[np.ndarray, np.ndarray]:
        """Times (samples,) and values (samples, ...) of a trajectory."""
        end = int(self._ends[trajectory])
        part = slice(end - int(self.count[trajectory]), end)
        return self.times[part], self.values[part]

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Times and values of each trajectory."""
        return zip(self.split(self.times), self.split(self.values), strict=True)

    def only(self, trajectories: np.ndarray) -> "Samples":
        """The samples of some trajectories, by their numbers."""
        samples = list(self)
        return Samples.stack([samples[i] for i in trajectories])


class AbstractParts(ABC):
    """Recordings with methods that take parts of them; see `Recordings`."""

    channels: OrderedDict[str, AbstractSamples]
    names: tuple[str, ...]

    @abstractmethod
    def __iter__(self) -> Iterator[OfTrajectory]:
        """A dictionary of `(t, values)` by quantity for each trajectory."""

    @abstractmethod
    def __len__(self) -> int:
        """Number of trajectories."""

    @abstractmethod
    def only(self, trajectories: np.ndarray, *dropped: str) -> Self:
        """Some trajectories by their numbers, with more dropped data, in words."""

    @abstractmethod
    def _rebuilt(
        self,
        trajectories: Sequence[OfTrajectory],
        names: Sequence[str],
        dropped: Sequence[str] = (),
    ) -> Self:
        """Recordings of other trajectories, with all data dropped so far, in words."""

    def select(
        self,
        which: Iterable[str] | Callable[[OfTrajectory], bool],
        reason: str = "not selected",
    ) -> Self:
        """Recordings of only some trajectories; the others are counted in `dropped`.

        Parameters
        ----------
        which
            Names of trajectories, or a function that tells whether to keep a trajectory, which is
            a dictionary of `(t, values)` by quantity, such as
            `lambda samples: len(samples["attitude"][0]) > 20`.
        reason
            Why the others are left out, in words.

        Raises
        ------
        ValueError
            If a name is not that of a trajectory, or no trajectory is left.
        """
        if callable(which):
            return self._with_only([bool(which(trajectory)) for trajectory in self], reason)
        names = [which] if isinstance(which, str) else list(which)
        self._require_names(names, "select")
        return self._with_only([name in names for name in self.names], reason)

    def _require_names(self, names: Sequence[str], verb: str) -> None:
        if unknown := [name for name in names if name not in self.names]:
            known = ", ".join(map(repr, self.names[:9])) + (", ..." if len(self) > 9 else "")
            raise ValueError(f"There is no trajectory {unknown[0]!r} to {verb}; there are {known}.")

    def _with_only(self, kept: Sequence[bool], reason: str) -> Self:
        left_out = [name for name, keep in zip(self.names, kept, strict=True) if not keep]
        if not left_out:
            return self
        if not any(kept):
            raise ValueError("A trajectory must be left, but none is.")
        return self.only(np.flatnonzero(kept), f"trajectory {', '.join(left_out)} ({reason})")

    def drop(self, names: Iterable[str], reason: str = "by request") -> Self:
        """Recordings without some trajectories, which are counted in `dropped`.

        Raises
        ------
        ValueError
            If a name is not that of a trajectory, or no trajectory is left.
        """
        names = [names] if isinstance(names, str) else list(names)
        self._require_names(names, "drop")
        if not names:
            return self
        return self._with_only([name not in names for name in self.names], reason)

    def drop_samples(
        self,
        channel: str,
        samples: Bool[np.ndarray, " samples"],
        reason: str = "by request",
    ) -> Self:
        """Recordings without some readings of a sensor, which are counted in `dropped`.

        Parameters
        ----------
        channel
            The sensor's channel, such as `"attitude"`.
        samples
            True where a sample is dropped (samples,), of all trajectories one after another.
        reason
            Why, in words.

        Raises
        ------
        ValueError
            If the recordings do not have the channel, or the shape is wrong.
        TypeError
            If `samples` are not booleans.
        """
        if (readings := self.channels.get(channel)) is None:
            raise ValueError(
                f"Argument `channel` must be one of {tuple(self.channels)}, but is {channel!r}."
            )
        dropped = np.asarray(samples)
        if dropped.dtype != bool:
            raise TypeError(
                f"Argument `samples` must be boolean, True for what is dropped, but is of type "
                f"{dropped.dtype}."
            )
        if dropped.shape != (count := int(np.sum(readings.count)),):
            raise ValueError(
                f"Argument `samples` must have shape {(count,)}, but its shape is {dropped.shape}."
            )
        if not dropped.any():
            return self
        remaining = [
            {**trajectory, channel: tuple(x[keep] for x in trajectory[channel])}
            for trajectory, keep in zip(self, readings.split(~dropped), strict=True)
        ]
        words = f"{dropped.sum()} samples of {channel.replace('_', ' ')} ({reason})"
        return self._rebuilt(remaining, self.names, [words])

    def crop(
        self,
        start: Float[ArrayLike, "*trajectories"] | Sequence[float] | None = None,
        end: Float[ArrayLike, "*trajectories"] | Sequence[float] | None = None,
        reason: str = "cropped",
    ) -> Self:
        """Recordings from one time to another; the other readings are counted in `dropped`.

        Torques and rotor momenta are kept as far as needed.

        Parameters
        ----------
        start, end
            Recorded times, s: one for all trajectories, or one for each (trajectories,). By
            default the first and the last time.
        reason
            Why, in words.

        Raises
        ------
        ValueError
            For a wrong shape, or if a trajectory has fewer than two samples left.
        """
        limits = []
        for name, limit, default in (("start", start, -np.inf), ("end", end, np.inf)):
            times = np.asarray(default if limit is None else limit, float)
            if times.shape not in ((), (len(self),)) or np.isnan(times).any():
                raise ValueError(
                    f"Argument `{name}` must be a time, or one for each of {len(self)} "
                    f"trajectories, but is {limit!r}."
                )
            limits.append(np.broadcast_to(times, len(self)))
        if (wrong := limits[0] > limits[1]).any():
            first, last = (limit[wrong][0] for limit in limits)
            raise ValueError(
                f"Argument `start` must be a time before `end`, {last} s, but is {first} s."
            )
        cropped, counts = [], dict.fromkeys(self.channels, 0)
        for trajectory, first, last in zip(self, *limits, strict=True):
            part = _between(trajectory, float(first), float(last))
            cropped.append(part)
            for channel in counts:
                if channel in trajectory:
                    counts[channel] += len(trajectory[channel][0]) - len(part[channel][0])
        words = [
            f"{count} samples of {channel.replace('_', ' ')} ({reason})"
            for channel, count in counts.items()
            if count
        ]
        return self._rebuilt(cropped, self.names, words)

    def split(self, gap: float) -> Self:
        """Recordings with trajectories cut in two at long intervals without readings.

        The parts of trajectory `"toss"` are named `"toss[0]"`, `"toss[1]"` and so on. A part that
        has fewer than two readings of each sensor is left out and counted in `dropped`.

        Parameters
        ----------
        gap
            The least time, s, between two readings at which a trajectory is cut.

        Raises
        ------
        ValueError
            If `gap` is not above 0, or no part is left.
        """
        if not 0 < gap < np.inf:
            raise ValueError(f"Argument `gap` must be a time above 0 s, but is {gap!r}.")
        parts, names, short = [], [], []
        for name, trajectory in zip(self.names, self, strict=True):
            t = reading_times([trajectory[c] for c in self.channels if c in trajectory])
            first = np.append(0, np.flatnonzero(np.diff(t) >= gap) + 1)
            last = np.append(first[1:], len(t)) - 1
            for i, (begin, end) in enumerate(zip(t[first], t[last], strict=True)):
                part = _between(trajectory, begin, end)
                longest = max(len(part[c][0]) for c in self.channels if c in part)
                part_name = name if len(first) == 1 else f"{name}[{i}]"
                if longest < 2:
                    short.append(part_name)
                else:
                    parts.append(part)
                    names.append(part_name)
        if not parts:
            raise ValueError(f"Argument `gap` must leave parts of two readings, but is {gap!r}.")
        words = [f"trajectory {', '.join(short)} (fewer than two readings)"] if short else []
        return self._rebuilt(parts, names, words)


def _between(samples: OfTrajectory, start: float, end: float) -> OfTrajectory:
    """The readings from one time to another, and the inputs that cover them."""
    readings = {
        channel: (t[(start <= t) & (t <= end)], values[(start <= t) & (t <= end)])
        for channel, (t, values) in samples.items()
        if channel not in INPUTS
    }
    times = np.concatenate([t for t, _ in readings.values()])
    part: OfTrajectory = dict(readings)
    for name in samples:
        if name in INPUTS and len(times):
            t, values = samples[name]
            first = max(int(np.searchsorted(t, np.min(times), side="right")) - 1, 0)
            last = int(np.searchsorted(t, np.max(times))) + 1
            part[name] = t[first:last], values[first:last]
    return part
