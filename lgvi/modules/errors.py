"""Errors that name the values that caused them, raised while a compiled program runs."""

import itertools
from collections.abc import Callable, Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool

Tree = TypeVar("Tree")


class _Messages(Sequence[str]):
    """Messages of `eqx.branched_error_if`, written when the failure happens.

    Equinox wants all its messages while tracing, when no value is known, and an index into
    them while running. Here a callback writes the message just before Equinox reads it, and its
    number is the index; so failures in several threads or programs keep theirs apart.
    """

    KEPT = 256

    def __init__(self) -> None:
        self._numbers = itertools.count()
        self._messages = [""] * self.KEPT

    def write(self, message: str) -> int:
        index = next(self._numbers) % self.KEPT
        self._messages[index] = message
        return index

    def __getitem__(self, index):
        return self._messages[index]

    def __len__(self) -> int:
        return self.KEPT


_messages = _Messages()


@jax.custom_batching.custom_vmap
def _any_in_batch(failed: Array) -> Array:
    """The argument; under `jax.vmap`, whether any element of the batch failed, not batched."""
    return failed


@_any_in_batch.def_vmap
def _(axis_size, in_batched, failed):
    return _any_in_batch(jnp.any(failed)), False


def error_if(
    x: Tree,
    failed: Bool[Array, ""],
    describe: Callable[..., str],
    values: Callable[[], tuple[Array, ...]],
) -> Tree:
    """Return `x`, a pytree of floats and booleans, or raise with the message of `describe`.

    `describe` gets what `values` returns, which is computed only then.

    As `equinox.error_if`, whose environment variable `EQX_ON_ERROR` is honoured, but the
    message is made on the host from the values themselves. Under `jax.vmap` it
    describes the first element that failed.
    """
    failed = jax.lax.stop_gradient(failed)

    def found():
        return jax.lax.stop_gradient(values())

    def write(failed, *values):
        # Under vmap every argument has the batch axes in front.
        failed = np.asarray(failed)
        first = tuple(np.argwhere(failed)[0])
        message = describe(*(np.asarray(value)[first] for value in values))
        return np.full(failed.shape, _messages.write(message), np.int32)

    def on_failure():
        index = jax.ShapeDtypeStruct((), jnp.int32)
        return jax.pure_callback(write, index, failed, *found(), vmap_method="broadcast_all")

    # The check guards a factor of one rather than `x`: derivatives of the product then depend
    # on the check too (the derivative of a guarded linear function does not use its value),
    # and no large array passes through a conditional.
    if isinstance(failed, Tracer):
        # The condition is not batched, or both branches would always run.
        failed_anywhere = _any_in_batch(failed)
        index = jax.lax.cond(failed_anywhere, on_failure, lambda: jnp.zeros((), jnp.int32))
        one = eqx.branched_error_if(jnp.ones(()), failed_anywhere, index, _messages)
    elif failed:
        message = describe(*(np.asarray(value)[()] for value in found()))
        one = jnp.asarray(eqx.error_if(1.0, True, message))
    else:
        return x
    return jax.tree.map(
        lambda leaf: leaf & (one > 0) if leaf.dtype == bool else leaf * one.astype(leaf.dtype), x
    )
