"""A whole trajectory as one differentiable operation."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from . import rotations
from .primitives import Arrays, differentiable
from .reduction import solve_steps
from .variation import variation


class Motion(NamedTuple):
    """A trajectory and how its steps were solved."""

    R: Array  # attitudes (steps+1, 3, 3)
    pi: Array  # body momenta at the start of each step's rotation, and the last (steps+1, 3)
    q: Array  # attitudes relative to the initial one, as quaternions wxyz (steps+1, 4)
    c: Array  # Rodrigues vectors of the steps, and zero (steps+1, 3)
    residual_norm: Array  # of the steps, and zero (steps+1,); its tangent is zero


def motion(
    R0: Array,
    pi0: Array,
    J: Array,
    h: Array,
    impulses: Array | None,
    rotor: Array | None,
    newton_iters: int,
) -> Motion:
    """Motion from the attitude `R0` and the momentum `pi0` by steps of sizes `h` (steps,).

    `J` is symmetric, one inertia (3, 3) or one for each step (steps, 3, 3); `impulses` (steps, 3)
    are added to the body momentum after each step; `rotor` (3,) or (steps, 3) is the part of
    it that is of rotors.
    """
    if rotor is None:
        rotor = jnp.zeros((0, 3), pi0.dtype)
    arrays = [R0, pi0, J if J.ndim == 3 else J[None], h, rotor if rotor.ndim == 2 else rotor[None]]
    if impulses is not None:
        arrays.append(impulses)
    return Motion(*_motion(newton_iters, *arrays))


def solve_motion(newton_iters: int, R0: Array, pi0: Array, *arrays: Array) -> Arrays:
    q, pi, c, residual_norm = solve_steps(newton_iters, pi0, *arrays)
    R = rotations.turn_rows(R0[None], rotations.split(q, axis=1))
    others = pi, q, c, residual_norm
    batch = R.shape[3:]  # wider than that of the others where only R0 is batched
    return R, *(jnp.broadcast_to(x, x.shape[: x.ndim - len(batch)] + batch) for x in others)


def _tangents(out: Arrays, primals: Arrays, tangents: Arrays) -> Arrays:
    (R, pi, q, c, residual_norm), (_, _, J, h, rotor, *_) = out, primals
    batch = R.shape[3:]
    tangents = [jnp.broadcast_to(t, t.shape[: t.ndim - len(batch)] + batch) for t in tangents]
    at = J, h, R, pi, q, c, rotor
    dR, dpi, xi, dc, _ = variation(at, tangents)
    return dR, dpi, rotations.by_turning(q, xi), dc, jnp.zeros_like(residual_norm)


_motion = differentiable(solve_motion, _tangents)
