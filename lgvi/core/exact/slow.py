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

from ..kernels import quaternions
from ..kernels import vectors as xyz
from ..kernels.vectors import Matrix, Vector
from ..so3.series import horner, sinc_sqrt

LIMIT = 0.12  # rad, up to which the series is exact to rounding
DEGREE = 12


def slow_motion(
    K: Array, c: Array, pi0: Array, axes: Matrix, rate: Array, t: Array
) -> tuple[Matrix, Vector]:
    """Attitudes relative to the first and momenta at times `t`, in the body frame.

    J^-1 = K + cI and the momentum are in given axes, the columns of a rotation. With a bound on
    the `rate` of M_c, `rate` |t| is at most `LIMIT`.
    """
    # In units of the rate: the powers of a thin body's K would overflow.
    scaled = jnp.broadcast_to(t * rate, (4, *t.shape))
    w, v = quaternions.split(horner(scaled, _series(K / rate, pi0)[:, :, None]), axis=0)
    half, start = c * t / 2, xyz.split(pi0)
    angle = half * half * xyz.dot(start, start)
    cosine, sine = 1 - angle / 2 * sinc_sqrt(angle / 4) ** 2, half * sinc_sqrt(angle)
    q = quaternions.multiply((cosine, xyz.scale(sine, start)), (w, v))
    q, start = (q[0], xyz.apply(axes, q[1])), xyz.apply(axes, start)
    # Divisions, so that XLA stores the results, rather than to compute them anew for each use.
    size = jnp.sqrt(q[0] * q[0] + xyz.dot(q[1], q[1]))
    q = q[0] / size, (q[1][0] / size, q[1][1] / size, q[1][2] / size)
    back = quaternions.conjugate(q)
    units = jnp.eye(3, dtype=t.dtype)
    a, b, d = (quaternions.rotate(back, xyz.split(unit)) for unit in units)
    return (a, b, d), quaternions.rotate(back, start)


def _series(K: Array, pi0: Array) -> Array:
    """Coefficients (degree + 1, 4) of the quaternion of M_c in time."""
    empty = jnp.zeros((DEGREE + 1, 3), pi0.dtype)
    still = jnp.zeros((DEGREE + 1, 4), pi0.dtype).at[0, 0].set(1)

    def extend(carry, n):
        pis, omegas, turns = carry  # omegas: the last one first
        omegas = jnp.concatenate([xyz.matmul(K, pis[n - 1])[None], omegas[:-1]])
        w, v = quaternions.split(turns)
        turn = quaternions.multiply((w, v), (jnp.zeros_like(w), xyz.split(omegas)))
        degree = n.astype(pi0.dtype)
        pis = pis.at[n].set(jnp.sum(jnp.cross(pis, omegas), axis=0) / degree)
        turns = turns.at[n].set(jnp.sum(quaternions.join(turn), axis=0) / (2 * degree))
        return (pis, omegas, turns), None

    start = empty.at[0].set(pi0), empty, still
    (_, _, turns), _ = jax.lax.scan(extend, start, jnp.arange(1, DEGREE + 1))
    return turns
