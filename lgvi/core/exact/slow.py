r"""The exact motion by a power series in time, where it is little but a turn about the momentum.

$J^{-1} - cI$ gives the same momentum as $J^{-1}$, and the same attitude but for a turn about the
momentum,

$$M(t) = \exp(c\,t\,\hat\pi_0)\,M_c(t),$$

and $M_c$ hardly moves if the body is almost isotropic, the spin almost steady, or the time short.
There the derivatives of the theta functions are badly conditioned, and the series has derivatives
of any order.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..kernels.quaternions import Quaternion
from ..kernels.vectors import Mat3, Vec3, matmul
from ..so3.series import horner, sinc_sqrt

LIMIT = 0.12  # rad, up to which the series is exact to rounding
DEGREE = 12


def slow_motion(
    K: Array, c: Array, pi0: Array, axes: Mat3, rate: Array, t: Array
) -> tuple[Mat3, Vec3]:
    """Attitudes relative to the first and momenta at times `t`, in the body frame.

    J^-1 = K + cI and the momentum are in given axes, the columns of a rotation. With a bound on
    the `rate` of M_c, `rate` |t| is at most `LIMIT`.
    """
    # In units of the rate: the powers of a thin body's K would overflow.
    scaled = jnp.broadcast_to(t * rate, (4, *t.shape))
    of_M_c = Quaternion.of(horner(scaled, _series(K / rate, pi0)[:, :, None]), axis=0)
    half, p = c * t / 2, Vec3.of(pi0)
    angle = half * half * p.dot(p)
    cosine, sine = 1 - angle / 2 * sinc_sqrt(angle / 4) ** 2, half * sinc_sqrt(angle)
    q = Quaternion(cosine, sine * p) * of_M_c
    w, v = q.w, axes @ q.v
    # Divisions, so that XLA stores the results, rather than to compute them anew for each use.
    size = jnp.sqrt(w * w + v.dot(v))
    back = Quaternion(w / size, v / size).conjugate()
    units = Mat3.of(jnp.eye(3, dtype=t.dtype))
    return Mat3(*map(back.rotate, units)), back.rotate(axes @ p)


def _series(K: Array, pi0: Array) -> Array:
    """Coefficients (degree + 1, 4) of the quaternion of M_c in time."""
    empty = jnp.zeros((DEGREE + 1, 3), pi0.dtype)
    still = jnp.zeros((DEGREE + 1, 4), pi0.dtype).at[0, 0].set(1)

    def extend(carry, n):
        pis, omegas, turns = carry  # omegas: the last one first
        omegas = jnp.concatenate([matmul(K, pis[n - 1])[None], omegas[:-1]])
        so_far = Quaternion.of(turns)
        turn = so_far * Quaternion(jnp.zeros_like(so_far.w), Vec3.of(omegas))
        degree = n.astype(pi0.dtype)
        pis = pis.at[n].set(jnp.sum(jnp.cross(pis, omegas), axis=0) / degree)
        turns = turns.at[n].set(jnp.sum(turn.array(), axis=0) / (2 * degree))
        return (pis, omegas, turns), None

    start = empty.at[0].set(pi0), empty, still
    (_, _, turns), _ = jax.lax.scan(extend, start, jnp.arange(1, DEGREE + 1))
    return turns
