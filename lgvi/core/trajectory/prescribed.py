"""Motion without torque, or under torques that do not depend on the motion."""

from collections.abc import Callable
from itertools import accumulate
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.finite import finite, multiply, without_nan
from ..kernels.primitives import Arrays, differentiable
from ..kernels.quaternions import Quaternion, rotate_rows, tangent_of_turn
from ..kernels.vectors import Mat3, Vec3
from ..step.equation import is_on_branch_of_identity, rounding
from ..step.modified_inertia import (
    modified_inertia,
    modified_inertia_terms,
    turns_less_than_a_right_angle,
)
from .adjoint import Motion, propagate_variation
from .convergence import SolvedDrifts
from .inertias import of_steps
from .kicks import with_arguments
from .reduction import solve_steps
from .splitting import Inputs, composition_weights


def simulate_prescribed(
    R0: Array,
    pi0: Array,
    J: Array,
    h: Array,
    torques: tuple[Array, Array] | None,
    rotor: Array | None,
    newton_iters: int,
    factors: Array | None = None,
) -> tuple[Array, Array, SolvedDrifts]:
    """Attitudes (steps+1, 3, 3), momenta (steps+1, 3) and drifts of steps of sizes `h` (steps,).

    `J` is one inertia (3, 3), or one for each step (steps, 3, 3), or with `factors` (steps, n)
    matrices (n, 3, 3) of which the inertias are sums. `torques` (steps, 3) act at the start and at
    the end of each step; `rotor` (3,) or (steps, 3) is the momentum of rotors.
    """
    impulses, before = None, jnp.zeros((1, 3), pi0.dtype)
    if torques is not None:
        half = h[:, None] / 2
        # Each step's rotation starts with the momentum after its first impulse.
        before = jnp.pad(multiply(half, torques[0]), [(0, 1), (0, 0)])
        impulses = multiply(half, torques[1]) + before[1:]
    out = propagate(R0, pi0 + before[0], J, factors, h, impulses, rotor, newton_iters)
    pis = out.pi
    if torques is not None:
        pis = (pis - before).at[0].set(pi0)
    J = J if factors is None else of_steps(J, factors)
    trace, of_body, r = jnp.trace(J, axis1=-2, axis2=-1), out.pi[:-1], None
    if rotor is not None:
        rotor = jnp.broadcast_to(rotor, (len(h), 3))
        of_body, r = of_body - rotor, h / trace * Vec3.of(rotor)
    unit, c = Mat3.of(J / trace[..., None, None]), Vec3.of(out.c[:-1])
    limit, usable = jnp.abs(trace) * rounding(c, r), is_on_branch_of_identity(unit, c, r)
    return out.R, pis, SolvedDrifts(h, of_body, out.residual_norm, limit, usable)


def simulate_free(
    R0: Array, pi0: Array, J: Array, h: Array, dt: Array, order: int, newton_iters: int
) -> tuple[Array, Array, SolvedDrifts]:
    """Free motion of high order; `dt` is `h`, or the one size of all steps."""
    if dt.ndim == 0:
        inertia, factors = modified_inertia(J, pi0, dt, order), None
    else:
        factors, inertia = modified_inertia_terms(J, pi0, dt, order)
        factors = factors.T
    R, pi, drifts = simulate_prescribed(R0, pi0, inertia, h, None, None, newton_iters, factors)
    usable = drifts.usable & turns_less_than_a_right_angle(J, drifts.pi, h)
    return R, pi, drifts._replace(usable=usable)


def simulate_composed(
    R0: Array,
    pi0: Array,
    J: Array,
    inputs: Inputs,
    torque: Callable[[Array], Array] | None,
    order: int,
    newton_iters: int,
) -> tuple[Array, Array, SolvedDrifts]:
    """Motion under a torque (3,) of time; each step is composed of steps of order two."""
    (t, h, rotor), weights, ends = inputs, composition_weights(order), None
    if torque is not None:
        times = t[:, None] + h[:, None] * jnp.asarray([[0.0, *accumulate(weights)]], h.dtype)
        torques = _torques_at(torque, times)
        ends = torques[:, :-1].reshape(-1, 3), torques[:, 1:].reshape(-1, 3)
    h = (h[:, None] * jnp.asarray([weights], h.dtype)).reshape(-1)
    if rotor is not None and rotor.ndim > 1:
        rotor = jnp.repeat(rotor, len(weights), axis=0)
    R, pi, drifts = simulate_prescribed(R0, pi0, J, h, ends, rotor, newton_iters)
    return R[:: len(weights)], pi[:: len(weights)], drifts


def _torques_at(torque: Callable[[Array], Array], times: Array) -> Array:
    """Torques (steps, stages, 3) of a law at times (steps, stages)."""
    law, leaves = with_arguments(torque, times[0, 0])

    def evaluate(times, leaves):
        return jax.vmap(jax.vmap(lambda t: law(t, *leaves)))(times)

    @jax.custom_jvp
    def torques_at(times, leaves):
        return evaluate(times, leaves)

    @torques_at.defjvp
    def _(primals, tangents):
        torques, (times, leaves) = evaluate(*primals), primals
        at = finite(times), without_nan(jnp.all(jnp.isfinite(torques)), leaves)
        return torques, jax.jvp(evaluate, at, tangents)[1]

    return torques_at(times, leaves)


class PrescribedMotion(NamedTuple):
    """A trajectory and the solutions of its steps."""

    R: Array  # attitudes (steps+1, 3, 3)
    pi: Array  # body momenta at the start of each step's rotation, and the last (steps+1, 3)
    q: Array  # attitudes relative to the initial one, as quaternions wxyz (steps+1, 4)
    c: Array  # Rodrigues vectors of the steps, and zero (steps+1, 3)
    residual_norm: Array  # of the steps (steps,); its tangent is zero


def propagate(
    R0: Array,
    pi0: Array,
    J: Array,
    factors: Array | None,
    h: Array,
    impulses: Array | None,
    rotor: Array | None,
    newton_iters: int,
) -> PrescribedMotion:
    """Motion from the attitude `R0` and the momentum `pi0` by steps of sizes `h` (steps,).

    `J` is symmetric, one inertia (3, 3), or one for each step (steps, 3, 3), or with `factors`
    (steps, n) matrices (n, 3, 3); `impulses` (steps, 3) are added to the body momentum after each
    step; `rotor` (3,) or (steps, 3) is the part of it that is of rotors.
    """
    if rotor is None:
        rotor = jnp.zeros((0, 3), pi0.dtype)
    if factors is None:
        J, factors = J if J.ndim > 2 else J[None], jnp.zeros((0, 0), pi0.dtype)
    arrays = [R0, pi0, J, factors, h, rotor if rotor.ndim == 2 else rotor[None]]
    if impulses is not None:
        arrays.append(impulses)
    return PrescribedMotion(*_solved(newton_iters, *arrays))


def solve_prescribed(newton_iters: int, R0: Array, pi0: Array, *arrays: Array) -> Arrays:
    q, pi, c, residual_norm = solve_steps(newton_iters, pi0, *arrays)
    R = rotate_rows(R0[None], Quaternion.of(q, axis=1))
    others = pi, q, c, residual_norm
    batch = R.shape[3:]  # wider than that of the others where only R0 is batched
    return R, *(jnp.broadcast_to(x, x.shape[: x.ndim - len(batch)] + batch) for x in others)


def _tangents(out: Arrays, primals: Arrays, tangents: Arrays) -> Arrays:
    (R, pi, q, c, residual_norm), (_, _, matrices, factors, h, rotor, *_) = out, primals
    batch = R.shape[3:]
    tangents = [jnp.broadcast_to(t, t.shape[: t.ndim - len(batch)] + batch) for t in tangents]
    at = Motion(matrices, factors, h, R, pi, q, c, rotor)
    dR, dpi, xi, dc, _ = propagate_variation(at, tangents)
    return dR, dpi, tangent_of_turn(q, xi), dc, jnp.zeros_like(residual_norm)


_solved = differentiable(solve_prescribed, _tangents)
