r"""The derivative of motion under torques that depend on the state.

The derivative does not run through the loop of the steps. Once all states are known, the kicks and
drifts of all steps are linearised at once, and the recurrence of `propagate_variation`, with
feedback, remains.

A row is a drift and the kick after it; the first row of a step also has the hold of the
controller's torque and the kick that begins the step. So the states between steps are the states
before a row. Under a torque law alone the kick that begins a step is joined to the kick before, and
the momenta between steps are found afterwards.
"""

from functools import partial
from itertools import accumulate
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.finite import finite, finite_matrix, without_nan
from ..kernels.quaternions import Quaternion, rotated_attitude, tangent_of_turn
from ..kernels.vectors import Vec3, matmul
from ..step.modified_inertia import modified_inertia
from .adjoint import Motion, propagate_variation
from .kicks import Acting, Kicks, Part, along
from .splitting import Inputs, Splitting


class Setting(NamedTuple):
    """Arguments of a motion beside its first state."""

    start: Array  # attitude in space
    acting: Acting
    inputs: Inputs


class States(NamedTuple):
    """The states between steps, and the states and solutions of the drifts in the steps."""

    R: Array  # attitudes (steps+1, 3, 3)
    pi: Array  # body momenta (steps+1, 3)
    q: Array  # attitudes relative to the first, as quaternions wxyz (steps+1, 4)
    pi_of_drifts: Array  # momenta at the start of each drift (steps, stages, 3)
    q_of_drifts: Array  # attitudes there, as `q` (steps, stages, 4)
    c: Array  # Rodrigues vectors of the drifts (steps, stages, 3)


def tangents_with_feedback(motion, kicks: Kicks, splitting: Splitting, primals, tangents):
    """The states of `motion(R0, pi0, setting)`, and their tangents."""
    (_, _, setting), (dR0, dpi0, dsetting) = primals, tangents
    states, dtype, rows = motion(*primals), dR0.dtype, len(splitting.stages)
    parts = jnp.asarray([[stage.drift for stage in splitting.stages]], dtype)
    true, states, setting = states, *_at_finite_states(states, setting)
    kick, dkick = _kicks(kicks, splitting, states, setting, dsetting)
    (begin, after), (dbegin, dafter) = ((x[:, 0], x[:, 1:]) for x in (kick, dkick))
    joined = kicks.controller is None and not kicks.depend_on_momentum
    if joined:
        # Such kicks depend on the attitude alone, which no kick changes: two in a row are one.
        dpi0 += dbegin[0]
        after, dafter = (x.at[:-1, -1].add(y[1:]) for x, y in ((after, begin), (dafter, dbegin)))
        before, dbefore = begin[:0], []
    else:
        before, *dbefore = (_first_rows(x, rows) for x in (begin, dbegin))
    J, dJ, right = setting.acting.J[None], dsetting.acting.J[None], jnp.zeros((0, 3, 3), dtype)
    if splitting.drift_order > 2:
        J, dJ, right = _inertias(splitting.drift_order, parts, states, setting, dsetting)
    hold, dheld = jnp.zeros((0, 3, 6), dtype), []
    if kicks.controller is not None:
        hold, *dheld = _holds(kicks, rows, states, setting, dsetting)
    rotor = drotor = jnp.zeros((0, 3), dtype)
    if setting.inputs.rotor is not None:
        pair = setting.inputs.rotor, dsetting.inputs.rotor
        rotor, drotor = (jnp.repeat(x, rows, axis=0) for x in pair)

    h, dh = (_flat(x.inputs.h[:, None] * parts) for x in (setting, dsetting))
    pi, q, c = (
        jnp.concatenate([_flat(of_drifts), last[None]])
        for of_drifts, last in (
            (true.pi_of_drifts, true.pi[-1]),
            (true.q_of_drifts, true.q[-1]),
            (true.c, jnp.zeros_like(dpi0)),
        )
    )
    none = jnp.zeros((0, 0), dtype)
    linearised = Motion(J, none, h, true.R, pi, q, c, rotor)
    feedback = right, before, _flat(after), hold  # N, B, K and H
    changes = [dR0, dpi0, dJ, none, dh, drotor, _flat(dafter), *dbefore, *dheld]
    dR, dpi, xi, dc, dpi_of_drifts = propagate_variation([*linearised, *feedback], changes)
    dq, dpi, xi = tangent_of_turn(q, xi), dpi[::rows], xi[::rows]
    if joined:
        dpi = dpi.at[:-1].add(-(matmul(begin, xi[:-1, :, None])[..., 0] + dbegin))
    of_drifts = [x[:-1].reshape(-1, rows, x.shape[1]) for x in (dpi_of_drifts, dq, dc)]
    return true, States(dR, dpi, dq[::rows], *of_drifts)


def _at_finite_states(states: States, setting: Setting) -> tuple[States, Setting]:
    """States and arguments, of which those that are not finite are some others.

    Torques are then linearised where they have a derivative. The cotangents of states that are not
    finite are NaN or zero all the same.
    """
    R, pi, q, pi_of_drifts, q_of_drifts, c = states
    first = jnp.where(jnp.all(jnp.isfinite(pi[0])), pi[0], 1)
    pi, pi_of_drifts = (_unless_finite(x, first) for x in (pi, pi_of_drifts))
    q, q_of_drifts = (_unless_finite(x, jnp.eye(4, dtype=x.dtype)[0]) for x in (q, q_of_drifts))
    start, acting, inputs = setting
    # A law may mean its own NaN, but not where all that follows from it is NaN.
    J, acting = finite_matrix(acting.J), without_nan(jnp.all(jnp.isfinite(states.pi[1])), acting)
    acting = acting._replace(J=J)
    setting = Setting(finite_matrix(start), acting, jax.tree.map(finite, inputs))
    return States(R, pi, q, pi_of_drifts, q_of_drifts, finite(c)), setting


def _unless_finite(x: Array, other: Array) -> Array:
    return jnp.where(jnp.all(jnp.isfinite(x), axis=-1, keepdims=True), x, other)


def _inertias(order: int, parts: Array, states: States, setting: Setting, dsetting: Setting):
    """Modified inertias of rows, their variation, and the momentum's part of the right side."""

    def of_drifts(function, J, h):
        of_stages = jax.vmap(function, (None, 0, 0, 0))
        of_steps = jax.vmap(of_stages, (None, 0, 0, 0))
        return of_steps(J, h[:, None] * parts, states.pi_of_drifts, states.c)

    def inertia(J, h, pi, c):
        return modified_inertia(J, pi, h, order)

    def right_side(J, h, pi, c):
        def of_momentum(pi):
            modified = modified_inertia(J, pi, h, order)
            return matmul(modified, c), jnp.trace(modified)

        change, trace = jax.jacfwd(of_momentum, has_aux=True)(pi)
        # The equation is divided by the trace, which is not differentiated there either.
        return -2 * change / jax.lax.stop_gradient(trace)

    at, change = (setting.acting.J, setting.inputs.h), (dsetting.acting.J, dsetting.inputs.h)
    J, dJ = jax.jvp(partial(of_drifts, inertia), at, change)
    return _flat(J), _flat(dJ), _flat(of_drifts(right_side, *at))


def _kicks(kicks: Kicks, splitting: Splitting, states: States, setting: Setting, dsetting: Setting):
    """How impulses depend on the state (steps, rows+1, 3, columns), and their variation."""
    q = jnp.concatenate([states.q_of_drifts, states.q[1:, None]], axis=1)
    turned = Quaternion(1.0, Vec3.of(states.c)).rotate_back(Vec3.of(states.pi_of_drifts))
    pi = jnp.concatenate([states.pi[:-1, None], turned.array()], axis=1)
    held = jax.vmap(partial(_held, kicks, setting.start, setting.acting))(
        setting.inputs.t, states.q[:-1], states.pi[:-1], jnp.zeros((len(q), 6), q.dtype)
    )
    stages = splitting.stages
    parts = map(
        Part,
        accumulate((stage.drift for stage in stages), initial=0.0),
        [splitting.kick, *(stage.kick for stage in stages)],
        [None, *(stage.gradient for stage in stages)],
    )
    controlled = kicks.controller is not None
    # Changes of the attitude, and of the held torque and the momentum where kicks depend on them.
    zero = jnp.zeros(3 + 3 * controlled + 3 * kicks.depend_on_momentum, q.dtype)

    def impulse(z, body, acting, inputs, held, part, q, pi):
        start, J, damping, drag = body
        acting = acting._replace(J=J, damping=damping, drag=drag)
        t, R = inputs.t + part.time * inputs.h, _attitude(start, q, z[:3])
        held = held + z[3:6] if controlled else held
        pi = pi + z[-3:] if kicks.depend_on_momentum else pi
        tau = kicks.torque(acting, t, R) + held
        return kicks.impulse(acting, inputs.h, inputs.rotor, part, t, R, pi, tau)

    def of_parts(which, parts):
        parts = jax.tree.map(lambda *x: jnp.asarray(x, q.dtype), *parts)

        def of_all(function, setting):
            # The body of each kick: the adjoint then has one sum, not one for each use.
            acting = setting.acting
            body = jax.tree.map(
                lambda x: jnp.broadcast_to(x, (len(q), len(which), *x.shape)),
                (setting.start, acting.J, acting.damping, acting.drag),
            )
            of_stages = jax.vmap(function, (0, None, None, None, 0, 0, 0))
            of_steps = jax.vmap(of_stages, (0, None, 0, 0, None, 0, 0))
            return of_steps(body, acting, setting.inputs, held, parts, q[:, which], pi[:, which])

        matrices = of_all(lambda *xs: jax.jacfwd(impulse)(zero, *xs), setting)
        return matrices, jax.jvp(partial(of_all, partial(impulse, zero)), (setting,), (dsetting,))[
            1
        ]

    # Kicks with a force gradient take long, so other kicks are computed apart.
    groups = {}
    for i, part in enumerate(parts):
        groups.setdefault(part.gradient is None, []).append((i, part))
    groups = [tuple(zip(*group, strict=True)) for group in groups.values()]
    results = [of_parts(jnp.asarray(which), parts) for which, parts in groups]
    order = jnp.argsort(jnp.asarray([i for which, _ in groups for i in which]))
    return jax.tree.map(lambda *xs: jnp.concatenate(xs, axis=1)[:, order], *results)


def _holds(kicks: Kicks, rows: int, states: States, setting: Setting, dsetting: Setting):
    """How the torque that is held depends on the state (rows, 3, 6 or 9), and its variation."""
    zero = jnp.zeros(6, states.q.dtype)

    def of_all(function, setting):
        of_steps = jax.vmap(
            partial(function, kicks, setting.start, setting.acting), (0, 0, 0, None)
        )
        return of_steps(setting.inputs.t, states.q[:-1], states.pi[:-1], zero)

    matrices = of_all(jax.jacfwd(_held, argnums=6), setting)
    change = jax.jvp(partial(of_all, _held), (setting,), (dsetting,))[1]
    if rows > 1:
        # In other rows the held torque is the torque of the row before.
        first = jnp.pad(matrices, [(0, 0), (0, 0), (0, 3)])
        as_before = jnp.broadcast_to(jnp.eye(3, 9, 6, dtype=zero.dtype), first.shape)
        matrices = _flat(jnp.stack([first] + [as_before] * (rows - 1), axis=1))
    return matrices, _first_rows(change, rows)


def _held(kicks: Kicks, start: Array, acting: Acting, t: Array, q: Array, pi: Array, z: Array):
    return kicks.held(acting, t, _attitude(start, q, z[:3]), pi + z[3:])


def _attitude(start: Array, q: Array, xi: Array) -> Array:
    """Attitude in space, turned by a small vector in the body frame."""
    R = rotated_attitude(start, q)
    return R + along(R, xi)


def _flat(x: Array) -> Array:
    return x.reshape(-1, *x.shape[2:])


def _first_rows(x: Array, rows: int) -> Array:
    """Of steps (steps, ...), in the first row of each."""
    return _flat(jnp.pad(x[:, None], [(0, 0), (0, rows - 1)] + [(0, 0)] * (x.ndim - 1)))
