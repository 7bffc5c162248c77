r"""Motion under torques that depend on the attitude, by kicks and drifts.

A kick changes the momentum by the torque of one instant times a part of the step; a drift is free
motion for a part of it. A kick may also take the double bracket of kicks with drifts,

$$K = 2\,\bigl(\tau\times a - D\tau[a]\bigr),\qquad a = J^{-1}\tau,$$

times $h^3$, with $D\tau[a]$ the change of the torque when the body turns along $a$. Two drifts
then make a method of fourth order, where a composition needs five. For the torque of a potential
$K$ is that of the potential $\tau\cdot J^{-1}\tau$, the force gradient.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Array, ArrayLike

from . import components as xyz
from . import rotations
from .checks import Shape, example_of
from .drifts import Drifts
from .equation import residual_norm, rounding
from .newton import rodrigues_vector, root_known
from .preprocessing import modified_inertia, turns_less_than_a_right_angle
from .recurrence import Inputs, State, Step, trajectory
from .splitting import Splitting, Stage


class Forcing(NamedTuple):
    """What acts on a body, as torques (3,) in its frame. The functions are pytrees."""

    law: Callable[[Array, Array], ArrayLike] | None = None  # of time and attitude
    # of time, attitude and momentum at the start of each step, held for all of it
    controller: Callable[[Array, Array, Array], ArrayLike] | None = None
    damping: Array | None = None  # D (3, 3) of the torque -D omega
    drag: Array | None = None  # C (3, 3) of the torque -|omega| C omega

    def examples(self, t: Array, R: Array, pi: Array) -> dict[str, tuple[Array, Shape]]:
        """What it consists of, for `as_floats`."""
        examples = {}
        if self.law is not None:
            name = "torque(t, R)"
            examples[name] = example_of(name, self.law, t, R), (3,)
        if self.controller is not None:
            name = "controller(t, R, pi)"
            examples[name] = example_of(name, self.controller, t, R, pi), (3,)
        for name, matrix in (("matrix", self.damping), ("drag", self.drag)):
            if matrix is not None:
                examples[name] = matrix, (3, 3)
        return examples


class _Given(NamedTuple):
    """What a step depends on beside the state, time and its size."""

    start: Array
    J: Array
    damping: Array | None
    drag: Array | None
    of_law: list[Array]
    of_controller: list[Array]


def forced_motion(
    R0: Array,
    pi0: Array,
    J: Array,
    start: Array,
    inputs: Inputs,
    forcing: Forcing,
    splitting: Splitting,
    newton_iters: int,
) -> tuple[Array, Array, Drifts]:
    """Attitudes (steps+1, 3, 3), momenta (steps+1, 3) and drifts (steps * stages, ...).

    `R0` may be relative to some other attitude, as in a piece of a long trajectory; `start` is the
    attitude in space that the torques meet.
    """
    if inputs.rotor is not None:
        inputs = inputs._replace(rotor=jnp.broadcast_to(inputs.rotor, (*inputs.h.shape, 3)))
    # What the functions close over becomes an argument of them.
    law, of_law = _with_arguments(forcing.law, inputs.t[0], start)
    controller, of_controller = _with_arguments(forcing.controller, inputs.t[0], start, pi0)

    def torque(given: _Given, state: State, t: Array):
        return law(t, _attitude(given, state), *given.of_law)

    def advance(given: _Given, state: State, tau: Array, of_step: Inputs, known):
        (t, h, rotor), roots = of_step, None if known is None else known[2]
        held = controller(t, _attitude(given, state), state.pi, *given.of_controller)
        impulse = splitting.kick * h * (tau + held)
        pi = _kicked(given, rotor, state.pi, splitting.kick * h, impulse)

        def run(carry, stage: Stage, root: Array | None):
            state, _, t = carry
            size, t = stage.drift * h, t + stage.drift * h
            inertia = _inertia(given.J, state.pi, size, splitting)
            after, c = _drift(inertia, rotor, state, size, newton_iters, root)
            # Barriers keep XLA from computing all that comes before a component for each of them.
            R = jax.lax.optimization_barrier(_attitude(given, after))
            tau = jax.lax.optimization_barrier(law(t, R, *given.of_law))
            impulse = stage.kick * h * (tau + held)
            if stage.gradient:
                bracket = _bracket(given.J, lambda R: law(t, R, *given.of_law), R, tau + held)
                impulse -= stage.gradient * h**3 * bracket
            pi = _kicked(given, rotor, after.pi, stage.kick * h, impulse)
            after = State(after.q, jax.lax.optimization_barrier(pi))
            return (after, tau, t), (size, state.pi, c)

        (state, tau, _), drifts = _in_turn(
            run, (State(state.q, pi), tau, t), splitting.stages, roots
        )
        return state, tau, drifts

    damping, drag = (
        None if matrix is None else matrix.astype(pi0.dtype)
        for matrix in (forcing.damping, forcing.drag)
    )
    given = _Given(start, J, damping, drag, of_law, of_controller)
    states, solved = trajectory(Step(torque, advance), given, pi0, inputs)
    sizes, pi, c = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), solved)
    inertia = jax.vmap(lambda pi, h: _inertia(J, pi, h, splitting))(pi, sizes)
    trace = jnp.trace(inertia, axis1=1, axis2=2)
    unit, v = xyz.split_matrix(inertia / trace[:, None, None]), xyz.split(c)
    p, r = xyz.scale(sizes / trace, xyz.split(pi)), None
    if inputs.rotor is not None:
        rotor = jnp.repeat(inputs.rotor, len(splitting.stages), axis=0)
        r, pi = xyz.scale(sizes / trace, xyz.split(rotor)), pi - rotor
    size, usable = jnp.abs(trace), None
    if splitting.drift_order > 2:
        usable = turns_less_than_a_right_angle(J, pi, sizes)
    norm = size * residual_norm(unit, p, v, r)
    Rs = rotations.turn_rows(R0[None], rotations.split(states.q))
    return Rs, states.pi, Drifts(sizes, pi, norm, size * rounding(v, r), usable)


def _in_turn(run, carry, stages: tuple[Stage, ...], roots: Array | None):
    """`jax.lax.scan` over the stages; few, or one that is not like the others, are written out."""
    if len(stages) > 2:
        weights = jnp.asarray([stage[:2] for stage in stages], carry[-1].dtype)
        return jax.lax.scan(lambda at, x: run(at, Stage(*x[0]), x[1]), carry, (weights, roots))
    results = []
    for i, stage in enumerate(stages):
        carry, result = run(carry, stage, None if roots is None else roots[i])
        results.append(result)
    return carry, jax.tree.map(lambda *xs: jnp.stack(xs), *results)


def _bracket(J: Array, torque: Callable[[Array], Array], R: Array, total: Array) -> Array:
    """2 (total x a - D torque [a]), where a = J^-1 total."""
    a = _solve(J, total)
    along = xyz.join(xyz.cross(xyz.split(R), xyz.split(a)))  # R hat(a)
    _, change = jax.jvp(torque, (R,), (along,))
    return 2 * (jnp.cross(total, a) - change)


def _with_arguments(function, *arguments):
    """The function of more arguments, and these: what it closes over and is differentiated."""
    dtype = arguments[0].dtype

    def torque(*arguments):
        if function is None:
            return jnp.zeros(3, dtype)
        return jnp.asarray(function(*arguments)).astype(dtype)

    # Not `jax.closure_convert`, which leaves integers and keys in the closure.
    closed, count = jax.make_jaxpr(torque)(*arguments), len(arguments)

    def converted(*given):
        (result,) = jaxpr_as_fun(closed.replace(consts=list(given[count:])))(*given[:count])
        return result

    return converted, closed.consts


def _attitude(given: _Given, state: State) -> Array:
    return rotations.turn_rows(given.start[None], rotations.split(state.q[None]))[0]


def _inertia(J: Array, pi: Array, h: Array, splitting: Splitting) -> Array:
    return modified_inertia(J, pi, h, splitting.drift_order) if splitting.drift_order > 2 else J


def _drift(
    J: Array,
    rotor: Array | None,
    state: State,
    h: Array,
    newton_iters: int,
    root: Array | None,
) -> tuple[State, Array]:
    """The state after free motion, and its Rodrigues vector, which may be known."""
    trace = jax.lax.stop_gradient(jnp.trace(J))
    r = None if rotor is None else h / trace * rotor
    unit, p = J / trace, h / trace * state.pi
    c = rodrigues_vector(unit, p, newton_iters, r) if root is None else root_known(root, unit, p, r)
    v = xyz.split(c)
    w = jax.lax.rsqrt(1 + xyz.dot(v, v))
    q = rotations.multiply(rotations.split(state.q), (w, xyz.scale(w, v)))
    pi = rotations.turn_back(v, xyz.split(state.pi))
    return jax.lax.optimization_barrier(State(rotations.join(q), xyz.join(pi))), c


def _kicked(given: _Given, rotor: Array | None, pi: Array, h: Array, impulse: Array) -> Array:
    """Momentum after an impulse, and after damping for a time `h` by the midpoint rule."""
    if given.damping is None and given.drag is None:
        return pi + impulse
    of_body = pi if rotor is None else pi - rotor

    def midpoint(damping: Array) -> Array:
        return _solve(given.J + h / 2 * damping, of_body + impulse / 2)

    damping = jnp.zeros_like(given.J) if given.damping is None else given.damping
    if given.drag is not None:
        # The speed at the midpoint, to the order of the rule; whatever it is, energy is lost.
        linear, omega = damping, _solve(given.J, of_body)
        for _ in range(2):
            damping = linear + _length(omega) * given.drag
            omega = midpoint(damping)
    return pi + impulse - h * xyz.matmul(damping, midpoint(damping))


def _length(v: Array) -> Array:
    """The length of a vector, with the derivative zero at zero."""
    square = jnp.sum(v * v)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def _solve(J: Array, b: Array) -> Array:
    trace = jnp.trace(J)  # or the determinant of a small body would underflow
    return xyz.join(xyz.solve(xyz.split_matrix(J / trace), xyz.split(b / trace)))
