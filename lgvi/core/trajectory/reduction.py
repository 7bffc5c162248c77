r"""Trajectories by reduction and reconstruction.

Under prescribed torques the momentum does not depend on the attitude. So the steps are solved in
a loop over the momentum alone (reduction), small enough for XLA to compile as a whole, and
the attitudes follow from the solutions in a second such loop (reconstruction).

Two Newton iterations without damping are enough for $|h J^{-1}\pi|$ up to about 0.25, four up to
about 0.9. The loop takes two in each of its rounds, and one round for a step, or two where the
first step asks for them. All steps are then checked together; where one is not solved to rounding,
all of it is solved again with more rounds, and at last by the damped solver. A root of another
branch is only reported, as full steps from the third-order guess have not been seen to reach one.

A batch is kept on the last axes of all arrays, so that a component of all its bodies is
one contiguous vector.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.quaternions import Quaternion
from ..kernels.vectors import Mat3, Vec3
from ..step.equation import materialise, residual_norm, rounding, with_rotors
from ..step.newton import is_truncated, iterate_damped, iterate_undamped, third_order_guess
from .inertias import of_steps

ITERATIONS = 2  # of a round
MOST_ROUNDS = 2  # for a step
ONE_ROUND = 0.3  # |h J^-1 pi| of the first step for which one round is tried


def solve_steps(
    newton_iters: int,
    pi0: Array,
    matrices: Array,
    factors: Array,
    h: Array,
    rotor: Array,
    impulses: Array | None = None,
):
    """Attitudes relative to the first, momenta, Rodrigues vectors and norms of the residuals.

    `matrices` and `factors` are those of the inertias of the steps, with axes of a batch at the
    end as all arrays. `rotor` is the momentum of rotors, (1, 3, *batch) or (steps, 3, *batch);
    without rotors it is (0, 3, *batch).
    """
    J = of_steps(matrices, factors)
    shapes = [pi0.shape, J.shape[2:], (3, *h.shape[1:]), rotor.shape[1:]]
    if impulses is not None:
        shapes.append(impulses.shape[1:])
    pi0 = jnp.broadcast_to(pi0, jnp.broadcast_shapes(*shapes))
    trace = jnp.trace(J, axis1=1, axis2=2)
    twice_J, g = Mat3.of(2 * J / trace[:, None, None], axis=1), h / trace
    r = (g * Vec3.of(rotor, axis=1)).array(axis=1) if len(rotor) > 0 else None
    # With barriers, or entries would be arrays of the loop.
    sixes = twice_J.six(axis=1), twice_J.inverse().six(axis=1)
    twice_six, inverse = jax.lax.optimization_barrier(sixes)
    steps = _Steps(g, twice_six, inverse, r, impulses)
    most = min(newton_iters // ITERATIONS, MOST_ROUNDS)

    def attempt(state):
        rounds, *_ = state
        pi, c = jax.lax.cond(
            rounds > 0,
            lambda: _recursion(_undamped, pi0, steps, rounds),
            lambda: _recursion(partial(_damped, newton_iters), pi0, steps, 1),
        )
        p, c_ = g * Vec3.of(pi[:-1], axis=1), Vec3.of(c[:-1], axis=1)
        r_ = None if r is None else Vec3.of(r, axis=1)
        residual = residual_norm(Mat3.of_six(steps.twice_inertia, axis=1), p, c_, r_)
        short = ~jnp.all(residual <= rounding(c_, r_))  # True for NaN
        return _rounds(2 * rounds, most), pi, c, residual, short & (rounds > 0)

    of_body = pi0[None] if len(rotor) == 0 else pi0[None] - rotor[:1]
    half_turn = Mat3.of_six(steps.inverse, axis=1) @ (g * Vec3.of(of_body, axis=1))
    rounds = _rounds(jnp.where(jnp.any(2 * half_turn.norm() > ONE_ROUND), 2, 1), most)
    pi = jnp.zeros((len(h) + 1, *pi0.shape), pi0.dtype)
    state = rounds, pi, pi, pi[:-1, 0], jnp.array(True)
    _, pi, c, residual, _ = jax.lax.while_loop(lambda state: state[-1], attempt, state)
    return _attitudes(c), pi, c, jnp.abs(trace) * residual


class _Steps(NamedTuple):
    """Arrays (steps, ...), or (1, ...) for all steps."""

    g: Array  # sizes over the trace of the inertia
    twice_inertia: Array  # the six numbers of twice the inertia, of which the trace is two
    inverse: Array  # and of its inverse
    r: Array | None  # momentum of rotors times `g`
    impulse: Array | None


def _rounds(rounds: Array, most: int) -> Array:
    """The rounds of an attempt; 0 stands for the damped solver."""
    return jnp.where(rounds <= most, rounds, 0).astype(jnp.int32)


def with_empty_step(array: Array) -> Array:
    return jnp.pad(array, [(0, 1)] + [(0, 0)] * (array.ndim - 1))


def with_value_of_empty_step(array: Array) -> Array:
    return array if len(array) == 1 else jnp.concatenate([array, array[-1:]])


def scan_steps(step, start, steps, reverse: bool = False):
    """`jax.lax.scan` over arrays (steps+1, ...); an array of length one is for all steps."""
    arrays, structure = jax.tree.flatten(steps)
    of_all = [x[0] if len(x) == 1 else None for x in arrays]
    of_steps = [x if len(x) > 1 else None for x in arrays]

    def run(carry, of_step):
        leaves = [x if y is None else y for x, y in zip(of_all, of_step, strict=True)]
        return step(carry, jax.tree.unflatten(structure, leaves))

    return jax.lax.scan(run, start, of_steps, reverse=reverse)


def _recursion(solve, pi0: Array, steps: _Steps, rounds: Array | int) -> tuple[Array, Array]:
    """Solve step after step, each in some rounds: pi, and c with a zero at the end (steps+1, 3)."""
    count, zeros = len(steps.g), jnp.zeros((len(steps.g) + 1, *pi0.shape), pi0.dtype)

    def run(state):
        k, i, c, pis, cs = state
        # The momentum is read where it was written: to carry it too would make the loop larger.
        g, twice_J, inverse, r, impulse, pi = jax.tree.map(
            lambda x: x[0] if len(x) == 1 else jax.lax.dynamic_index_in_dim(x, k, 0, False),
            (*steps, pis),
        )
        pi, c = Vec3.of(pi, axis=0), Vec3.of(c, axis=0)
        r = None if r is None else Vec3.of(r, axis=0)
        # Matrices are put together anew in each step: the loop then holds two small arrays.
        twice_J, inverse = Mat3.of_six(twice_J, axis=0), Mat3.of_six(inverse, axis=0)
        c, solved = solve(twice_J, inverse, g * pi, r, c, i == 0)
        after = Quaternion(1.0, c).rotate_back(pi).array(axis=0)
        # NaN at the start of the next step, if this step has not been solved.
        after = after if solved is None else jnp.where(solved, after, jnp.nan)
        after = after if impulse is None else after + impulse
        pis = jax.lax.dynamic_update_index_in_dim(pis, after, k + 1, 0)
        c = c.array(axis=0)
        cs = jax.lax.dynamic_update_index_in_dim(cs, c, k, 0)
        last = i == rounds - 1
        return k + last.astype(k.dtype), jnp.where(last, 0, i + 1), c, pis, cs

    start = jnp.int32(0), jnp.int32(0), zeros[0], zeros.at[0].set(pi0), zeros
    return jax.lax.while_loop(lambda state: state[0] < count, run, start)[-2:]


def _undamped(twice_J, inverse, p, r, c, first):
    momentum = with_rotors(materialise(p) if r is None else p, r)
    guess = third_order_guess(inverse, momentum)
    c = materialise(jax.tree.map(partial(jnp.where, first), guess, c))
    # A materialised residual would make the loop too large to be compiled whole; where a thin
    # body needs one, the check of all residuals finds that out.
    c, last = iterate_undamped(twice_J, momentum, c, ITERATIONS, materialise_residual=False)
    return c, ~is_truncated(last)


def _damped(newton_iters, twice_J, inverse, p, r, c, first):
    r = None if r is None else r.array(axis=0)
    c = iterate_damped(twice_J.array(axis=0), p.array(axis=0), r, newton_iters)
    return Vec3.of(c, axis=0), None


def _attitudes(c: Array) -> Array:
    """Products of the steps as quaternions wxyz (steps+1, 4, *batch).

    They do not lose orthogonality as products of matrices would; the rounding of their norms
    does no harm, as whoever makes a matrix of them divides by the square of the norm.
    """

    def multiply(q, c):
        v = Vec3.of(c, axis=0)
        # Else XLA would compute it for each component.
        w = jax.lax.optimization_barrier(jax.lax.rsqrt(1 + v.dot(v)))
        after = Quaternion.of(q, axis=0) * Quaternion(1.0, v)
        return w[None] * after.array(axis=0), q

    one = jnp.zeros((4, *c.shape[2:]), c.dtype).at[0].set(1)
    return jax.lax.scan(multiply, one, c)[1]
