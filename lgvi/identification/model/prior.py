"""Prior knowledge of the parameters: normal priors of functions of the parameters."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from .free_leaves import Free, Quantity, linearise_quantity

MOST_AWAY = 1e7  # standard deviations: chi-square is then known to a tenth
PriorTriple = tuple[Quantity, Any, Any]  # function, mean, standard deviation
Priors = Sequence[PriorTriple] | Mapping[str, PriorTriple]


class Prior(NamedTuple):
    """A function of the parameters, raveled to n numbers, with independent normal errors."""

    function: Quantity
    names: tuple[str, ...]  # of the numbers
    mean: np.ndarray  # (n,)
    deviation: np.ndarray  # (n,)

    def rows(self, parameters: Any, free: Free, theta: np.ndarray) -> np.ndarray:
        """The whitened Jacobian and residual (..., n, p+1) at `theta` (..., p)."""
        values, jacobian = linearise_quantity(self.function, parameters, free, theta)
        table = np.concatenate([jacobian, (values - self.mean)[..., None]], axis=-1)
        return table / self.deviation[:, None]


def as_priors(priors: Priors, parameters: Any, free: Free) -> tuple[Prior, ...]:
    """Checked priors, with the names from a mapping.

    Raises
    ------
    ValueError, TypeError
        For a prior that is not a function with a mean and a standard deviation in the shape of its
        value.
    """
    if hasattr(priors, "as_prior"):
        raise TypeError(
            "Argument `prior` must be triples of a function, a mean and a standard deviation, but "
            f"is of type {type(priors).__name__}: give its `as_prior()`."
        )
    try:
        triples = priors.values() if isinstance(priors, Mapping) else priors
        triples = [(function, mean, deviation) for function, mean, deviation in triples]
    except (TypeError, ValueError):
        raise TypeError(
            "Argument `prior` must be triples of a function, a mean and a standard deviation, or a "
            f"mapping of names to such, but is {priors!r}."
        ) from None
    keys = list(priors) if isinstance(priors, Mapping) else range(len(triples))
    return tuple(
        _as_prior(key, *triple, parameters, free) for key, triple in zip(keys, triples, strict=True)
    )


def _as_prior(
    key: str | int, function: Quantity, mean: Any, deviation: Any, parameters: Any, free: Free
) -> Prior:
    name = f"prior[{key!r}]"
    if not callable(function):
        raise TypeError(
            f"Argument `{name}` must begin with a function of what is estimated, such as "
            f"`lambda model: model.body.inertia`, but with {function!r}."
        )
    try:
        values, jacobian = linearise_quantity(function, parameters, free, free.theta)
    except Exception as error:
        raise ValueError(
            f"Argument `{name}` must have a function of what is estimated that gives numbers and "
            f"that JAX can differentiate, but it raises {type(error).__name__}: {error}"
        ) from error
    if not values.size:
        raise ValueError(f"Argument `{name}` must have a function that gives numbers, but not one.")
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
    away = np.max(abs(values - mean) / deviation)
    if away > MOST_AWAY:
        raise ValueError(
            f"Argument `{name}` must have a mean within {MOST_AWAY:.0e} standard deviations of the "
            f"start, but it is {away:.1e} away, where rounding hides what is recorded: start from "
            "the mean, or hold a number where it starts by equal `bounds`."
        )
    names = _names(name, jacobian, free)
    if isinstance(key, str):
        counted = [f"prior of {key}[{k}]" for k in range(len(values))]
        names = counted if len(values) > 1 else [f"prior of {key}"]
    return Prior(function, tuple(names), mean, deviation)


def _in_shape(name: str, which: str, argument: Any, value: Any) -> np.ndarray:
    """Numbers for each of the raveled numbers of a value: in its shape, or one for all."""
    leaves, structure = jax.tree.flatten(value)
    try:
        numbers = [argument] if len(leaves) == 1 else structure.flatten_up_to(argument)
        if np.ndim(argument) == 0 and not isinstance(argument, dict):
            numbers = [argument] * len(leaves)
        arrays = [np.asarray(number, float) for number in numbers]
    except (TypeError, ValueError):
        raise TypeError(
            f"Argument `{name}` must have a {which} of numbers, in the shape of its function or "
            f"one for all, but has {argument!r}."
        ) from None
    shapes = [np.shape(leaf) for leaf in leaves]
    if any(array.shape not in ((), shape) for array, shape in zip(arrays, shapes, strict=True)):
        raise ValueError(
            f"Argument `{name}` must have a {which} in the shape of its function, "
            f"{', '.join(map(str, shapes))}, or one number for all, but has {argument!r}."
        )
    arrays = [np.broadcast_to(array, shape) for array, shape in zip(arrays, shapes, strict=True)]
    raveled = np.concatenate([np.ravel(array) for array in arrays])
    if not np.all(np.isfinite(raveled)):
        raise ValueError(f"Argument `{name}` must have a finite {which}, but has {argument!r}.")
    return raveled


def _names(name: str, jacobian: np.ndarray, free: Free) -> list[str]:
    """The name of the prior of each number: that of a coordinate if the number is one."""
    names = []
    for k, row in enumerate(jacobian):
        (at,) = np.nonzero(row)
        number = f"number {k} of " if len(jacobian) > 1 else ""
        is_one = len(at) == 1 and row[at[0]] == 1
        names.append(f"prior of {free.names[at[0]]}" if is_one else f"{number}{name}")
    return names
