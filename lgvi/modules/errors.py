"""Errors that depend on values, raised by compiled functions too."""

import os
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool

Tree = TypeVar("Tree")

# One for all checks: `eqx.filter_jit` may give a thread the message of another one.
WITHOUT_VALUES = (
    "A value failed a check inside a compiled or batched function: a step did not converge, an "
    "attitude is not a rotation, an inertia is not that of a body, principal axes are not "
    "orthogonal, a momentum, a position, a velocity or a time is not finite, times are not in "
    "order, or the times of samples do not increase or do not cover the trajectory. Outside of "
    "`jax.jit`, `jax.vmap` and loops of JAX the same call says which, with the values. A "
    "simulation with `throw=False` does not raise: `converged` of its result tells which steps "
    "failed."
)


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
    """Return `x`, a pytree of floats and booleans, or raise.

    Where the values are known, a `RuntimeError` is raised whose message is that of `describe`,
    which gets the results of `values`; in compiled and batched functions it is `WITHOUT_VALUES`,
    and the error is the one of `equinox.error_if`, a `RuntimeError` too. Where JAX has several
    devices, the error of a compiled function is a `RuntimeError` of JAX.

    The environment variable `EQX_ON_ERROR` of Equinox is followed.
    """
    failed, message = jax.lax.stop_gradient(failed), WITHOUT_VALUES
    raises = os.environ.get("EQX_ON_ERROR", "raise") == "raise"
    if not isinstance(failed, Tracer):
        if not failed:
            return x
        known = jax.lax.stop_gradient(values())
        if not any(isinstance(value, Tracer) for value in known):
            message = describe(*(np.asarray(value)[()] for value in known))
        if raises:  # Equinox would raise an error of its own kind, and print a frame around it
            raise RuntimeError(message)

    def fail():
        raise RuntimeError(message)

    # The condition is not batched: otherwise both branches would always run.
    failed = _any_in_batch(failed)
    if not isinstance(failed, Tracer):  # as for a function that is batched, but not compiled
        one = eqx.error_if(jnp.ones(()), bool(failed), message)
    elif jax.device_count() == 1 or not raises:
        one = eqx.error_if(jnp.ones(()), failed, message)
    else:
        # On all devices: Equinox raises on one of them, and the others would wait for it.
        jax.lax.cond(failed, lambda: jax.debug.callback(fail, partitioned=True), lambda: None)
        return x
    # The check guards a factor of one rather than `x`: derivatives of the product then depend
    # on the check too (the derivative of a guarded linear function does not use its value),
    # and no large array passes through a conditional.
    return jax.tree.map(
        lambda leaf: leaf & (one > 0) if leaf.dtype == bool else leaf * one.astype(leaf.dtype), x
    )
