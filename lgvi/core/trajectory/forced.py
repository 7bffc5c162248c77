"""Motion under torques that depend on the attitude, by kicks and drifts.

A kick changes the momentum by the torque of one instant; a drift is free motion for a part of the
step. The derivative does not run through the loop of the steps: see `forced_adjoint`.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.quaternions import Quaternion, rotate_rows, rotated_attitude
from ..kernels.vectors import Mat3, Vec3
from ..step.equation import is_on_branch_of_identity, residual_norm, rounding
from ..step.modified_inertia import modified_inertia, turns_less_than_a_right_angle
from ..step.newton import rodrigues_vector
from .convergence import SolvedDrifts
from .forced_adjoint import Setting, States, tangents_with_feedback
from .kicks import Forcing, Kicks, Part, as_arguments
from .splitting import Inputs, Splitting, Stage


class _State(NamedTuple):
    q: Array  # attitude relative to the initial one, as a quaternion wxyz (4,) of about unit norm
    pi: Array  # body momentum (3,)


def simulate_forced(
    R0: Array,
    pi0: Array,
    J: Array,
    start: Array,
    inputs: Inputs,
    forcing: Forcing,
    splitting: Splitting,
    newton_iters: int,
) -> tuple[Array, Array, SolvedDrifts]:
    """Attitudes (steps+1, 3, 3), momenta (steps+1, 3) and drifts (steps * stages, ...).

    `R0` may be relative to some other attitude, as in a chunk of a long trajectory; `start` is the
    attitude in space that the torques meet.
    """
    if inputs.rotor is not None:
        inputs = inputs._replace(rotor=jnp.broadcast_to(inputs.rotor, (*inputs.h.shape, 3)))
    kicks, acting = as_arguments(forcing, J, inputs.t[0], start, pi0)
    motion = jax.custom_jvp(partial(_motion, kicks, splitting, newton_iters))
    motion.defjvp(partial(tangents_with_feedback, motion, kicks, splitting))
    states = motion(R0, pi0, Setting(start, acting, inputs))
    return states.R, states.pi, _solved_drifts(states, J, inputs, splitting)


def _solved_drifts(states: States, J: Array, inputs: Inputs, splitting: Splitting) -> SolvedDrifts:
    """How the drifts of all steps were solved, without a derivative."""
    sizes = inputs.h[:, None] * jnp.asarray([[stage.drift for stage in splitting.stages]], J.dtype)
    of_drifts = jax.lax.stop_gradient((sizes, states.pi_of_drifts, states.c))
    sizes, pi, c = (x.reshape(-1, *x.shape[2:]) for x in of_drifts)
    inertia = jax.vmap(lambda pi, h: _inertia(J, pi, h, splitting))(pi, sizes)
    trace = jnp.trace(inertia, axis1=1, axis2=2)
    unit, v = Mat3.of(inertia / trace[:, None, None]), Vec3.of(c)
    p, r = sizes / trace * Vec3.of(pi), None
    if inputs.rotor is not None:
        rotor = jnp.repeat(inputs.rotor, len(splitting.stages), axis=0)
        r, pi = sizes / trace * Vec3.of(rotor), pi - rotor
    size, usable = jnp.abs(trace), is_on_branch_of_identity(unit, v, r)
    if splitting.drift_order > 2:
        usable &= turns_less_than_a_right_angle(J, pi, sizes)
    norm = size * residual_norm(2 * unit, p, v, r)
    return SolvedDrifts(sizes, pi, norm, size * rounding(v, r), usable)


def _motion(kicks: Kicks, splitting: Splitting, newton_iters: int, R0, pi0, setting: Setting):
    start, acting, inputs = setting

    def step(carry, of_step: Inputs):
        state, tau = carry
        t, h, rotor = of_step
        R = rotated_attitude(start, state.q)
        held = kicks.held(acting, t, R, state.pi)
        impulse = partial(kicks.impulse, acting, h, rotor)
        pi = state.pi + impulse(Part(0.0, splitting.kick), t, R, state.pi, tau + held)
        # Computed twice with two roundings, it would not be the momentum that the drift solves for:
        # where the kick stops the body, the difference is more than the momentum's own rounding.
        pi = jax.lax.optimization_barrier(pi)

        def run(carry, stage: Stage):
            before, _, t = carry
            size, t = stage.drift * h, t + stage.drift * h
            inertia = _inertia(acting.J, before.pi, size, splitting)
            after, c = _drift(inertia, rotor, before, size, newton_iters)
            # Barriers keep XLA from computing all that comes before a component for each of them.
            R = jax.lax.optimization_barrier(rotated_attitude(start, after.q))
            tau = jax.lax.optimization_barrier(kicks.torque(acting, t, R))
            part = Part(0.0, stage.kick, stage.gradient)
            pi = after.pi + impulse(part, t, R, after.pi, tau + held)
            return (_State(after.q, jax.lax.optimization_barrier(pi)), tau, t), (before, c)

        (after, tau, _), drifts = _in_turn(run, (_State(state.q, pi), tau, t), splitting.stages)
        return (after, tau), (state, *drifts)

    first = _State(jnp.eye(4, dtype=pi0.dtype)[0], pi0)
    carry = first, kicks.torque(acting, inputs.t[0], rotated_attitude(start, first.q))
    (last, _), (states, before, c) = jax.lax.scan(step, carry, inputs)
    q, pi = jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), states, last)
    R = rotate_rows(R0[None], Quaternion.of(q))
    # Not the attitudes before the first drifts for `q`: without a derivative none would be stored.
    return States(R, pi, q, before.pi, before.q, c)


def _in_turn(run, carry, stages: tuple[Stage, ...]) -> tuple[Any, Any]:
    """`jax.lax.scan` over the stages; few, or one that is not like the others, are written out."""
    if len(stages) > 2:
        weights = jnp.asarray([stage[:2] for stage in stages], carry[-1].dtype)
        return jax.lax.scan(lambda at, x: run(at, Stage(*x)), carry, weights)
    results = []
    for stage in stages:
        carry, result = run(carry, stage)
        results.append(result)
    return carry, jax.tree.map(lambda *xs: jnp.stack(xs), *results)


def _inertia(J: Array, pi: Array, h: Array, splitting: Splitting) -> Array:
    return modified_inertia(J, pi, h, splitting.drift_order) if splitting.drift_order > 2 else J


def _drift(
    J: Array, rotor: Array | None, state: _State, h: Array, newton_iters: int
) -> tuple[_State, Array]:
    """The state after free motion, and its Rodrigues vector."""
    trace = jnp.trace(J)
    r = None if rotor is None else h / trace * rotor
    c = rodrigues_vector(J / trace, h / trace * state.pi, newton_iters, r)
    v = Vec3.of(c)
    w = jax.lax.rsqrt(1 + v.dot(v))
    q = Quaternion.of(state.q) * Quaternion(w, w * v)
    pi = Quaternion(1.0, v).rotate_back(Vec3.of(state.pi))
    return jax.lax.optimization_barrier(_State(q.array(), pi.array())), c
