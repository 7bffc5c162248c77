r"""Whole trajectories by reduction and reconstruction, and their derivative.

Under prescribed torques the momentum does not depend on the attitude. So the steps are solved in
a loop over the momentum alone (reduction), small enough for XLA to compile as a whole, and
the attitudes follow from the solutions in a second loop (reconstruction). What can be done for
all steps at once is done outside of the loops.

The loop solves every step with three Newton iterations without damping, which reach rounding
for $|h J^{-1}\pi|$ up to about 0.5. All residuals are then looked at together; where one
is short of rounding, the damped solver does the trajectory again.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import components as xyz
from .components import Matrix, Vector
from .moser_veselov import (
    divided,
    jacobian,
    materialise,
    negative_residual,
    residual_norm,
    rodrigues_vector,
    rounding,
    third_order_guess,
)

UNDAMPED_ITERATIONS = 3


class Impulses(NamedTuple):
    """Changes of the body momentum at the two ends of each step, (steps, 3) each."""

    first: Array
    last: Array


class Motion(NamedTuple):
    """A trajectory, up to the initial attitude."""

    Q: Array  # attitudes relative to the initial one (steps+1, 3, 3)
    pi: Array  # body momenta (steps+1, 3)
    c: Array  # Rodrigues vectors of the steps (steps, 3)
    residual_norm: Array  # (steps,)


@partial(jax.custom_jvp, nondiff_argnums=(4,))
def motion(J: Array, pi0: Array, h: Array, impulses: Impulses | None, newton_iters: int) -> Motion:
    """Motion from the momentum `pi0` by steps of sizes `h` (steps,); `J` is symmetric."""
    trace = jnp.trace(J)
    J, g = J / trace, h / trace
    damped = partial(_recursion, partial(rodrigues_vector, newton_iters=newton_iters), J)
    if newton_iters < UNDAMPED_ITERATIONS:
        c, pi = damped(pi0, g, impulses)
    else:
        c, pi = _recursion(_undamped_solver(J), J, pi0, g, impulses)
        fine = jnp.all(_residual_norms(J, g, impulses, c, pi) <= rounding(c))
        # A loop, not a conditional: under vmap a conditional always runs both branches.
        c, pi, _ = jax.lax.while_loop(
            lambda state: ~state[2],
            lambda state: (*damped(pi0, g, impulses), jnp.array(True)),
            (c, pi, fine),
        )
    residuals = jnp.abs(trace) * _residual_norms(J, g, impulses, c, pi)
    return Motion(_attitudes(c), pi, c, residuals)


@motion.defjvp
def _motion_jvp(newton_iters, primals, tangents):
    r"""Tangent of all steps at once, but for a linear recurrence and a running sum.

    With $p = h\pi^+$, $\pi^+$ the momentum after the first impulse, and
    $\eta = \operatorname{vee}(F^T dF)$:

    $\eta = \frac{2}{1+c\cdot c}(I-\hat c)A^{-1}[\tfrac12(I-\hat c+cc^T)\,dp - dJ\,c]$,
    $d(F^T\pi^+) = F^Td\pi^+ + (F^T\pi^+)\times\eta$.
    """
    J, pi0, h, impulses = primals
    dJ, dpi0, dh, dimpulses = tangents
    out = motion(J, pi0, h, impulses, newton_iters)
    # The equation is the same for J and h divided by one number, which need not be differentiated.
    trace = jax.lax.stop_gradient(jnp.trace(J))
    J, dJ, g, dg = J / trace, dJ / trace, h / trace, dh / trace

    c, pi = xyz.split(out.c), out.pi[:-1]
    pi = xyz.split(pi if impulses is None else pi + impulses.first)
    p = xyz.scale(g, pi)
    C, FT = _cayley_factor(c), _transposed_cayley(c)
    inverse = xyz.inverse(jacobian(xyz.split_matrix(J), p, c))
    K = xyz.multiply(C, inverse)
    E = xyz.multiply(K, _half_divided(c))  # eta = E dp - K dJ c

    right = xyz.subtract(
        xyz.apply(E, xyz.scale(dg, pi)), xyz.apply(K, xyz.apply(xyz.split_matrix(dJ), c))
    )
    E = xyz.scale_matrix(g, E)  # from here on eta = E d pi + right
    if dimpulses is not None:
        right = xyz.add(right, xyz.apply(E, xyz.split(dimpulses.first)))
    pi_next = xyz.apply(FT, pi)
    # d pi_next = (FT + hat(pi_next) E) d pi + source
    M = xyz.add_matrices(FT, xyz.cross_columns(pi_next, E))
    source = xyz.cross(pi_next, right)
    if dimpulses is not None:
        source = xyz.add(source, xyz.apply(FT, xyz.split(dimpulses.first)))
        source = xyz.add(source, xyz.split(dimpulses.last))

    def recurrence(dpi, step):
        M, source = step
        M, v = xyz.split_matrix(M), xyz.split(dpi)
        return xyz.join(xyz.add(xyz.apply(M, v), xyz.split(source))), dpi

    steps = (xyz.join_matrix(M), xyz.join(source))
    last, dpis = jax.lax.scan(recurrence, dpi0, steps)
    eta = xyz.add(xyz.apply(E, xyz.split(dpis)), right)

    # In the space frame the turns of the steps add up.
    turns = xyz.join(xyz.apply(xyz.split_matrix(out.Q[1:]), eta))
    last_zeta, zeta = jax.lax.scan(
        lambda zeta, turn: (zeta + turn, zeta), jnp.zeros_like(dpi0), turns
    )
    zeta = xyz.split(jnp.concatenate([zeta, last_zeta[None]]))
    dQ = xyz.cross_columns(zeta, xyz.split_matrix(out.Q))
    dc = xyz.scale(0.5, divided(xyz.scale(-1.0, c), eta))
    dmotion = Motion(
        xyz.join_matrix(dQ),
        jnp.concatenate([dpis, last[None]]),
        xyz.join(dc),
        jnp.zeros_like(out.residual_norm),
    )
    return out, dmotion


def _recursion(solver, J, pi0, g, impulses):
    """Solve step after step: c (steps, 3) and pi (steps+1, 3)."""

    def step(pi, inputs):
        g, impulses = inputs
        first = pi if impulses is None else pi + impulses.first
        c = solver(J, g * first)
        v = xyz.split(c)
        after = xyz.join(xyz.apply(_transposed_cayley(v), xyz.split(first)))
        return after if impulses is None else after + impulses.last, (c, pi)

    last, (c, pi) = jax.lax.scan(step, pi0, (g, impulses))
    return c, jnp.concatenate([pi, last[None]])


def _undamped_solver(J):
    j, i = _six(J), _six(jnp.linalg.inv(J))

    def solve(_, p):
        J = _symmetric(j)
        p = materialise(xyz.split(p))
        c = materialise(third_order_guess(partial(xyz.apply, _symmetric(i)), p))
        for _ in range(UNDAMPED_ITERATIONS):
            step = xyz.solve(jacobian(J, p, c), negative_residual(J, p, c))
            # XLA would otherwise compute each iterate anew for every use of a component.
            c = materialise(xyz.add(c, step))
        return xyz.join(c)

    return solve


def _six(S: Array) -> Array:
    return S[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]


def _symmetric(six: Array) -> Matrix:
    a, b, c, d, e, f = six
    return (a, d, e), (d, b, f), (e, f, c)


def _residual_norms(J, g, impulses, c, pi):
    pi = pi[:-1] if impulses is None else pi[:-1] + impulses.first
    p = xyz.scale(g, xyz.split(pi))
    return residual_norm(xyz.split_matrix(J), p, xyz.split(c))


def _attitudes(c: Array) -> Array:
    """Products of the steps as unit quaternions, which do not lose orthogonality."""
    x, y, z = xyz.split(c)
    w = jax.lax.rsqrt(1 + x * x + y * y + z * z)

    def product(q, u):
        a, x, y, z = q
        b, e, f, g = u
        return jnp.stack(
            [
                a * b - x * e - y * f - z * g,
                a * e + x * b + y * g - z * f,
                a * f + y * b + z * e - x * g,
                a * g + z * b + x * f - y * e,
            ]
        ), q

    one = jnp.zeros((4,), c.dtype).at[0].set(1)
    last, q = jax.lax.scan(product, one, jnp.stack([w, w * x, w * y, w * z], axis=-1))
    q = jnp.concatenate([q, last[None]])
    w, v = q[..., 0], xyz.split(q[..., 1:])
    # Dividing by the square of the norm, the rounding of the products does no harm.
    s = 2 / (w * w + xyz.dot(v, v))
    return xyz.join_matrix(_rotation(s * w, s, v))


def _transposed_cayley(c: Vector) -> Matrix:
    s = 2 / (1 + xyz.dot(c, c))
    return _rotation(-s, s, c)


def _rotation(a, b, v: Vector) -> Matrix:
    """I + a hat(v) + b hat(v)^2."""
    x, y, z = v
    return (
        (1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y),
        (b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x),
        (b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)),
    )


def _cayley_factor(c: Vector) -> Matrix:
    """2/(1 + c.c) (I - hat(c))."""
    s = 2 / (1 + xyz.dot(c, c))
    x, y, z = xyz.scale(s, c)
    return (s, z, -y), (-z, s, x), (y, -x, s)


def _half_divided(c: Vector) -> Matrix:
    """(I - hat(c) + c c^T)/2."""
    x, y, z = c
    return (
        ((1 + x * x) / 2, (x * y + z) / 2, (x * z - y) / 2),
        ((x * y - z) / 2, (1 + y * y) / 2, (y * z + x) / 2),
        ((x * z + y) / 2, (y * z - x) / 2, (1 + z * z) / 2),
    )
