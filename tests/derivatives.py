"""First and second derivatives in every mode, against finite differences.

The points are batches: every argument has a leading axis, so that one compilation serves
many points.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

# Sixth-order central differences: with this step the truncation is below rounding for
# functions of order one, and rounding is eps/STEP, about 1e-13.
STEP = 2e-3
WEIGHTS = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}


def differences(f, x):
    """Jacobian of a flat function of a flat point, by values alone."""
    steps = jnp.asarray([k * sign for k in WEIGHTS for sign in (1, -1)], x.dtype) * STEP
    weights = jnp.asarray([w * sign for w in WEIGHTS.values() for sign in (1, -1)], x.dtype)
    offsets = steps[:, None, None] * jnp.eye(x.size, dtype=x.dtype)[None]
    values = jax.vmap(jax.vmap(lambda offset: f(x + offset)))(offsets)
    return jnp.moveaxis(jnp.tensordot(weights, values, 1), 0, -1) / STEP


def evaluate(f, args, make):
    """`make(g, x)` for the flat function `g` of the flat point `x`, at every point."""

    def at_one_point(*args):
        x, unravel = ravel_pytree(args)
        return make(lambda x: ravel_pytree(f(*unravel(x)))[0], x)

    return [np.asarray(mode) for mode in jax.jit(jax.vmap(at_one_point))(*args)]


def assert_close_each(actual, desired, rtol):
    """Each point's array is within `rtol` of the largest entry of the desired one."""
    axes = tuple(range(1, desired.ndim))
    scale = np.max(np.abs(desired), axis=axes, keepdims=True)
    assert np.all(np.isfinite(actual))
    assert np.all(scale > 0)
    np.testing.assert_allclose(actual / scale, desired / scale, rtol=0, atol=rtol)


def assert_first_derivatives_agree(f, *args, rtol=1e-11):
    """Forward mode, reverse mode and finite differences give one Jacobian; it is returned."""
    forward, reverse, numeric = evaluate(
        f, args, lambda g, x: (jax.jacfwd(g)(x), jax.jacrev(g)(x), differences(g, x))
    )
    assert_close_each(forward, numeric, rtol)
    assert_close_each(reverse, forward, 1e-2 * rtol)
    return forward


def assert_second_derivatives_agree(f, *args, rtol=1e-11):
    """The Hessian is finite, symmetric and the difference quotient of the Jacobian."""
    hessian, numeric = evaluate(
        f,
        args,
        lambda g, x: (jax.jacfwd(jax.jacrev(g))(x), differences(jax.jacrev(g), x)),
    )
    assert_close_each(hessian, numeric, rtol)
    assert_close_each(np.swapaxes(hessian, -1, -2), hessian, 1e-2 * rtol)
    return hessian
