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
from .primitives import Arrays, differentiable

# Factors tried on each Newton step, beside 0, which keeps the iterate.
DAMPING_FACTORS = 1.0, 0.5, 0.25

# Full Newton steps that a single step tries first: enough for |h J^-1 pi| up to about 0.5.
SINGLE_STEP_ITERATIONS = 3

# Multiple of the rounding unit that Newton's iteration may leave: over 10^8 steps that adds up
# to no more than rounding does.
TRUNCATION_MARGIN = 1e-4

Given = TypeVar("Given")
Result = TypeVar("Result")


def undamped(
    J: Matrix,
    inverse: Matrix,
    p: Vector,
    r: Vector | None,
    iterations: int,
    *,
    materialise_residual: bool,
) -> tuple[Vector, Array]:
    """Rodrigues vector after some full Newton steps, and the square of the last one's length."""
    p = materialise(p)
    c = materialise(third_order_guess(partial(xyz.apply, inverse), p, r))
    step = c
    for _ in range(iterations):
        right = negative_residual(J, p, c, r)
        # Components that XLA computes apart, each from its own rounding of the residual, would
        # not be the solution for any one residual, and thin bodies stall above rounding.
        right = materialise(right) if materialise_residual else right
        step = xyz.solve(jacobian(J, p, c, r), right)
        # Else each iterate would be computed anew for every use of a component.
        c = materialise(xyz.add(c, step))
    return c, xyz.dot(step, step)


def last_step(
    J: Matrix, inverse: Matrix, p: Vector, r: Vector | None, c: Vector, iterations: int
) -> Array:
    """What `undamped` returns beside the root `c`, found again from it."""
    A, last = jacobian(J, p, c, r), p if r is None else xyz.add(p, r)
    step = xyz.subtract(c, third_order_guess(partial(xyz.apply, inverse), p, r))
    for _ in range(iterations - 1):
        step = xyz.solve(A, xyz.scale(xyz.dot(step, last) / 2, step))
    return xyz.dot(step, step)


def is_truncated(p: Vector, r: Vector | None, c: Vector, last: Array) -> Array:
    """Whether the root `c` lacks another Newton step after the last one, of squared length `last`.

    What is left is not seen in a residual that is mostly rounding. But rounding differs from
    step to step of a trajectory, and this does not: it adds up. The equation is quadratic, so
    a Newton step x leaves the residual x (x.(p + r))/2 exactly.
    """
    b = p if r is None else xyz.add(p, r)
    left = last * jnp.sqrt(xyz.dot(b, b)) / 2
    return ~(left <= rounding(c, r, TRUNCATION_MARGIN))  # True for NaN


def damped(J: Array, p: Array, r: Array | None, newton_iters: int) -> Array:
    """Rodrigues vector (3, *batch) of least residual along damped Newton steps."""
    solver = partial(_damped, newton_iters=newton_iters)
    for _ in p.shape[1:]:
        solver = jax.vmap(solver, in_axes=(-1, -1, None if r is None else -1), out_axes=-1)
    r = None if r is None else jnp.broadcast_to(r, p.shape)
    return solver(jnp.broadcast_to(J, (3, *p.shape)), p, r)


def _damped(J: Array, p: Array, r: Array | None, newton_iters: int) -> Array:
    J_, p_, r_ = xyz.split_matrix(J), xyz.split(p), None if r is None else xyz.split(r)

    def improve(state):
        i, c, best, _ = state
        start = xyz.split(c)
        right = materialise(negative_residual(J_, p_, start, r_))  # for thin bodies
        step = materialise(xyz.solve(jacobian(J_, p_, start, r_), right))
        improved = False
        for factor in DAMPING_FACTORS:
            candidate = xyz.add(start, xyz.scale(factor, step))
            value = residual_norm(J_, p_, candidate, r_)
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

    c = third_order_guess(divide, p_, r_)
    state = (0, xyz.join(c), residual_norm(J_, p_, c, r_), True)
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
def rodrigues_vector(J: Array, p: Array, newton_iters: int, r: Array | None = None) -> Array:
    """Root c (3,) of the divided equation, for an inertia of about unit trace."""
    return _root(newton_iters, J, p, *([] if r is None else [r]))[0]


def root_known(c: Array, J: Array, p: Array, r: Array | None = None) -> Array:
    """The root `c` (3,), which is known; its derivatives are those of `rodrigues_vector`."""
    return _known(None, J, p, *([] if r is None else [r]), c)[0]


def solve_step(newton_iters: int, J: Array, p: Array, r: Array | None = None) -> Arrays:
    batches = [J.shape[1:], p.shape, *([] if r is None else [r.shape])]
    p = jnp.broadcast_to(p, jnp.broadcast_shapes(*batches))
    J_, p_ = xyz.split_matrix(J, axis=0), xyz.split(p, axis=0)
    r_ = None if r is None else xyz.split(r, axis=0)
    iterations = min(newton_iters, SINGLE_STEP_ITERATIONS)
    c, last = undamped(J_, xyz.inverse(J_), p_, r_, iterations, materialise_residual=True)
    # Sharper than what counts as converged, so that it does not matter who found the root.
    short = ~(residual_norm(J_, p_, c, r_) <= rounding(c, r_, margin=1.0))
    short |= is_truncated(p_, r_, c, last)
    c = xyz.join(c, axis=0)

    def robust(p):
        return jnp.where(short, damped(J, p, r, newton_iters), c)

    return [replace_if(jnp.any(short), c, robust, p)]


def _tangents(out: Arrays, primals: Arrays, tangents: Arrays) -> Arrays:
    (J, p, *rs), (dJ, dp, *drs) = primals, tangents
    c, p, dp = (xyz.split(v, axis=0) for v in (out[0], p, dp))
    r, dr = (xyz.split(v[0], axis=0) if v else None for v in (rs, drs))
    J, dJ = (xyz.split_matrix(matrix, axis=0) for matrix in (J, dJ))
    right = xyz.subtract(xyz.scale(0.5, divided(c, dp, dr)), xyz.apply(dJ, c))
    return [xyz.join(xyz.solve(jacobian(J, p, c, r), right), axis=0)]


def _known_step(_: None, *arrays: Array) -> Arrays:
    batch = jnp.broadcast_shapes(*(x.shape[1:] for x in arrays[1:]), arrays[0].shape[2:])
    return [jnp.broadcast_to(arrays[-1], (3, *batch))]


_root = differentiable(solve_step, _tangents)
_known = differentiable(
    _known_step, lambda out, primals, tangents: _tangents(out, primals[:-1], tangents[:-1])
)
