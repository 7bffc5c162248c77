"""Samples and their checks: times that increase, finite numbers, values that a sensor can read."""

from collections.abc import Sequence
from math import prod
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from ...modules.sensors.base import InvalidReadingError
from .formats import Format

OfTrajectory = dict[str, tuple[np.ndarray, np.ndarray]]  # (t, values) by quantity


class Samples(eqx.Module):
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
        times, values = (each[0] if len(each) == 1 else np.concatenate(each) for each in columns)
        for array in (times, values, count):
            array.setflags(write=False)
        return cls(times, values, count)

    def of(self, trajectory: int) -> tuple[np.ndarray, np.ndarray]:
        """Times (samples,) and values (samples, ...) of a trajectory."""
        end = int(np.sum(self.count[: trajectory + 1]))
        part = slice(end - int(self.count[trajectory]), end)
        return self.times[part], self.values[part]

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """Something of each sample (samples, ...), as an array for each trajectory."""
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


class SampleError(ValueError):
    """What is wrong with a sample, in words, without its place."""

    def __init__(self, sample: int, component: int | None, words: str):
        super().__init__(words)
        self.sample = sample
        self.component = component  # None is all of them, -1 the time
        self.words = words

    def at(self, sample: int) -> "SampleError":
        """The same of a sample that has another number elsewhere."""
        return SampleError(sample, self.component, self.words)


def check_readings(given: Format, columns: np.ndarray) -> np.ndarray:
    """Values (samples, ...) of columns (samples, n).

    Raises
    ------
    SampleError
        For the first sample that is malformed.
    """
    if (bad := _first(~np.isfinite(columns).all(1))) is not None:
        component = int(np.argmin(np.isfinite(columns[bad])))
        raise SampleError(bad, component, f"must be finite, but is {columns[bad, component]}")
    try:
        values = given.from_columns(columns)
    except InvalidReadingError as error:
        raise SampleError(error.reading, None, error.words) from None
    shape = getattr(values, "shape", ())
    if not isinstance(values, np.ndarray) or shape[:1] != columns.shape[:1]:
        name = getattr(given, "__name__", type(given).__name__)
        raise TypeError(
            f"`{name}.from_columns` must return an array with {len(columns)} readings, one for "
            f"each row, but returns {type(values).__name__} of shape {shape}."
        )
    if (bad := _first(~np.isfinite(values).all(tuple(range(1, values.ndim))))) is not None:
        raise SampleError(bad, None, "must give a finite reading, but does not")
    return values


def require_increasing(t: np.ndarray) -> None:
    """Check that times (samples,) are finite and increase.

    Raises
    ------
    SampleError
        For the first sample that does not.
    """
    if (bad := _first(~np.isfinite(t))) is not None:
        raise SampleError(bad, -1, f"must be finite, but is {t[bad]}")
    if (bad := _first(np.diff(t) <= 0)) is not None:
        words = f"must increase within a trajectory, but {t[bad + 1]:.12g} follows {t[bad]:.12g}"
        raise SampleError(bad + 1, -1, words)


def column_counts(given: Format) -> tuple[int, ...]:
    """Numbers of columns that a quantity may have in a file."""
    return tuple(prod(shape) for shape in given.shapes)


def as_times(name: str, t: Any) -> np.ndarray:
    """Times (samples,) of one trajectory, increasing.

    Raises
    ------
    ValueError, TypeError
        If they are not.
    """
    t = _floats(name, t)
    if t.ndim != 1 or len(t) == 0:
        raise ValueError(
            f"Argument `{name}` must have shape (samples,), of one trajectory with one sample at "
            f"least, but its shape is {t.shape}."
        )
    try:
        require_increasing(t)
    except SampleError as problem:
        raise ValueError(
            f"Argument `{name}` {problem.words}, in sample {problem.sample}."
        ) from None
    return t


def as_samples(name: str, given: Format, t: Any, value: Any) -> tuple[np.ndarray, np.ndarray]:
    """Checked times (samples,) and values (samples, ...) of what the user gives for a quantity."""
    if isinstance(value, tuple) and len(value) == 2:
        t, value = value
    if t is None:
        raise ValueError(f"Argument `t` must be given, or `{name}` be a tuple of times and values.")
    matrix: Any = getattr(value, "as_matrix", None)
    value, t = _floats(name, value if matrix is None else matrix()), as_times("t", t)
    if value.shape[:1] != t.shape or value.shape[1:] not in given.shapes:
        wanted = " or ".join(str((len(t), *shape)) for shape in given.shapes)
        raise ValueError(
            f"Argument `{name}` must have shape {wanted}, one entry for each time, but its shape "
            f"is {value.shape}."
        )
    try:
        return t, check_readings(given, value.reshape(len(t), -1))
    except SampleError as problem:
        raise ValueError(
            f"Argument `{name}` {problem.words}, in sample {problem.sample}."
        ) from None


def _floats(name: str, value: Any) -> np.ndarray:
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiu":
            raise TypeError(f"its dtype is {array.dtype}")
    except (TypeError, ValueError) as error:
        reason = str(error).rstrip(".")
        raise TypeError(
            f"Argument `{name}` must be an array of numbers, of one trajectory, but {reason}."
        ) from None
    return array.astype(float)


def _first(bad: Any) -> int | None:
    return int(np.argmax(bad)) if bad.any() else None


def require_complete(
    name: str, samples: OfTrajectory, channels: Sequence[str], inputs: Sequence[str]
) -> None:
    """Check that a trajectory has enough samples, and that its inputs are known at all of them.

    Raises
    ------
    ValueError
        If not, naming the trajectory.
    """
    times = [samples[channel][0] for channel in channels if channel in samples]
    times = [t for t in times if len(t)]
    if max(map(len, times), default=0) < 2:
        named = " or of ".join(f"`{channel}`" for channel in channels) or "a sensor"
        raise ValueError(f"Trajectory {name!r} must have two samples of {named}, but has less.")
    first, last = min(t[0] for t in times), max(t[-1] for t in times)
    margin = 1e-9 * (last - first)
    for kind in inputs:
        t = samples[kind][0] if kind in samples else np.zeros(0)
        if len(t) == 0:
            raise ValueError(
                f"Trajectory {name!r} must have `{kind}`, as others have, but has none."
            )
        if t[0] > first + margin or t[-1] < last - margin:
            raise ValueError(
                f"`{kind}` of trajectory {name!r} must cover its measurements, from {first:.9g} to "
                f"{last:.9g} s, but goes from {t[0]:.9g} to {t[-1]:.9g} s."
            )
