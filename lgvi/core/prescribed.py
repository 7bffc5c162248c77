"""Motion without torque, or under torques that do not depend on it."""

from collections.abc import Callable
from itertools import accumulate

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .drifts import Drifts
from .motion import motion
from .splitting import composition_weights


def prescribed_motion(
    R0: Array,
    pi0: Array,
    J: Array,
    h: Array,
    torques: tuple[Array, Array] | None,
    newton_iters: int,
) -> tuple[Array, Array, Drifts]:
    """Attitudes (steps+1, 3, 3), momenta (steps+1, 3) and drifts of steps of sizes `h` (steps,).

    `torques` (steps, 3) act at the start and at the end of each step.
    """
    impulses, before = None, jnp.zeros((1, 3), pi0.dtype)
    if torques is not None:
        half = h[:, None] / 2
        # Each step's rotation starts with the momentum after its first impulse.
        before = jnp.pad(half * torques[0], [(0, 1), (0, 0)])
        impulses = half * torques[1] + before[1:]
    out = motion(R0, pi0 + before[0], J, h, impulses, newton_iters)
    pis = out.pi
    if torques is not None:
        pis = (pis - before).at[0].set(pi0)
    trace = jnp.broadcast_to(jnp.trace(J, axis1=-2, axis2=-1), h.shape)
    return out.R, pis, Drifts(trace, h, out.pi[:-1], out.c[:-1], out.residual_norm[:-1])


def composed_motion(
    R0: Array,
    pi0: Array,
    J: Array,
    t: Array,
    h: Array,
    torque: Callable[[Array], Array],
    order: int,
    newton_iters: int,
) -> tuple[Array, Array, Drifts]:
    """The same under a torque (3,) of time, with steps composed of some to be of high order."""
    weights = composition_weights(order)
    times = jnp.asarray([[0.0, *accumulate(weights)]], h.dtype)
    torques = jax.vmap(jax.vmap(torque))(t[:, None] + h[:, None] * times).astype(h.dtype)
    ends = torques[:, :-1].reshape(-1, 3), torques[:, 1:].reshape(-1, 3)
    h = (h[:, None] * jnp.asarray([weights], h.dtype)).reshape(-1)
    R, pi, drifts = prescribed_motion(R0, pi0, J, h, ends, newton_iters)
    return R[:: len(weights)], pi[:: len(weights)], drifts
