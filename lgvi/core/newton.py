"""Newton's method for the discrete Moser-Veselov equation, and the derivative of its root."""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from . import components as xyz
from .components import Matrix, Vector
from .equation import (
    divided,
    jacobian,
    materialise,
    negative_residual,
    residual_norm,
    rounding,
    third_order_guess,
)

# Factors tried on each Newton step, beside 0, which keeps the iterate.
DAMPING_FACTORS = 1.0, 0.5, 0.25

# Full Newton steps that a single step tries first: enough for |h J^-1 pi| up to about 0.5.
SINGLE_STEP_ITERATIONS = 3

Given = TypeVar("Given")
Result = TypeVar("Result")


def undamped(
    J: Matrix, inverse: Matrix, p: Vector, iterations: int, *, materialise_residual: bool
) -> Vector:
    """Rodrigues vector after some full Newton steps."""
    p = materialise(p)
    c = materialise(third_order_guess(partial(xyz.apply, inverse), p))
    for _ in range(iterations):
        right = negative_residual(J, p, c)
        # Components that XLA computes apart, each from its own rounding of the residual, would
        # not be the solution for any one residual, and thin bodies stall above rounding.
        step = xyz.solve(jacobian(J, p, c), materialise(right) if materialise_residual else right)
        # Else each iterate would be computed anew for every use of a component.
        c = materialise(xyz.add(c, step))
    return c


def damped(J: Array, p: Array, newton_iters: int) -> Array:
    """Rodrigues vector (3,) of least residual along damped Newton steps."""
    J_, p_ = xyz.split_matrix(J), xyz.split(p)

    def improve(state):
        i, c, best, _ = state
        start = xyz.split(c)
        right = materialise(negative_residual(J_, p_, start))  # for thin bodies
        step = materialise(xyz.solve(jacobian(J_, p_, start), right))
        improved = False
        for factor in DAMPING_FACTORS:
            candidate = xyz.add(start, xyz.scale(factor, step))
            value = residual_norm(J_, p_, candidate)
            better = value < best  # False for NaN
            c = jnp.where(better, xyz.join(candidate), c)
            best = jnp.where(better, value, best)
            improved = improved | better
        return i + 1, c, best, improved

    def divide(v):
        # Refined twice: in float32 the determinant of a thin rod has no correct digit to spare.
        v = materialise(v)
        x = materialise(xyz.solve(J_, v))
        for _ in range(2):
            x = materialise(xyz.add(x, xyz.solve(J_, xyz.subtract(v, xyz.apply(J_, x)))))
        return x

    c = third_order_guess(divide, p_)
    state = (0, xyz.join(c), residual_norm(J_, p_, c), True)
    return jax.lax.while_loop(lambda s: (s[0] < newton_iters) & s[3], improve, state)[1]


def replace_if(
    needed: Bool[Array, ""], result: Result, fallback: Callable[[Given], Result], given: Given
) -> Result:
    """`fallback(given)` if it is needed, else `result`.

    A loop that runs at most once, not a conditional: under `jax.vmap` a conditional always runs
    both branches.
    """

    def run(state):
        given, _, _ = state
        # If the state did not change, XLA would compute the fallback before the loop, always.
        return jax.tree.map(jnp.zeros_like, given), fallback(given), jnp.array(False)

    return jax.lax.while_loop(lambda state: state[2], run, (given, result, needed))[1]


# Compiled here, so that calls outside of `jax.jit` compile once.
@partial(jax.jit, static_argnames="newton_iters", inline=True)
def rodrigues_vector(J: Array, p: Array, newton_iters: int) -> Array:
    """Root c (3,) of the divided equation, for an inertia of about unit trace."""
    return _rodrigues_vector(J, p, newton_iters)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _rodrigues_vector(J: Array, p: Array, newton_iters: int) -> Array:
    J_, p_ = xyz.split_matrix(J), xyz.split(p)
    c = undamped(
        J_,
        xyz.inverse(J_),
        p_,
        min(newton_iters, SINGLE_STEP_ITERATIONS),
        materialise_residual=True,
    )
    # Sharper than what counts as converged, so that it does not matter who found the root.
    short = ~(residual_norm(J_, p_, c) <= rounding(c, margin=1.0))  # True for NaN
    return replace_if(short, xyz.join(c), lambda p: damped(J, p, newton_iters), p)


@_rodrigues_vector.defjvp
def _rodrigues_vector_jvp(newton_iters, primals, tangents):
    J, p = primals
    dJ, dp = xyz.split_matrix(tangents[0]), xyz.split(tangents[1])
    c = _rodrigues_vector(J, p, newton_iters)
    c_ = xyz.split(c)
    A = jacobian(xyz.split_matrix(J), xyz.split(p), c_)
    right = xyz.subtract(xyz.scale(0.5, divided(c_, dp)), xyz.apply(dJ, c_))
    return c, xyz.join(xyz.solve(A, right))
