"""Samples of the same time in a trajectory: an error, all but the first left out, or averaged."""

from typing import Literal, get_args

import numpy as np

from .checks import SampleError, check_readings, require_increasing
from .formats import Format

Duplicates = Literal["error", "first", "mean"]
LEAST_SIZE = 0.5  # singular value of a mean of rotations: of two that are 1.5 rad apart, 0.7
DUPLICATES: tuple[str, ...] = get_args(Duplicates)


def readings_by_time(
    duplicates: Duplicates, given: Format, t: np.ndarray, columns: np.ndarray
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
        return t, check_readings(given, columns)
    first = np.flatnonzero(new)  # of the samples of each time
    try:
        require_increasing(t[first])
        if duplicates == "first":
            return t[first], check_readings(given, columns[first])
    except SampleError as problem:
        raise problem.at(first[problem.sample]) from None
    values = check_readings(given, columns)
    count = np.diff(first, append=len(t))
    several = count > 1
    mean = np.add.reduceat(values, first)[several]
    mean /= count[several].reshape(-1, *np.ones(values.ndim - 1, int))
    if mean.shape[1:] in given.shapes:  # the mean of two rotations is not quite a rotation
        if mean.shape[1:] == (3, 3):
            left, size, right = np.linalg.svd(mean)
            mean = np.where(size[:, -1, None, None] > LEAST_SIZE, left @ right, mean)
        try:
            mean = check_readings(given, mean.reshape(len(mean), -1))
        except SampleError as problem:
            raise problem.at(first[several][problem.sample]) from None
    averaged = values[first]
    averaged[several] = mean
    return t[first], averaged
