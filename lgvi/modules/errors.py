"""Errors that name the values that caused them, raised while a compiled program runs."""

import itertools
import os
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


@jax.custom_batching.custom_vmap
def _first_failed(failed: Array, values: tuple[Array, ...]) -> tuple[Array, ...]:
    """The values; under `jax.vmap`, those of the first element that failed, not batched."""
    return values


@_first_failed.def_vmap
def _(axis_size, in_batched, failed, values):
    if not in_batched[0]:
        failed = jnp.broadcast_to(failed, axis_size)
    # Sums and a minimum, as a gather or `argmax` would bring a sharded batch to one device.
    numbers = jnp.arange(axis_size)
    first = numbers == jnp.min(jnp.where(failed, numbers, axis_size), initial=axis_size)

    def pick(value):
        chosen = first.reshape(-1, *[1] * (value.ndim - 1))
        return jnp.sum(jnp.where(chosen, value, jnp.zeros((), value.dtype)), 0, value.dtype)

    batched = in_batched[1]
    picked = tuple(pick(v) if b else v for v, b in zip(values, batched, strict=True))
    return _first_failed(jnp.any(failed), picked), tuple(False for _ in picked)


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
    element that failed. Where JAX has several devices, whether the program uses them or not, the
    error is a `RuntimeError` of JAX that contains the message.
    """
    failed = jax.lax.stop_gradient(failed)

    def found():
        return jax.lax.stop_gradient(values())

    def message(*values):
        return describe(*(np.asarray(value)[()] for value in values))

    def write(*values):
        return np.asarray(_messages.write(message(*values)), np.int32)

    def fail(*values):
        raise RuntimeError(message(*values))

    def on_failure():
        chosen, index = _first_failed(failed, found()), jax.ShapeDtypeStruct((), jnp.int32)
        if jax.device_count() == 1:
            return jax.pure_callback(write, index, *chosen)
        if os.environ.get("EQX_ON_ERROR", "raise") == "raise":
            # On all devices: those that do not raise would wait for one that does.
            jax.debug.callback(fail, *chosen, partitioned=True)
        return jnp.zeros((), jnp.int32)

    # The check guards a factor of one rather than `x`: derivatives of the product then depend
    # on the check too (the derivative of a guarded linear function does not use its value),
    # and no large array passes through a conditional.
    if isinstance(failed, Tracer):
        # The condition is not batched: otherwise both branches would always run.
        failed_anywhere = _any_in_batch(failed)
        index = jax.lax.cond(failed_anywhere, on_failure, lambda: jnp.zeros((), jnp.int32))
        one = eqx.branched_error_if(jnp.ones(()), failed_anywhere, index, _messages)
    elif failed:
        one = jnp.asarray(eqx.error_if(1.0, True, message(*found())))
    else:
        return x
    return jax.tree.map(
        lambda leaf: leaf & (one > 0) if leaf.dtype == bool else leaf * one.astype(leaf.dtype), x
    )
