"""Errors that name the values that caused them, raised while a compiled program runs."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

Tree = TypeVar("Tree")


class _Messages(Sequence[str]):
    """The one message of `eqx.branched_error_if`, written when the failure happens.

    Equinox wants its messages while tracing, when no value is known. This sequence has a
    single entry, filled by a callback just before Equinox reads it.
    """

    def __init__(self) -> None:
        self.latest = ""

    def __getitem__(self, index):
        return self.latest

    def __len__(self) -> int:
        return 1


_messages = _Messages()


def error_if(
    x: Tree,
    failed: Bool[Array, ""],
    describe: Callable[..., str],
    *values: Array,
) -> Tree:
    """Return `x`, a pytree of arrays; raise if `failed`, with the message `describe(*values)`.

    As `equinox.error_if`, whose environment variable `EQX_ON_ERROR` is honoured, but the
    message is made on the host from the values themselves. Under `jax.vmap` it
    describes the first element that failed.
    """
    failed, values = jax.lax.stop_gradient((failed, values))

    def write(failed, *values):
        # Under vmap every argument has the batch axes in front.
        failed = np.asarray(failed)
        for index in map(tuple, np.argwhere(failed)[:1]):
            _messages.latest = describe(*(np.asarray(value)[index] for value in values))
        return np.zeros(failed.shape, np.int32)

    def on_failure():
        index = jax.ShapeDtypeStruct((), jnp.int32)
        return jax.pure_callback(write, index, failed, *values, vmap_method="broadcast_all")

    index = jax.lax.cond(failed, on_failure, lambda: jnp.zeros((), jnp.int32))
    # The check guards a factor of one rather than `x`: derivatives of the product then depend
    # on the check too (the derivative of a guarded linear function does not use its value),
    # and no large array passes through a conditional.
    one = eqx.branched_error_if(jnp.ones(()), failed, index, _messages)
    return jax.tree.map(
        lambda leaf: (
            leaf * one.astype(leaf.dtype) if jnp.issubdtype(leaf.dtype, jnp.inexact) else leaf
        ),
        x,
    )
