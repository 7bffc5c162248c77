"""Newton's method for the discrete Moser-Veselov equation, and the derivative of its root."""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..kernels.finite import finite, finite_matrix, nan_unless
from ..kernels.primitives import Arrays, differentiable
from ..kernels.vectors import Mat3, Vec3
from .equation import (
    Momentum,
    is_on_branch_of_identity,
    jacobian,
    materialise,
    negative_residual,
    residual_norm,
    right_hand_side,
    rounding,
    with_rotors,
)

# Factors tried on each Newton step; 0 keeps the iterate.
DAMPING_FACTORS = 0.0, 0.25, 0.5, 1.0

# Newton steps from zero that give no fewer correct digits than the third-order guess.
GUESS_STEPS = 2

# Full Newton steps that a single step tries first: enough for |h J^-1 pi| up to about 0.5.
SINGLE_STEP_ITERATIONS = 3

# Multiple of the rounding unit that Newton's iteration may leave: over 10^7 steps the sum is no
# larger than that of rounding errors.
TRUNCATION_MARGIN = 2e-4

Argument = TypeVar("Argument")
Result = TypeVar("Result")


def third_order_guess(inverse: Mat3, momentum: Momentum) -> Vec3:
    """Terms of order h, h^2 and h^3 of c, from the inverse of 2 J."""
    p, first, last = momentum
    c1 = inverse @ first
    c2 = inverse @ p.cross(c1)
    c3 = inverse @ (p.cross(c2) + c1.dot(last) * c1)
    return c1 + c2 + c3


def iterate_undamped(
    twice_J: Mat3, momentum: Momentum, c: Vec3, iterations: int, *, materialise_residual: bool
) -> tuple[Vec3, Array]:
    """Rodrigues vector after some full Newton steps from `c`, and the squared length of the last.

    `c` and the momentum are materialised, so that XLA does not compute them for every use.
    """
    before = c
    for i in range(iterations):
        before, A = c, jacobian(twice_J, momentum, c)
        if i < iterations - 1:
            # The same iterate from a shorter right-hand side, with fewer correct digits.
            c = A.solve(momentum.first - c.dot(momentum.last) * c)
        else:
            right = negative_residual(twice_J, momentum, c)
            # If XLA computed each component from its own rounding of the residual, they would
            # not solve one linear system, and for thin bodies the residual would stall.
            right = materialise(right) if materialise_residual else right
            c += A.solve(right)
        c = materialise(c)
    step = c - before
    return c, step.dot(step)


def is_truncated(last: Array) -> Array:
    """Whether a root needs another Newton step after the last one, of squared length `last`.

    A residual that is mostly rounding does not show the error that is left. But rounding differs
    from step to step of a trajectory, while this error is alike in all and adds up. The equation
    is quadratic, so a Newton step x leaves the residual x (x.(p + r)) exactly, no more than
    x.x |c| for the inertia of a body of unit trace, beside a residual of terms of size 2 |c|.
    """
    return ~(last <= 2 * TRUNCATION_MARGIN * float(jnp.finfo(last.dtype).eps))  # True for NaN


def iterate_damped(twice_J: Array, p: Array, r: Array | None, newton_iters: int) -> Array:
    """Rodrigues vector (3, *batch) of least residual along damped Newton steps from zero.

    An iterate that no factor improves stays as it is: further iterations, for other elements of
    the batch, do not change it.
    """
    batch = jnp.broadcast_shapes(twice_J.shape[2:], p.shape[1:])
    p = jnp.broadcast_to(p, (3, *batch))
    r = None if r is None else jnp.broadcast_to(r, p.shape)
    factors = jnp.asarray(DAMPING_FACTORS, p.dtype)

    def improve(state):
        # Split inside: outside, each component would be an operand of the loop.
        i, c, _ = state
        J_, p_, c_ = Mat3.of(twice_J, axis=0), Vec3.of(p, axis=0), Vec3.of(c, axis=0)
        r_ = None if r is None else Vec3.of(r, axis=0)
        momentum = with_rotors(p_, r_)
        right = materialise(negative_residual(J_, momentum, c_))  # for thin bodies
        step = materialise(jacobian(J_, momentum, c_).solve(right))
        norms = jax.vmap(lambda factor: residual_norm(J_, p_, c_ + factor * step, r_))(factors)
        norm, *others = jax.lax.optimization_barrier(norms)
        least, best = norm, jnp.zeros_like(norm)
        for factor, other in zip(DAMPING_FACTORS[1:], others, strict=True):
            better = (other < norm) & (other <= least)  # False for NaN
            least, best = jnp.where(better, other, least), jnp.where(better, factor, best)
        moved, improved = (c_ + best * step).array(axis=0), best > 0
        return i + 1, jnp.where(improved, moved, c), jnp.any(improved)

    zero = 0 * (p + jnp.broadcast_to(jnp.sum(twice_J, axis=(0, 1)), p.shape))
    start = 0, zero if r is None else zero + 0 * r, True  # NaN for what is not finite
    steps = GUESS_STEPS + newton_iters
    return jax.lax.while_loop(lambda s: (s[0] < steps) & s[2], improve, start)[1]


def replace_if(
    needed: Bool[Array, ""],
    result: Result,
    fallback: Callable[[Argument], Result],
    argument: Argument,
) -> Result:
    """`fallback(argument)` if `needed`, else `result`.

    A loop that runs at most once, not a conditional: under `jax.vmap` a conditional always runs
    both branches.
    """

    def run(state):
        argument, _, _ = state
        # If the state did not change, XLA would compute the fallback before the loop, always.
        return jax.tree.map(jnp.zeros_like, argument), fallback(argument), jnp.array(False)

    return jax.lax.while_loop(lambda state: state[2], run, (argument, result, needed))[1]


# Compiled here, so that calls outside of `jax.jit` compile once.
@partial(jax.jit, static_argnames="newton_iters", inline=True)
def rodrigues_vector(J: Array, p: Array, newton_iters: int, r: Array | None = None) -> Array:
    """Root c (3,) of the quadratic equation, for an inertia of about unit trace."""
    return _root(newton_iters, J, p, *([] if r is None else [r]))[0]


def solve_step(newton_iters: int, J: Array, p: Array, r: Array | None = None) -> Arrays:
    batches = [J.shape[1:], p.shape, *([] if r is None else [r.shape])]
    p = jnp.broadcast_to(p, jnp.broadcast_shapes(*batches))
    twice_J = 2 * J
    J_, p_ = Mat3.of(twice_J, axis=0), Vec3.of(p, axis=0)
    r_ = None if r is None else Vec3.of(r, axis=0)
    momentum = with_rotors(materialise(p_) if r is None else p_, r_)
    # Else a loop of steps with one inertia would have each number of its inverse as an operand.
    inverse = jax.lax.optimization_barrier(J_.inverse().six(axis=0))
    guess = materialise(third_order_guess(Mat3.of_six(inverse, axis=0), momentum))
    iterations = min(newton_iters, SINGLE_STEP_ITERATIONS)
    c, last = iterate_undamped(J_, momentum, guess, iterations, materialise_residual=True)
    # Stricter than `converged`, so that the result does not depend on which loop found the root.
    short = ~(residual_norm(J_, p_, c, r_) <= rounding(c, r_, margin=1.0))
    short |= is_truncated(last) | ~is_on_branch_of_identity(Mat3.of(J, axis=0), c, r_)
    c = c.array(axis=0)

    def robust(p):
        return jnp.where(short, iterate_damped(twice_J, p, r, newton_iters), c)

    return [replace_if(jnp.any(short), c, robust, p)]


def _tangents(out: Arrays, primals: Arrays, tangents: Arrays) -> Arrays:
    (J, *vectors), (dJ, *dvectors) = primals, tangents
    J, (p, *rs), c = finite_matrix(J, axis=0), map(finite, vectors), finite(out[0])
    c, p, dp = (Vec3.of(v, axis=0) for v in (c, p, dvectors[0]))
    r, dr = (Vec3.of(v[0], axis=0) if v else None for v in (rs, dvectors[1:]))
    J, dJ = (Mat3.of(2 * matrix, axis=0) for matrix in (J, dJ))
    right = right_hand_side(c, with_rotors(dp, dr)) - dJ @ c
    dc = jacobian(J, with_rotors(p, r), c).solve(right)
    return [nan_unless(jnp.all(jnp.isfinite(out[0]), axis=0), dc.array(axis=0))]


_root = differentiable(solve_step, _tangents)
