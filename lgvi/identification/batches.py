"""As many windows at a time as the cache is for."""

from collections.abc import Callable
from typing import Any

import jax

from .windows import Windows

CACHE = 2**26  # bytes for what is computed at a time; many more take twice as long


def batch_size(windows: Windows, columns: int) -> int:
    """How many windows at a time, where each state of the motion has so many derivatives."""
    count, steps = windows.dt.shape
    numbers = 60 * (columns + 1) * (steps + 1)  # for each window, about
    most = max(1, CACHE // (8 * numbers))
    # Of equal size: the program for a rest would have to be compiled as well.
    return max(size for size in range(1, min(most, count) + 1) if count % size == 0)


def over_windows(function: Callable[[Any], Any], given: Any, count: int, batch: int) -> Any:
    """What a function gives for each of `count` windows, `batch` at a time."""
    if count == batch:
        return jax.vmap(function)(given)
    return jax.lax.map(function, given, batch_size=batch)
