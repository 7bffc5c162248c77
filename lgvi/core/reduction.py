r"""Whole trajectories by reduction and reconstruction, and their derivative.

Under prescribed torques the momentum does not depend on the attitude. So the steps are solved in
a loop over the momentum alone (reduction), small enough for XLA to compile as a whole, and
the attitudes follow from the solutions in a second such loop (reconstruction). Both
store the state before each step and run one empty step more, which costs less than putting
the last state behind the others.

The first loop solves every step with two Newton iterations without damping, which reach
rounding for $|h J^{-1}\pi|$ up to about 0.3. All residuals are then looked at together; where
one is short of rounding, the whole trajectory is solved again with four, enough up to about
0.8, and where that does not do either, by the damped solver.

A batch is kept on the last axes of all arrays, so that a component of all its bodies is
one contiguous vector.
"""

from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

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
from .moser_veselov import rodrigues_vector

UNDAMPED_ITERATIONS = 2, 4


class Motion(NamedTuple):
    """A trajectory and how its steps were solved."""

    R: Array  # attitudes (steps+1, 3, 3)
    pi: Array  # body momenta at the start of each step's rotation, and the last (steps+1, 3)
    q: Array  # attitudes relative to the initial one, as quaternions wxyz (steps+1, 4)
    c: Array  # Rodrigues vectors of the steps, and zero (steps+1, 3)
    residual_norm: Array  # of the steps, and zero (steps+1,); its tangent is zero


@partial(jax.custom_jvp, nondiff_argnums=(5,))
def motion(
    R0: Array, pi0: Array, J: Array, h: Array, impulses: Array | None, newton_iters: int
) -> Motion:
    """Motion from the attitude `R0` and the momentum `pi0` by steps of sizes `h` (steps,).

    `J` is symmetric; `impulses` (steps, 3) are added to the body momentum after each step.
    """
    q, pi, c, residual_norm = _batchable(newton_iters)(pi0, J, h, impulses)
    return Motion(_turn_rows(R0, q), pi, q, c, residual_norm)


@motion.defjvp
def _motion_jvp(newton_iters, primals, tangents):
    r"""Tangent of all steps at once, but for a linear recurrence and a running sum.

    With $p = h\pi$, $\eta = \operatorname{vee}(dF\,F^T)$ and $\zeta$ the sum of the turns
    $Q\eta$ of the steps before:

    $\eta = K\,[\tfrac12(I-\hat c+cc^T)\,dp - dJ\,c]$, $K = \frac{2}{1+c\cdot c}(I+\hat c)A^{-1}$,
    $d(F^T\pi) = F^T(d\pi + \pi\times\eta)$, $dR = (dR_0 + R_0\hat\zeta)\,Q$.
    """
    R0, _, J, h, _ = primals
    dR0, dpi0, dJ, dh, dimpulses = tangents
    out = motion(*primals, newton_iters)
    # The equation is the same for J and h divided by one number, which need not be differentiated.
    trace = jax.lax.stop_gradient(jnp.trace(J))
    J, dJ = xyz.split_matrix(J / trace), xyz.split_matrix(dJ / trace)
    g, dg = (_with_empty_step(size / trace) for size in (h, dh))

    c, pi, q = xyz.split(out.c), xyz.split(out.pi), _quaternion(out.q)
    Q = _rotation(*q)
    FT = _transposed_cayley(c)
    K = xyz.multiply(_cayley_factor(c), xyz.inverse(jacobian(J, xyz.scale(g, pi), c)))
    turned = xyz.multiply(K, xyz.scale_matrix(g, _half_divided(c)))
    # d pi_next = M d pi + source
    M = xyz.multiply(FT, xyz.add_identity(xyz.cross_columns(pi, turned)))
    given = xyz.subtract(xyz.scale(0.5 * dg, divided(c, pi)), xyz.apply(dJ, c))
    source = xyz.apply(FT, xyz.cross(pi, xyz.apply(K, given)))
    if dimpulses is not None:
        source = xyz.add(source, xyz.split(_with_empty_step(dimpulses)))

    def recurrence(dpi: Vector, step: tuple[Matrix, Vector]):
        M, source = step
        return xyz.add(xyz.apply(M, dpi), source), dpi

    _, dpi = jax.lax.scan(recurrence, xyz.split(dpi0), (M, source))
    eta = xyz.apply(K, xyz.add(xyz.scale(0.5 * g, divided(c, dpi)), given))
    dpi = xyz.join(dpi)

    # In the space frame the turns of the steps add up.
    turns = xyz.apply(Q, eta)
    start = xyz.split(jnp.zeros_like(dpi0))
    _, zeta = jax.lax.scan(lambda zeta, turn: (xyz.add(zeta, turn), zeta), start, turns)
    turning = xyz.cross_rows(xyz.split_matrix(R0), zeta)
    dR = xyz.multiply(xyz.add_matrices(xyz.split_matrix(dR0), turning), Q)
    # The last two serve derivatives of this rule.
    dq, dc = _quaternion_rate(zeta, q), xyz.scale(0.5, divided(c, eta))
    return out, Motion(
        xyz.join_matrix(dR),
        dpi,
        dq,
        xyz.join(dc),
        jnp.zeros_like(out.residual_norm),
    )


@cache
def _batchable(newton_iters: int):
    """The motion with any number of batch axes, last in all arrays."""

    @jax.custom_batching.custom_vmap
    def batchable(pi0, J, h, impulses):
        return _reduced(pi0, J, h, impulses, newton_iters)

    @batchable.def_vmap
    def _(axis_size, in_batched, *arguments):
        def to_the_end(array, batched):
            return jnp.moveaxis(array, 0, -1) if batched else array[..., None]

        pi0, J, h, impulses = jax.tree.map(to_the_end, arguments, tuple(in_batched))
        pi0 = jnp.broadcast_to(pi0, (*pi0.shape[:-1], axis_size))
        out = batchable(pi0, J, h, impulses)
        return tuple(jnp.moveaxis(x, -1, 0) for x in out), (True,) * len(out)

    return batchable


def _reduced(pi0: Array, J: Array, h: Array, impulses: Array | None, newton_iters: int):
    trace = jnp.trace(J)
    J, g = J / trace[None, None], _with_empty_step(h / trace[None])
    impulses = None if impulses is None else _with_empty_step(impulses)

    def attempt(solver, pi0):
        pi, c = _recursion(solver, pi0, g, impulses)
        p, v = xyz.scale(g, xyz.split(pi, axis=1)), xyz.split(c, axis=1)
        residual = residual_norm(xyz.split_matrix(J[None], axis=1), p, v)
        return pi, c, residual, jnp.all(residual <= rounding(v))

    def damped(pi0):
        solver = partial(rodrigues_vector, newton_iters=newton_iters)
        for _ in pi0.shape[1:]:
            solver = jax.vmap(solver, in_axes=-1, out_axes=-1)
        whole = jnp.broadcast_to(J, (3, *pi0.shape))
        return attempt(lambda p: xyz.split(solver(whole, xyz.join(p, axis=0)), axis=0), pi0)

    budgets = [count for count in UNDAMPED_ITERATIONS if count <= newton_iters]
    first, *others = [partial(attempt, _undamped_solver(J, count)) for count in budgets] + [damped]
    solved = first(pi0)
    for other in others:
        # A loop that runs at most once, not a conditional: under vmap a conditional always runs
        # both branches. What it does must depend on its state, or XLA would do it beforehand.
        solved, _ = jax.lax.while_loop(
            lambda state: state[1],
            lambda state, other=other: (other(state[0][0][0]), jnp.array(False)),
            (solved, ~solved[3]),
        )
    pi, c, residual, _ = solved
    return _attitudes(c), pi, c, jnp.abs(trace[None]) * residual


def _with_empty_step(array: Array) -> Array:
    return jnp.pad(array, [(0, 1)] + [(0, 0)] * (array.ndim - 1))


def _recursion(solver, pi0, g, impulses):
    """Solve step after step: pi and c, both (steps+1, 3, *batch)."""

    def step(pi, inputs):
        g, impulse = inputs
        v = xyz.split(pi, axis=0)
        c = solver(xyz.scale(g, v))
        after = xyz.join(xyz.apply(_transposed_cayley(c), v), axis=0)
        return after if impulse is None else after + impulse, (pi, xyz.join(c, axis=0))

    return jax.lax.scan(step, pi0, (g, impulses))[1]


def _undamped_solver(J, iterations):
    j, i = _six(J), _six(xyz.join_matrix(xyz.inverse(xyz.split_matrix(J, axis=0)), axis=0))

    def solve(p):
        J = _symmetric(j)
        p = materialise(p)
        c = materialise(third_order_guess(partial(xyz.apply, _symmetric(i)), p))
        for _ in range(iterations):
            step = xyz.solve(jacobian(J, p, c), negative_residual(J, p, c))
            # XLA would otherwise compute each iterate anew for every use of a component.
            c = materialise(xyz.add(c, step))
        return c

    return solve


def _six(S: Array) -> Array:
    return S[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]


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
    steps = jnp.stack([w, *xyz.scale(w, v)], axis=1)

    def turn(q, step):
        (w, x, y, z), (a, b, c, d) = q, step
        after = (w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c)
        after += (w * c + y * a + z * b - x * d, w * d + z * a + x * c - y * b)
        return jnp.stack(after), q

    one = jnp.zeros(steps.shape[1:], c.dtype).at[0].set(1)
    even = steps if len(steps) % 2 == 0 else _with_empty_step(steps)
    return jax.lax.scan(turn, one, even, unroll=2)[1][: len(steps)]


def _turn_rows(R: Array, q: Array) -> Array:
    """R Q for many quaternions (..., 4), all rows of R in one pass."""
    w, v = _quaternion(q[..., None, :])
    rows = xyz.split(R[(None,) * (q.ndim - 1)])
    s = 2 / (w * w + xyz.dot(v, v))
    turned = xyz.cross(v, rows)
    turned = xyz.subtract(xyz.cross(v, turned), xyz.scale(w, turned))
    return xyz.join(xyz.add(rows, xyz.scale(s, turned)))


def _quaternion(q: Array) -> tuple[Array, Vector]:
    """Scalar and vector part of quaternions (..., 4)."""
    return q[..., 0], xyz.split(q[..., 1:])


def _rotation(w: Array, v: Vector) -> Matrix:
    """Rotation matrix of a quaternion of any norm."""
    s = 2 / (w * w + xyz.dot(v, v))
    return _rotation_polynomial(s * w, s, v)


def _transposed_cayley(c: Vector) -> Matrix:
    s = 2 / (1 + xyz.dot(c, c))
    return _rotation_polynomial(-s, s, c)


def _rotation_polynomial(a, b, v: Vector) -> Matrix:
    """I + a hat(v) + b hat(v)^2."""
    x, y, z = v
    return (
        (1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y),
        (b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x),
        (b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)),
    )


def _quaternion_rate(zeta: Vector, q: tuple[Array, Vector]) -> Array:
    """Tangent of a quaternion that turns by `zeta` in the frame on its left."""
    w, v = q
    vector = xyz.scale(0.5, xyz.add(xyz.scale(w, zeta), xyz.cross(zeta, v)))
    return jnp.stack([-0.5 * xyz.dot(zeta, v), *vector], axis=-1)


def _cayley_factor(c: Vector) -> Matrix:
    """2/(1 + c.c) (I + hat(c))."""
    s = 2 / (1 + xyz.dot(c, c))
    x, y, z = xyz.scale(s, c)
    return (s, -z, y), (z, s, -x), (-y, x, s)


def _half_divided(c: Vector) -> Matrix:
    """(I - hat(c) + c c^T)/2."""
    x, y, z = c
    return (
        ((1 + x * x) / 2, (x * y + z) / 2, (x * z - y) / 2),
        ((x * y - z) / 2, (1 + y * y) / 2, (y * z + x) / 2),
        ((x * z + y) / 2, (y * z - x) / 2, (1 + z * z) / 2),
    )
