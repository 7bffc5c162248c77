"""Samples of one quantity in all trajectories, and parts of them."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from functools import cached_property

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

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
