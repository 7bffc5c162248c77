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


def around(x):
    """Points about a flat point, (differences, directions, size)."""
    steps = jnp.asarray([k * sign for k in WEIGHTS for sign in (1, -1)], x.dtype) * STEP
    return x[None, None] + steps[:, None, None] * jnp.eye(x.size, dtype=x.dtype)[None]


def differences(values):
    """Jacobian of a flat function by its values at those points alone."""
    weights = jnp.asarray([w * sign for w in WEIGHTS.values() for sign in (1, -1)], values.dtype)
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

    def each(g, x):
        numeric = differences(jax.vmap(jax.vmap(g))(around(x)))
        return jax.jacfwd(g)(x), jax.jacrev(g)(x), numeric

    forward, reverse, numeric = evaluate(f, args, each)
    assert_close_each(forward, numeric, rtol)
    assert_close_each(reverse, forward, 1e-2 * rtol)
    return forward


def assert_gradient_agrees(f, *args, rtol=1e-10, forward=False):
    """The gradient of a sum of sines of the values gives its slope along one direction.

    So does the derivative in forward mode, if asked for. For functions of which the program with
    all Jacobians would be long to compile.
    """
    random = np.random.default_rng(65)
    point = [np.asarray(x, float) for x in args]
    along = [random.normal(size=x.shape) for x in point]

    def scalar(*args):
        values = ravel_pytree(f(*args))[0]
        weights = np.random.default_rng(66).normal(size=values.shape)
        return jnp.sum(jnp.sin(values + weights))

    @jax.jit
    def evaluate(*point):
        slopes = [jax.jvp(scalar, point, tuple(along))[1]] if forward else []
        return *jax.value_and_grad(scalar, argnums=range(len(point)))(*point), slopes

    def at(step):
        return evaluate(*[x + step * d for x, d in zip(point, along, strict=True)])

    _, gradient, slopes = at(0.0)
    slopes.append(sum(np.vdot(g, d) for g, d in zip(gradient, along, strict=True)))
    size = STEP / 2  # in all arguments at once
    numeric = sum(w * (at(k * size)[0] - at(-k * size)[0]) for k, w in WEIGHTS.items()) / size
    assert abs(numeric) > 1e-2
    np.testing.assert_allclose(slopes, numeric, rtol=rtol)


def assert_second_derivatives_agree(f, *args, rtol=1e-11):
    """The Hessian is finite, symmetric and the difference quotient of the Jacobian."""

    def each(g, x):
        def jacobian(x):
            return (jax.jacrev(g)(x),) * 2

        # The same program at the point and about it: there is less to compile than of two.
        several = jnp.concatenate([x[None], around(x).reshape(-1, x.size)])
        hessians, jacobians = jax.vmap(jax.jacfwd(jacobian, has_aux=True))(several)
        about = jacobians[1:].reshape(-1, x.size, *jacobians.shape[1:])
        return hessians[0], differences(about)

    hessian, numeric = evaluate(f, args, each)
    assert_close_each(hessian, numeric, rtol)
    assert_close_each(np.swapaxes(hessian, -1, -2), hessian, 1e-2 * rtol)
    return hessian
