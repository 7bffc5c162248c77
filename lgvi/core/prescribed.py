"""Motion without torque, or under torques that do not depend on it."""

from collections.abc import Callable
from itertools import accumulate

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import components as xyz
from .drifts import Drifts
from .equation import rounding
from .motion import motion
from .preprocessing import modified_inertia, turns_less_than_a_right_angle
from .splitting import Inputs, composition_weights


def prescribed_motion(
    R0: Array,
    pi0: Array,
    J: Array,
    h: Array,
    torques: tuple[Array, Array] | None,
    rotor: Array | None,
    newton_iters: int,
) -> tuple[Array, Array, Drifts]:
    """Attitudes (steps+1, 3, 3), momenta (steps+1, 3) and drifts of steps of sizes `h` (steps,).

    `torques` (steps, 3) act at the start and at the end of each step; `rotor` (3,) or (steps, 3)
    is the momentum of rotors.
    """
    impulses, before = None, jnp.zeros((1, 3), pi0.dtype)
    if torques is not None:
        half = h[:, None] / 2
        # Each step's rotation starts with the momentum after its first impulse.
        before = jnp.pad(half * torques[0], [(0, 1), (0, 0)])
        impulses = half * torques[1] + before[1:]
    out = motion(R0, pi0 + before[0], J, h, impulses, rotor, newton_iters)
    pis = out.pi
    if torques is not None:
        pis = (pis - before).at[0].set(pi0)
    trace, of_body, r = jnp.abs(jnp.trace(J, axis1=-2, axis2=-1)), out.pi[:-1], None
    if rotor is not None:
        rotor = jnp.broadcast_to(rotor, (len(h), 3))
        of_body, r = of_body - rotor, xyz.scale(h / trace, xyz.split(rotor))
    limit = trace * rounding(xyz.split(out.c[:-1]), r)
    return out.R, pis, Drifts(h, of_body, out.residual_norm[:-1], limit)


def free_motion(
    R0: Array, pi0: Array, J: Array, h: Array, dt: Array, order: int, newton_iters: int
) -> tuple[Array, Array, Drifts]:
    """The same without torque, of high order; `dt` is `h`, or the one size of all steps."""
    inertia = modified_inertia(J, pi0, dt, order)
    R, pi, drifts = prescribed_motion(R0, pi0, inertia, h, None, None, newton_iters)
    return R, pi, drifts._replace(usable=turns_less_than_a_right_angle(J, drifts.pi, h))


def composed_motion(
    R0: Array,
    pi0: Array,
    J: Array,
    inputs: Inputs,
    torque: Callable[[Array], Array] | None,
    order: int,
    newton_iters: int,
) -> tuple[Array, Array, Drifts]:
    """The same under a torque (3,) of time, with steps composed of some to be of high order."""
    (t, h, rotor), weights, ends = inputs, composition_weights(order), None
    if torque is not None:
        times = jnp.asarray([[0.0, *accumulate(weights)]], h.dtype)
        torques = jax.vmap(jax.vmap(torque))(t[:, None] + h[:, None] * times).astype(h.dtype)
        ends = torques[:, :-1].reshape(-1, 3), torques[:, 1:].reshape(-1, 3)
    h = (h[:, None] * jnp.asarray([weights], h.dtype)).reshape(-1)
    if rotor is not None and rotor.ndim > 1:
        rotor = jnp.repeat(rotor, len(weights), axis=0)
    R, pi, drifts = prescribed_motion(R0, pi0, J, h, ends, rotor, newton_iters)
    return R[:: len(weights)], pi[:: len(weights)], drifts
