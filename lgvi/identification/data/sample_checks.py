"""Checks of samples, with errors in words, and samples of the same time."""

from collections.abc import Sequence
from math import prod
from typing import Any, Literal, get_args

import numpy as np

from ...modules.sensors.sensor import InvalidReadingError
from .formats import Format
from .samples import OfTrajectory

Duplicates = Literal["error", "first", "mean"]
LEAST_SIZE = 0.5  # singular value of a mean of rotations; 0.7 for two rotations 1.5 rad apart
DUPLICATES: tuple[str, ...] = get_args(Duplicates)


class SampleError(ValueError):
    """An error of a sample, in words, without the place of the sample."""

    def __init__(self, sample: int, component: int | None, words: str):
        super().__init__(words)
        self.sample = sample
        self.component = component  # None for all components, -1 for the time
        self.words = words

    def at(self, sample: int) -> "SampleError":
        """The error with another number of the sample."""
        return SampleError(sample, self.component, self.words)


def check_readings(form: Format, columns: np.ndarray) -> np.ndarray:
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
        values = form.from_columns(columns)
    except InvalidReadingError as error:
        raise SampleError(error.reading, None, error.words) from None
    shape = getattr(values, "shape", ())
    if not isinstance(values, np.ndarray) or shape[:1] != columns.shape[:1]:
        name = getattr(form, "__name__", type(form).__name__)
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
        # All digits: times since 1970 differ in the last ones.
        before, after = (repr(float(x)).removesuffix(".0") for x in t[bad : bad + 2])
        words = f"must increase within a trajectory, but {after} follows {before}"
        raise SampleError(bad + 1, -1, words)


def column_counts(form: Format) -> tuple[int, ...]:
    """Numbers of columns that a quantity may have in a file."""
    return tuple(prod(shape) for shape in form.shapes)


def describe_counts(counts: tuple[int, ...]) -> str:
    """The numbers of columns, in words."""
    if len(counts) > 3 and counts == tuple(range(counts[0], counts[-1] + 1)):
        return f"{counts[0]} to {counts[-1]}"
    return " or ".join(map(str, dict.fromkeys(counts)))


def describe_shapes(form: Format, samples: int) -> str:
    """The possible shapes of a number of samples, in words."""
    if len(form.shapes) > 3 and all(len(shape) == 1 for shape in form.shapes):
        return f"({samples}, n), with n from {describe_counts(column_counts(form))}"
    return " or ".join(str((samples, *shape)) for shape in form.shapes)


def as_times(name: str, t: Any) -> np.ndarray:
    """Times (samples,) of one trajectory, increasing.

    Raises
    ------
    ValueError, TypeError
        For malformed times.
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
        same = problem.sample > 0 and t[problem.sample] == t[problem.sample - 1]
        remedy = ": of readings at one time keep one, or their mean" if same else ""
        raise ValueError(
            f"Argument `{name}` {problem.words}, in sample {problem.sample}{remedy}."
        ) from None
    return t


def as_samples(name: str, form: Format, t: Any, value: Any) -> tuple[np.ndarray, np.ndarray]:
    """Checked times (samples,) and values (samples, ...) of the argument for a quantity."""
    if isinstance(value, tuple) and len(value) == 2:
        t, value = value
    if t is None:
        raise ValueError(f"Argument `t` must be given, or `{name}` be a tuple of times and values.")
    matrix: Any = getattr(value, "as_matrix", None)
    value, t = _floats(name, value if matrix is None else matrix()), as_times("t", t)
    if value.shape[:1] != t.shape or value.shape[1:] not in form.shapes:
        wanted = describe_shapes(form, len(t))
        raise ValueError(
            f"Argument `{name}` must have shape {wanted}, one entry for each time, but its shape "
            f"is {value.shape}."
        )
    try:
        return t, check_readings(form, value.reshape(len(t), -1))
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
    """Check that a trajectory has enough samples, and inputs at the times of all samples.

    Raises
    ------
    ValueError
        If not; the message names the trajectory.
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


def readings_by_time(
    duplicates: Duplicates, form: Format, t: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Times that increase, and values (samples, ...) of columns (samples, n).

    Raises
    ------
    SampleError
        For the first sample that is malformed.
    """
    new = np.diff(t, prepend=np.nan) != 0
    if duplicates == "error" or new.all():
        try:
            require_increasing(t)
        except SampleError as problem:
            if new[problem.sample]:
                raise
            words = f"{problem.words}; `duplicates=` says what to do with samples of the same time"
            raise SampleError(problem.sample, problem.component, words) from None
        return t, check_readings(form, columns)
    first = np.flatnonzero(new)  # the first sample of each time
    try:
        require_increasing(t[first])
        if duplicates == "first":
            return t[first], check_readings(form, columns[first])
    except SampleError as problem:
        raise problem.at(first[problem.sample]) from None
    values = check_readings(form, columns)
    count = np.diff(first, append=len(t))
    several = count > 1
    mean = np.add.reduceat(values, first)[several]
    mean /= count[several].reshape(-1, *np.ones(values.ndim - 1, int))
    if mean.shape[1:] in form.shapes:  # the mean of two rotations is nearly a rotation
        if mean.shape[1:] == (3, 3):
            left, size, right = np.linalg.svd(mean)
            mean = np.where(size[:, -1, None, None] > LEAST_SIZE, left @ right, mean)
        try:
            mean = check_readings(form, mean.reshape(len(mean), -1))
        except SampleError as problem:
            raise problem.at(first[several][problem.sample]) from None
    averaged = values[first]
    averaged[several] = mean
    return t[first], averaged
