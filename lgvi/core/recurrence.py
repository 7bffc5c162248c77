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


class Inputs(NamedTuple):
    """What is given for each step."""

    t: Array  # time at its start
    h: Array  # size
    rotor: Array | None  # momentum (3,) of rotors


class State(NamedTuple):
    q: Array  # attitude relative to the initial one, as a quaternion wxyz (4,) of about unit norm
    pi: Array  # body momentum (3,)


class Step(NamedTuple):
    """One step, and what of a state it needs that the step before has already computed."""

    prepare: Callable[[Parameters, State, Array], Any]  # of the parameters, the state and t
    # of the parameters, the state, what was prepared, the inputs and, where the step is taken
    # again, what was stored of it; gives the state after the step, what is prepared for the next
    # one, and what shall be stored of this one
    advance: Callable[[Parameters, State, Any, Inputs, Any], tuple[State, Any, Any]]


def trajectory(step: Step, parameters: Parameters, pi0: Array, inputs: Inputs) -> tuple[State, Any]:
    """States (steps+1, ...), from the identity, and what is stored of the steps (steps, ...).

    What is stored has no derivative. `step` depends on nothing that is differentiated but the
    parameters and what it is given.
    """

    @jax.custom_jvp
    def run(parameters, pi0, inputs):
        def body(carry, of_step):
            state, prepared = carry
            after, prepared, stored = step.advance(parameters, state, prepared, of_step, None)
            return (after, prepared), (state, stored)

        start = State(jnp.eye(4, dtype=pi0.dtype)[0], pi0)
        carry = start, step.prepare(parameters, start, inputs.t[0])
        (last, _), (states, stored) = jax.lax.scan(body, carry, inputs)
        states = jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), states, last)
        return states, jax.lax.stop_gradient(stored)

    def varied(z, parameters, of_step, state, after, stored):
        """One step from a state moved by `z`, in coordinates about the state after it."""
        by = 1.0, xyz.scale(0.5, xyz.split(z[:3]))
        q = rotations.join(rotations.multiply(rotations.split(state.q), by))
        moved = State(q, state.pi + z[3:])
        prepared = step.prepare(parameters, moved, of_step.t)
        moved, _, _ = step.advance(parameters, moved, prepared, of_step, stored)
        # Twice the vector part of the quotient; `conjugate` has a minus sign.
        back = rotations.conjugate(rotations.split(after.q))
        _, v = rotations.multiply(back, rotations.split(moved.q))
        return jnp.concatenate([-2 / jnp.sum(after.q**2) * xyz.join(v), moved.pi])

    @run.defjvp
    def _(primals, tangents):
        parameters, _, inputs = primals
        dparameters, dpi0, dinputs = tangents
        states, stored = run(*primals)
        ends = jax.tree.map(lambda x: x[:-1], states), jax.tree.map(lambda x: x[1:], states)
        zero = jnp.zeros(6, dpi0.dtype)

        def of_given(parameters, inputs):
            return jax.vmap(lambda *xs: varied(zero, parameters, *xs))(inputs, *ends, stored)

        A = jax.vmap(lambda *xs: jax.jacfwd(varied)(zero, parameters, *xs))(inputs, *ends, stored)
        _, b = jax.jvp(of_given, (parameters, inputs), (dparameters, dinputs))

        def recur(z, of_step):
            A, b = of_step
            return xyz.matmul(A, z) + b, z

        start = jnp.concatenate([jnp.zeros_like(dpi0), dpi0])
        last, z = jax.lax.scan(recur, start, (A, b))
        z = jnp.concatenate([z, last[None]])
        turned = rotations.multiply(rotations.split(states.q), (0.0, xyz.split(z[:, :3])))
        dstates = State(rotations.join(rotations.scale(0.5, turned)), z[:, 3:])
        return (states, stored), (dstates, jax.tree.map(jnp.zeros_like, stored))

    return run(parameters, pi0, inputs)
