"""Checks of arguments: conversion to one floating-point type, shapes and counts."""

import inspect
import math
import operator
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import wraps
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike

Shape = tuple[int, ...]
Function = TypeVar("Function", bound=Callable[..., Any])


def as_one_program(function: Function) -> Function:
    """Compile a function of arrays, or None, as one program.

    Otherwise a call outside of `jax.jit` would compile each operation separately.
    """
    program, signature = jax.jit(function, inline=True), inspect.signature(function)

    @wraps(function)
    def call(*arguments, **named):
        try:
            bound = signature.bind(*arguments, **named).arguments
        except TypeError:
            return function(*arguments, **named)  # Python's own error names the function
        # `jax.jit` would refuse other types before the function can name the argument.
        return program(**{k: None if x is None else as_real(k, x) for k, x in bound.items()})

    return call  # pyright: ignore[reportReturnType]


def as_floats(
    **arguments: tuple[ArrayLike | Sequence[Any], Shape | Sequence[Shape]],
) -> tuple[Array, ...]:
    """Convert named arguments to arrays of their common floating-point type.

    Each keyword is `name=(value, shape)`, or `name=(value, [shape, shape])` where either
    shape is allowed. Python scalars do not raise the precision and integers become floats.

    Raises
    ------
    ValueError
        If a shape is wrong, naming the argument, its documented shape and its actual shape.
    TypeError
        If a value is complex, boolean or not numeric.
    """
    values = []
    for name, (value, allowed) in arguments.items():
        shapes = [allowed] if isinstance(allowed, tuple) else allowed
        value = as_real(name, value)
        if value.shape not in shapes:
            wanted = " or ".join(map(str, shapes))
            is_batch = any(value.ndim > len(x) and value.shape[-len(x) :] == x for x in shapes if x)
            raise ValueError(
                f"Argument `{name}` must have shape {wanted}, but its shape is {value.shape}."
                + " (One state per call: use `jax.vmap` for batches.)" * is_batch
            )
        values.append(value)
    inexact = [value for value in values if jnp.issubdtype(value.dtype, jnp.inexact)]
    dtype = jnp.result_type(*inexact, 0.0)
    return tuple(value.astype(dtype) for value in values)


def as_real(name: str, value: ArrayLike | Sequence[Any]) -> Array:
    """Convert an argument to a real array; a Python scalar stays weakly typed.

    Raises
    ------
    TypeError
        If the value is complex, boolean or not numeric.
    """
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"Argument `{name}` must be an array or a number, but is {value!r}."
        ) from error
    if not any(jnp.issubdtype(array.dtype, kind) for kind in (jnp.floating, jnp.integer)):
        raise TypeError(f"Argument `{name}` must be real, but its dtype is {array.dtype}.")
    return array


def example_of(name: str, function: Callable[..., ArrayLike], *arguments: Array) -> Array:
    """Zeros with the shape and type of the result of a function; raises like `as_real`."""
    with made_of_jax(name):
        result = jax.eval_shape(lambda *values: as_real(name, function(*values)), *arguments)
    return jnp.zeros(result.shape, result.dtype)


@contextmanager
def made_of_jax(name: str) -> Iterator[None]:
    """Where a function of the user is traced.

    Raises
    ------
    TypeError
        If the function needs the value of an array.
    """
    try:
        yield
    except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError) as error:
        raise TypeError(
            f"`{name}` must be made of functions of `jax.numpy`, as it is compiled, but needs the "
            "value of an array: use `jax.numpy` instead of NumPy and `math`, and `jnp.where` "
            "instead of `if`."
        ) from error


def as_count(name: str, value: int, least: int) -> int:
    """Check a static count.

    Raises
    ------
    TypeError
        If `value` is not an integer known while tracing.
    ValueError
        If `value` is less than `least`.
    """
    if isinstance(value, (bool, np.bool_)):
        raise TypeError(f"Argument `{name}` must be an integer, but is {value!r}.")
    try:
        count = operator.index(value)
    except Exception as error:  # a tracer raises an error type of its own
        raise TypeError(
            f"Argument `{name}` must be an integer, static under `jax.jit` "
            f"(mark it in `static_argnames`), but is {value!r}."
        ) from error
    if count < least:
        raise ValueError(f"Argument `{name}` must be at least {least}, but is {count}.")
    return count


def as_tolerance(value: ArrayLike | None) -> Array | None:
    """Convert a bound on a residual norm, which is checked where it is known.

    Raises
    ------
    ValueError, TypeError
        If it is not None and not a finite number not below zero.
    """
    if value is None:
        return None
    (tolerance,) = as_floats(tolerance=(value, ()))
    if not isinstance(value, Tracer) and not 0 <= float(np.asarray(value)) < math.inf:
        raise ValueError(
            f"Argument `tolerance` must be None or a finite number not below 0, but is {value!r}."
        )
    return tolerance


def require_room(steps: int, save_every: int, dtype: Any) -> None:
    """Refuse more steps than can be numbered, or whose states the memory cannot hold.

    Raises
    ------
    ValueError
        If there are too many; JAX would end the process.
    """
    if steps > np.iinfo(np.int32).max:
        raise ValueError(
            f"Argument `steps` must be below 2**31, but is {steps}: go on from the last state."
        )
    states = steps // save_every + 1
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError):  # not known here
        return
    needed = states * 14 * dtype.itemsize  # R, pi, the residual norm and whether it converged
    if needed > memory:
        raise ValueError(
            f"Argument `steps` must store states that fit in the memory of {memory / 2**30:.3g} "
            f"GiB, but {states} states take {needed / 2**30:.3g} GiB: `save_every` of "
            "`MoserVeselovIntegrator.simulate` stores fewer."
        )


def steps_of_torques(body_torques: ArrayLike) -> int:
    """Number of steps between torques at the times of the states.

    Raises
    ------
    ValueError
        If the torques are not vectors (3,), or there are none.
    """
    shape = as_real("body_torques", body_torques).shape
    if len(shape) != 2 or shape[0] < 1:
        raise ValueError(
            f"Argument `body_torques` must have shape (steps+1, 3), but its shape is {shape}."
        )
    return shape[0] - 1
