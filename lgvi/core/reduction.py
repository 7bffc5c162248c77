r"""Trajectories by reduction and reconstruction.

Under prescribed torques the momentum does not depend on the attitude. So the steps are solved in
a loop over the momentum alone (reduction), small enough for XLA to compile as a whole, and
the attitudes follow from the solutions in a second such loop (reconstruction). Both
store the state before each step and run one empty step more, which costs less than putting
the last state behind the others.

The first loop solves every step with two Newton iterations without damping, enough for
$|h J^{-1}\pi|$ up to about 0.25. All steps are then checked together; where one is not solved to
rounding, all of it is solved again with four, enough up to about 0.9, and where that
does not do either, by the damped solver.

A batch is kept on the last axes of all arrays, so that a component of all its bodies is
one contiguous vector.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import components as xyz
from . import rotations
from .components import Matrix
from .equation import residual_norm, rounding
from .newton import damped, is_truncated, last_step, replace_if, undamped

TRAJECTORY_ITERATIONS = 2, 4


def solve_steps(
    newton_iters: int,
    pi0: Array,
    J: Array,
    h: Array,
    rotor: Array,
    impulses: Array | None = None,
):
    """Attitudes relative to the first, momenta, Rodrigues vectors and norms of the residuals.

    `J` (1, 3, 3, *batch) is one inertia for all steps, or (steps, 3, 3, *batch) one for each;
    `rotor` (1, 3, *batch) or (steps, 3, *batch) likewise is the momentum of rotors, or there are
    none, (0, 3, *batch).
    """
    shapes = [pi0.shape, J.shape[2:], (3, *h.shape[1:]), rotor.shape[1:]]
    if impulses is not None:
        shapes.append(impulses.shape[1:])
        impulses = with_empty_step(impulses)
    pi0 = jnp.broadcast_to(pi0, jnp.broadcast_shapes(*shapes))
    J = with_value_of_empty_step(J)
    trace = jnp.trace(J, axis1=1, axis2=2)
    J, g = J / trace[:, None, None], with_empty_step(h) / trace
    J_ = xyz.split_matrix(J, axis=1)
    r_, of_rotor = None, []
    if len(rotor) > 0:
        of_rotor = [with_value_of_empty_step(rotor)]
        r_ = xyz.scale(g, xyz.split(*of_rotor, axis=1))

    def attempt(solver, given, iterations, pi0):
        given = *given, *of_rotor
        pi, c, *last = _recursion(solver, given, pi0, g, impulses)
        p, v = xyz.scale(g, xyz.split(pi, axis=1)), xyz.split(c, axis=1)
        residual = residual_norm(J_, p, v, r_)
        short = ~(residual <= rounding(v, r_))  # True for NaN
        if iterations is not None:
            last = last or [last_step(J_, xyz.inverse(J_), p, r_, v, iterations)]
            short |= is_truncated(p, r_, v, *last)
        return pi, c, residual, jnp.any(short)

    attempts = [
        partial(attempt, *_undamped_solver(J_, count, alone=len(J) == 1 and not of_rotor), count)
        for count in TRAJECTORY_ITERATIONS
        if count <= newton_iters
    ]
    first, *others = [*attempts, partial(attempt, *_damped_solver(J, newton_iters), None)]
    solved = first(pi0)
    for other in others:
        solved = replace_if(solved[3], solved, other, pi0)
    pi, c, residual, _ = solved
    return _attitudes(c), pi, c, jnp.abs(trace) * residual


def with_empty_step(array: Array) -> Array:
    return jnp.pad(array, [(0, 1)] + [(0, 0)] * (array.ndim - 1))


def with_value_of_empty_step(array: Array) -> Array:
    return array if len(array) == 1 else jnp.concatenate([array, array[-1:]])


def _recursion(solver, given, pi0, g, impulses):
    """Solve step after step: pi, c (steps+1, 3, *batch) and what else the solver returns.

    The solver is given what belongs to a step of `given`, or what belongs to all of them.
    """
    of_all = [x[0] for x in given]
    of_steps = [x if len(x) > 1 else None for x in given]

    def step(pi, inputs):
        g, impulse, of_step = inputs
        of_step = [x if y is None else y for x, y in zip(of_all, of_step, strict=True)]
        v = xyz.split(pi, axis=0)
        c, *more = solver(of_step, g, xyz.scale(g, v))
        after = xyz.join(rotations.turn_back(c, v), axis=0)
        # Stored as one array: with two of them the loop would be too large.
        return after if impulse is None else after + impulse, (pi, jnp.stack([*c, *more]))

    pi, stored = jax.lax.scan(step, pi0, (g, impulses, of_steps))[1]
    return pi, stored[:, :3], *(stored[:, i] for i in range(3, stored.shape[1]))


def _damped_solver(J, newton_iters):
    def solver(given, g, p):
        J, *rotor = given
        r = jnp.expand_dims(g, 0) * rotor[0] if rotor else None
        return [xyz.split(damped(J, xyz.join(p, axis=0), r, newton_iters), axis=0)]

    return solver, [J]


def _undamped_solver(J, iterations, alone):
    # Otherwise the loop would be too large to be compiled whole if it stored the last step too.
    has_room = alone and iterations == TRAJECTORY_ITERATIONS[0]

    def solver(given, g, p):
        j, i, *rotor = given
        r = xyz.scale(g, xyz.split(rotor[0], axis=0)) if rotor else None
        # Matrices are put together anew in each step: the loop then holds two small arrays. A
        # materialised residual would make it too large to be compiled whole; where a thin body
        # needs one, the check of all residuals finds that out.
        J, inverse = _symmetric(j), _symmetric(i)
        solved = undamped(J, inverse, p, r, iterations, materialise_residual=False)
        return solved if has_room else solved[:1]

    return solver, [_six(J), _six(xyz.inverse(J))]


def _six(S: Matrix) -> Array:
    (a, d, e), (_, b, f), (_, _, c) = S
    return jnp.stack([a, b, c, d, e, f], axis=1)


def _symmetric(six: Array) -> Matrix:
    a, b, c, d, e, f = six
    return (a, d, e), (d, b, f), (e, f, c)


def _attitudes(c: Array) -> Array:
    """Products of the steps as quaternions wxyz (steps+1, 4, *batch).

    They do not lose orthogonality as products of matrices would; the rounding of their norms
    does no harm, as whoever makes a matrix of them divides by the square of the norm.
    """
    v = xyz.split(c, axis=1)
    w = jax.lax.rsqrt(1 + xyz.dot(v, v))
    steps = rotations.join((w, xyz.scale(w, v)), axis=1)

    def multiply(q, step):
        after = rotations.multiply(rotations.split(q, axis=0), rotations.split(step, axis=0))
        return rotations.join(after, axis=0), q

    one = jnp.zeros(steps.shape[1:], c.dtype).at[0].set(1)
    even = steps if len(steps) % 2 == 0 else with_empty_step(steps)
    return jax.lax.scan(multiply, one, even, unroll=2)[1][: len(steps)]
