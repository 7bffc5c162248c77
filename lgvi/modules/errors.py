"""Errors that name the values that caused them, raised while a compiled program runs."""

import itertools
import sys
import threading
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
    them while running. Here a callback writes the message just before Equinox reads it, and the
    number of the message is the index; so each failing program reads its own message.
    """

    KEPT = 256

    def __init__(self) -> None:
        self._numbers = itertools.count()
        self._messages = [_Message()] * self.KEPT

    def write(self, message: str) -> int:
        index = next(self._numbers) % self.KEPT
        self._messages[index] = _Message(message)
        return index

    def find_in(self, text: str) -> str | None:
        """The last message in a text."""
        found = [each for each in self._messages if each and each in text]
        return str(max(found, key=lambda x: (text.rfind(x) + len(x), len(x)))) if found else None

    def __getitem__(self, index):
        message = self._messages[index]
        message.read_in = _context()
        return message

    def __len__(self) -> int:
        return self.KEPT


class _Message(str):
    """A message that `eqx.filter_jit` formats as the message of the error that it handles.

    `eqx.filter_jit` makes its error from the last message of all threads. The error of the program,
    which it handles then, has the message of its own thread.
    """

    read_in: tuple[int, int] | None = None

    def __format__(self, specification: str) -> str:
        if self.read_in == _context():
            return str(self)
        return _messages.find_in(str(sys.exception())) or str(self)


def _context() -> tuple[int, int]:
    """The thread, and the error that is handled in this thread."""
    return threading.get_ident(), id(sys.exception())


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

    `describe` gets the results of `values`, which are computed only after a failure.

    Like `equinox.error_if`, including its environment variable `EQX_ON_ERROR`, but the host
    writes the message from the values. Under `jax.vmap` the message describes the first
    element that failed.
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
        # The condition is not batched: otherwise both branches would always run.
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
