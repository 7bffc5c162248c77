"""What is known of the parameters beforehand: normal priors of functions of them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jax.flatten_util import ravel_pytree

from .free import Free, Quantity, linearise_quantity

PriorGiven = tuple[Quantity, Any, Any]  # function, mean, standard deviation


class Prior(NamedTuple):
    """A function of the parameters, raveled to n numbers, with independent normal errors."""

    function: Quantity
    names: tuple[str, ...]  # of the numbers
    mean: np.ndarray  # (n,)
    deviation: np.ndarray  # (n,)

    def rows(self, parameters: Any, free: Free, theta: np.ndarray) -> np.ndarray:
        """The whitened Jacobian and residual (n, p+1)."""
        values, jacobian = linearise_quantity(self.function, parameters, free, theta, few=True)
        table = np.column_stack([jacobian, values - self.mean])
        return table / self.deviation[:, None]


def as_priors(given: Sequence[PriorGiven], parameters: Any, free: Free) -> tuple[Prior, ...]:
    """Checked priors.

    Raises
    ------
    ValueError, TypeError
        For what is not a function with a mean and a standard deviation in its shape.
    """
    try:
        triples = [(function, mean, deviation) for function, mean, deviation in given]
    except (TypeError, ValueError):
        raise TypeError(
            "Argument `prior` must be triples of a function, a mean and a standard deviation, but "
            f"is {given!r}."
        ) from None
    return tuple(_as_prior(i, *triple, parameters, free) for i, triple in enumerate(triples))


def _as_prior(
    i: int, function: Quantity, mean: Any, deviation: Any, parameters: Any, free: Free
) -> Prior:
    name = f"prior[{i}]"
    if not callable(function):
        raise TypeError(
            f"Argument `{name}` must begin with a function of what is estimated, such as "
            f"`lambda model: model.body.inertia`, but with {function!r}."
        )
    values, jacobian = linearise_quantity(function, parameters, free, free.theta, few=True)
    if not np.all(np.isfinite(jacobian)) or not np.all(np.isfinite(values)):
        raise ValueError(
            f"Argument `{name}` must have a function that is finite at the start, with its "
            "derivative, but it is not."
        )
    if not jacobian.any():
        raise ValueError(
            f"Argument `{name}` must have a function that depends on what is free, but its "
            "derivative is zero at the start."
        )
    mean = _in_shape(name, "mean", mean, function(parameters))
    deviation = _in_shape(name, "standard deviation", deviation, function(parameters))
    if not np.all(deviation > 0):
        raise ValueError(
            f"Argument `{name}` must have a standard deviation above 0, but has {deviation}."
        )
    return Prior(function, tuple(_names(name, jacobian, free)), mean, deviation)


def _in_shape(name: str, which: str, given: Any, value: Any) -> np.ndarray:
    """Numbers for each of the raveled numbers of a value: its own shape, or one for all."""
    wanted = np.shape(ravel_pytree(value)[0])
    try:
        found = np.asarray(ravel_pytree(given)[0], float)
    except (TypeError, ValueError):
        raise TypeError(
            f"Argument `{name}` must have a {which} of numbers, but has {given!r}."
        ) from None
    if found.size == 1:
        found = np.broadcast_to(found, wanted)
    if found.shape != wanted or not np.all(np.isfinite(found)):
        raise ValueError(
            f"Argument `{name}` must have a {which} that is finite, one number or as many as its "
            f"function gives, {wanted[0]}, but has {given!r}."
        )
    return found


def _names(name: str, jacobian: np.ndarray, free: Free) -> list[str]:
    """What the prior of each number is called: after the coordinate that it is, if it is one."""
    found = []
    for k, row in enumerate(jacobian):
        (at,) = np.nonzero(row)
        index = f", number {k}" if len(jacobian) > 1 else ""
        own = len(at) == 1 and row[at[0]] == 1
        found.append(f"prior of {free.names[at[0]]}" if own else f"{name}{index}")
    return found
