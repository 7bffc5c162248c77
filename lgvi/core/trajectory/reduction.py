r"""Trajectories by reduction and reconstruction.

Under prescribed torques the momentum does not depend on the attitude. So the steps are solved in
a loop over the momentum alone (reduction), small enough for XLA to compile as a whole, and
the attitudes follow from the solutions in a second such loop (reconstruction). Both
store the state before each step and run one empty step more, which costs less than putting
the last state behind the others.

The first loop solves every step with two Newton iterations without damping, enough for
$|h J^{-1}\pi|$ up to about 0.25. All steps are then checked together; where one is not solved to
rounding, all of it is solved again with four, enough up to about 0.9, and where that
does not do either, by the damped solver. A root of another branch is only reported, as full steps
from the third-order guess have not been seen to reach one.

A batch is kept on the last axes of all arrays, so that a component of all its bodies is
one contiguous vector.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.quaternions import Quaternion
from ..kernels.vectors import Mat3, Vec3
from ..step.equation import residual_norm, rounding
from ..step.newton import is_truncated, iterate_damped, iterate_undamped
from .inertias import of_steps

TRAJECTORY_ITERATIONS = 2, 4


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
        impulses = with_empty_step(impulses)
    pi0 = jnp.broadcast_to(pi0, jnp.broadcast_shapes(*shapes))
    J = with_value_of_empty_step(J)
    rotors = [with_value_of_empty_step(rotor)] if len(rotor) > 0 else []
    trace = jnp.trace(J, axis1=1, axis2=2)
    J, g = J / trace[:, None, None], with_empty_step(h) / trace
    r = [(g * Vec3.of(x, axis=1)).array(axis=1) for x in rotors]
    counts = [count for count in TRAJECTORY_ITERATIONS if count <= newton_iters]
    solvers = [
        *(partial(_undamped, iterations=count) for count in counts),
        partial(_damped, newton_iters=newton_iters),
    ]
    J_ = Mat3.of(J, axis=1)
    six = jax.lax.optimization_barrier(J_.six(axis=1))  # or its entries would be arrays of the loop
    given = [g, impulses, six, J_.inverse().six(axis=1), *r]
    first, *others = (partial(_recursion, solver, pi0, given) for solver in solvers)

    def check(pi, c):
        p, c_ = g * Vec3.of(pi, axis=1), Vec3.of(c, axis=1)
        r_ = Vec3.of(r[0], axis=1) if r else None
        residual = residual_norm(Mat3.of_six(six, axis=1), p, c_, r_)
        return pi, c, residual, ~jnp.all(residual <= rounding(c_, r_))  # True for NaN

    def attempt(state):
        number, *_ = state
        *solution, short = check(*jax.lax.switch(number, others))
        return number + 1, *solution, short & (number < len(others) - 1)

    # The first try is not in the loop, which then takes no time if the try was good.
    pi, c, residual, short = check(*first())
    if others:
        state = jnp.array(0), pi, c, residual, short
        _, pi, c, residual, _ = jax.lax.while_loop(lambda state: state[-1], attempt, state)
    return _attitudes(c), pi, c, jnp.abs(trace) * residual


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
        given = [x if y is None else y for x, y in zip(of_all, of_step, strict=True)]
        return step(carry, jax.tree.unflatten(structure, given))

    return jax.lax.scan(run, start, of_steps, reverse=reverse)


def _recursion(solver, pi0, steps):
    """Solve step after step: pi and c (steps+1, 3, *batch)."""

    def step(pi, of_step):
        g, impulse, J, inverse, *r = of_step
        v, r = Vec3.of(pi, axis=0), Vec3.of(r[0], axis=0) if r else None
        # Matrices are put together anew in each step: the loop then holds two small arrays.
        J, inverse = Mat3.of_six(J, axis=0), Mat3.of_six(inverse, axis=0)
        c, solved = solver(J, inverse, g * v, r)
        after = Quaternion(1.0, c).rotate_back(v).array(axis=0)
        # NaN at the start of the next step, if this step has not been solved.
        after = after if solved is None else jnp.where(solved, after, jnp.nan)
        return after if impulse is None else after + impulse, (pi, c.array(axis=0))

    return scan_steps(step, pi0, steps)[1]


def _undamped(J, inverse, p, r, iterations):
    # A materialised residual would make the loop too large to be compiled whole; where a thin
    # body needs one, the check of all residuals finds that out.
    c, last = iterate_undamped(J, inverse, p, r, iterations, materialise_residual=False)
    return c, ~is_truncated(last)


def _damped(J, _, p, r, newton_iters):
    r = None if r is None else r.array(axis=0)
    c = iterate_damped(J.array(axis=0), p.array(axis=0), r, newton_iters)
    return Vec3.of(c, axis=0), None


def _attitudes(c: Array) -> Array:
    """Products of the steps as quaternions wxyz (steps+1, 4, *batch).

    They do not lose orthogonality as products of matrices would; the rounding of their norms
    does no harm, as whoever makes a matrix of them divides by the square of the norm.
    """
    v = Vec3.of(c, axis=1)
    w = jax.lax.rsqrt(1 + v.dot(v))
    steps = Quaternion(w, w * v).array(axis=1)

    def multiply(q, step):
        after = Quaternion.of(q, axis=0) * Quaternion.of(step, axis=0)
        return after.array(axis=0), q

    one = jnp.zeros_like(steps[0]).at[0].set(1)
    even = steps if len(steps) % 2 == 0 else with_empty_step(steps)
    return jax.lax.scan(multiply, one, even, unroll=2)[1][: len(steps)]
