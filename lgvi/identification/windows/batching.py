"""As many windows at a time as the cache is for, in few sizes."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

CACHE = 2**26  # bytes of a batch; with many more a batch takes twice as long
FEWEST, FACTOR = 16, 4  # windows of the smallest batch, and from one size to the next


def batch_size(count: int, steps: int, columns: int) -> int:
    """Number of windows at a time, if each state of the motion has so many derivatives.

    One of few sizes, so that one compiled program serves any number of windows.
    """
    numbers = 60 * (columns + 1) * (steps + 1)  # for each window, about
    most = max(1, CACHE // (8 * numbers))
    if most < FEWEST:
        return 2 ** (most.bit_length() - 1)
    size = FEWEST
    while FACTOR * size <= min(most, count):
        size *= FACTOR
    return size


def map_batches(function: Callable[[np.ndarray], Any], count: int, batch: int) -> Any:
    """The results of a function of the numbers of a batch, for `count` in all, as NumPy arrays."""
    results = None
    for begin in range(0, count, batch):
        index = np.minimum(np.arange(begin, begin + batch), count - 1)
        left = count - begin
        found = jax.tree.map(lambda x, left=left: np.asarray(x)[:left], function(index))
        if count <= batch:
            return found
        if results is None:
            results = jax.tree.map(lambda x: np.empty((count, *x.shape[1:]), x.dtype), found)
        for result, part in zip(jax.tree.leaves(results), jax.tree.leaves(found), strict=True):
            result[begin : begin + batch] = part
    return results
