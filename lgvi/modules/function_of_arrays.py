"""Any function as a pytree of arrays, so that a program is compiled once for all their values."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, ArrayLike


def _can_be_hashed(leaf: Any) -> bool:
    try:
        hash(leaf)  # a frozen dataclass has the method, and may have a field without it
    except TypeError:
        return False
    return True


class _Static:
    """What a function has beside arrays; leaves that cannot be hashed are compared by identity."""

    def __init__(self, value: Any):
        leaves, structure = jax.tree.flatten(value)
        self.value = value
        self.key = structure, *(x if _can_be_hashed(x) else id(x) for x in leaves)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Static) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


class FunctionOfArrays(eqx.Module):
    """Any function as a pytree of arrays, for the programs of the core, which are `jax.jit`'s."""

    arrays: Any
    others: _Static = eqx.field(static=True)

    def __init__(self, function: Callable[..., ArrayLike]):
        self.arrays, others = eqx.partition(function, _is_array)
        self.others = _Static(others)

    def __call__(self, *arguments: Array) -> Any:
        return eqx.combine(self.arrays, self.others.value)(*arguments)


def _is_array(leaf):
    return isinstance(leaf, (jax.Array, np.ndarray, np.generic))
