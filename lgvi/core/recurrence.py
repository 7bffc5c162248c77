r"""Trajectories of a step that depends on the attitude, and their derivative.

The derivative does not run through the loop. Once all states are known, the step is linearised
about all of them at once, in the variations $\xi = \operatorname{vee}(R^T dR)$ and $d\pi$;
what remains is one linear recurrence of six numbers,

$$z_{k+1} = A_k z_k + b_k,\qquad z = (\xi, d\pi),$$

where $b_k$ is the variation of the step with its parameters, time and size. JAX transposes it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import components as xyz
from . import rotations

Parameters = Any


class State(NamedTuple):
    q: Array  # attitude relative to the initial one, as a quaternion wxyz (4,) of about unit norm
    pi: Array  # body momentum (3,)


class Step(NamedTuple):
    """One step, and what of a state it needs that the step before has already computed."""

    prepare: Callable[[Parameters, State, Array], Any]  # of the parameters, the state and t
    # of the parameters, the state, what was prepared, t and h; gives the state after the step,
    # what is prepared for the next one, and what shall be stored of this one
    advance: Callable[[Parameters, State, Any, Array, Array], tuple[State, Any, Any]]


def trajectory(
    step: Step, parameters: Parameters, pi0: Array, t: Array, h: Array
) -> tuple[State, Any]:
    """States (steps+1, ...), from the identity, and what is stored of the steps (steps, ...).

    The steps start at the times `t` and are of the sizes `h` (steps,). What is stored has no
    derivative. `step` depends on nothing that is differentiated but the parameters.
    """

    @jax.custom_jvp
    def run(parameters, pi0, t, h):
        def body(carry, inputs):
            state, prepared = carry
            after, prepared, stored = step.advance(parameters, state, prepared, *inputs)
            return (after, prepared), (state, stored)

        start = State(jnp.eye(4, dtype=pi0.dtype)[0], pi0)
        carry = start, step.prepare(parameters, start, t[0])
        (last, _), (states, stored) = jax.lax.scan(body, carry, (t, h))
        states = jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), states, last)
        return states, jax.lax.stop_gradient(stored)

    def varied(z, parameters, t, h, state, after):
        """One step from a state moved by `z`, in coordinates about the state after it."""
        by = 1.0, xyz.scale(0.5, xyz.split(z[:3]))
        q = rotations.join(rotations.multiply(rotations.split(state.q), by))
        moved = State(q, state.pi + z[3:])
        moved, _, _ = step.advance(parameters, moved, step.prepare(parameters, moved, t), t, h)
        # Twice the vector part of the quotient; `conjugate` has a minus sign.
        back = rotations.conjugate(rotations.split(after.q))
        _, v = rotations.multiply(back, rotations.split(moved.q))
        return jnp.concatenate([-2 / jnp.sum(after.q**2) * xyz.join(v), moved.pi])

    @run.defjvp
    def _(primals, tangents):
        parameters, _, t, h = primals
        dparameters, dpi0, dt, dh = tangents
        states, stored = run(*primals)
        ends = jax.tree.map(lambda x: x[:-1], states), jax.tree.map(lambda x: x[1:], states)
        zero = jnp.zeros(6, dpi0.dtype)

        def of_inputs(parameters, t, h):
            return jax.vmap(lambda *xs: varied(zero, parameters, *xs))(t, h, *ends)

        A = jax.vmap(lambda *xs: jax.jacfwd(varied)(zero, parameters, *xs))(t, h, *ends)
        _, b = jax.jvp(of_inputs, (parameters, t, h), (dparameters, dt, dh))

        def recur(z, inputs):
            A, b = inputs
            return xyz.matmul(A, z) + b, z

        start = jnp.concatenate([jnp.zeros_like(dpi0), dpi0])
        last, z = jax.lax.scan(recur, start, (A, b))
        z = jnp.concatenate([z, last[None]])
        turned = rotations.multiply(rotations.split(states.q), (0.0, xyz.split(z[:, :3])))
        dstates = State(rotations.join(rotations.scale(0.5, turned)), z[:, 3:])
        return (states, stored), (dstates, jax.tree.map(jnp.zeros_like, stored))

    return run(parameters, pi0, t, h)
