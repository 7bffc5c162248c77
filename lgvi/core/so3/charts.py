r"""Charts of the group: rotation vectors, Rodrigues vectors and quaternions."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from ..kernels import matrix_properties as properties
from ..kernels.vectors import matmul
from ..typed_arrays import as_floats, as_one_program
from .series import horner, sinc_sqrt


@as_one_program
def hat(v: Float[ArrayLike, "3"]) -> Float[Array, "3 3"]:
    r"""Skew-symmetric matrix of a vector: $\hat v\, w = v \times w$.

    Parameters
    ----------
    v
        Vector (3,).

    Returns
    -------
    Array
        Skew-symmetric matrix (3, 3).
    """
    (v,) = as_floats(v=(v, (3,)))
    zero = jnp.zeros_like(v[0])
    return jnp.stack(
        [
            jnp.stack([zero, -v[2], v[1]]),
            jnp.stack([v[2], zero, -v[0]]),
            jnp.stack([-v[1], v[0], zero]),
        ]
    )


@as_one_program
def vee(S: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
    r"""Vector of the skew-symmetric part of a matrix, the inverse of [`hat`][lgvi.core.so3.hat].

    Parameters
    ----------
    S
        Matrix (3, 3). Its symmetric part is ignored.

    Returns
    -------
    Array
        $v$ (3,) with $\hat v = (S - S^T)/2$.
    """
    (S,) = as_floats(S=(S, (3, 3)))
    return jnp.stack([S[2, 1] - S[1, 2], S[0, 2] - S[2, 0], S[1, 0] - S[0, 1]]) / 2


@as_one_program
def is_rotation(
    R: Float[ArrayLike, "3 3"], tolerance: Float[ArrayLike, ""] = 1e-3
) -> Bool[Array, ""]:
    r"""Whether a matrix is a rotation: no entry of $R^TR - I$ above `tolerance`, $\det R > 0$.

    Parameters
    ----------
    R
        Matrix (3, 3).
    tolerance
        The largest error of an entry. By default 1e-3, as for [`log`][lgvi.core.so3.log] and
        for recordings.

    Returns
    -------
    Array
        True or False (); False where an entry is NaN.
    """
    R, tolerance = as_floats(R=(R, (3, 3)), tolerance=(tolerance, ()))
    return properties.is_rotation(R, tolerance)


@as_one_program
def exp(g: Float[ArrayLike, "3"]) -> Float[Array, "3 3"]:
    r"""Rotation of a rotation vector, by Rodrigues' formula.

    $$\operatorname{Exp}(g) = I + \frac{\sin\theta}{\theta}\,\hat g
      + \frac{1-\cos\theta}{\theta^2}\,\hat g^2,\qquad \theta = |g|.$$

    Parameters
    ----------
    g
        Rotation vector (3,), rad: axis times angle.

    Returns
    -------
    Array
        Rotation matrix (3, 3).
    """
    (g,) = as_floats(g=(g, (3,)))
    x = g @ g
    # (1 - cos t)/t^2 = (sin(t/2)/(t/2))^2 / 2 has no cancellation at small t.
    return quadratic_in_hat(g, sinc_sqrt(x), sinc_sqrt(x / 4) ** 2 / 2)


@as_one_program
def log(R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
    r"""Rotation vector of a rotation, the inverse of [`exp`][lgvi.core.so3.exp].

    With the unit quaternion $(w, v)$ of $R$, $w \ge 0$:
    $g = 2\operatorname{atan2}(|v|, w)\, v/|v|$, so $|g| \le \pi$.

    Parameters
    ----------
    R
        Rotation matrix (3, 3).

    Returns
    -------
    Array
        Rotation vector (3,), rad, of length at most $\pi$; NaN for a matrix that is not a rotation
        (see [`is_rotation`][lgvi.core.so3.is_rotation]).

    Notes
    -----
    At exactly half a turn the axis is determined up to sign; one of the two
    vectors is returned, with its derivative.
    """
    (R,) = as_floats(R=(R, (3, 3)))
    wxyz = matrix_to_wxyz(R)
    w, v = wxyz[0], wxyz[1:]
    s2 = v @ v
    x = s2 / jnp.where(w > 0.5, w, 1) ** 2
    small = (w > 0.5) & (x < 1e-2)
    # atan(sqrt x)/sqrt x as a series, so that no square root of zero is differentiated.
    series = horner(x, [(-1) ** k / (2 * k + 1) for k in range(8)])
    s = jnp.sqrt(jnp.where(small, 1, s2))
    scale = jnp.where(small, series / jnp.where(small, w, 1), jnp.arctan2(s, w) / s)
    return 2 * scale * v


@as_one_program
def distance(R1: Float[ArrayLike, "3 3"], R2: Float[ArrayLike, "3 3"]) -> Float[Array, ""]:
    r"""Angle of the turn from one rotation to another: $|\operatorname{Log}(R_1^T R_2)|$.

    Parameters
    ----------
    R1, R2
        Rotation matrices (3, 3).

    Returns
    -------
    Array
        Angle (), rad, from 0 to $\pi$; NaN if $R_1^T R_2$ is not a rotation.

    Notes
    -----
    At an angle of zero the angle has no derivative, and at half a turn one to each side. There the
    derivative is zero (a subgradient), and that of one side.
    """
    R1, R2 = as_floats(R1=(R1, (3, 3)), R2=(R2, (3, 3)))
    g = log(matmul(R1.T, R2))
    square = g @ g
    # The square root of zero is not differentiated.
    return jnp.where(square == 0, 0, jnp.sqrt(jnp.where(square == 0, 1, square)))


@as_one_program
def cayley(c: Float[ArrayLike, "3"]) -> Float[Array, "3 3"]:
    r"""Rotation of a Rodrigues (Gibbs) vector, the Cayley map.

    $$\operatorname{Cay}(c) = I + \frac{2(\hat c + \hat c^2)}{1 + c\cdot c}
      = (I - \hat c)^{-1}(I + \hat c),\qquad c = \tan(\theta/2)\,\text{axis}.$$

    Parameters
    ----------
    c
        Rodrigues vector (3,), dimensionless.

    Returns
    -------
    Array
        Rotation matrix (3, 3). Every finite `c` gives a rotation; half turns are at infinity.
    """
    (c,) = as_floats(c=(c, (3,)))
    a = 2 / (1 + c @ c)
    return quadratic_in_hat(c, a, a)


@as_one_program
def cayley_inverse(R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
    r"""Rodrigues vector of a rotation: $c = \operatorname{vee}(R - R^T)/(1 + \operatorname{tr} R)$.

    Parameters
    ----------
    R
        Rotation matrix (3, 3), not a half turn.

    Returns
    -------
    Array
        Rodrigues vector (3,); it grows without bound towards half a turn. NaN for half a turn, and
        for a matrix that is not a rotation.
    """
    (R,) = as_floats(R=(R, (3, 3)))
    return jnp.where(is_rotation(R), 2 * vee(R) / (1 + jnp.trace(R)), jnp.nan)


@as_one_program
def wxyz_to_matrix(wxyz: Float[ArrayLike, "4"]) -> Float[Array, "3 3"]:
    r"""Rotation matrix of a quaternion, scalar first.

    $R = I + \frac{2}{|q|^2}(w\,\hat v + \hat v^2)$: the quaternion need not be
    normalised, and $q$ and $-q$ give the same rotation.

    Parameters
    ----------
    wxyz
        Quaternion (4,), scalar first, not zero.

    Returns
    -------
    Array
        Rotation matrix (3, 3).
    """
    (wxyz,) = as_floats(wxyz=(wxyz, (4,)))
    wxyz = wxyz / jax.lax.stop_gradient(jnp.max(jnp.abs(wxyz)))  # the square must not overflow
    w, v = wxyz[0], wxyz[1:]
    a = 2 / (wxyz @ wxyz)
    return quadratic_in_hat(v, a * w, a)


@as_one_program
def matrix_to_wxyz(R: Float[ArrayLike, "3 3"]) -> Float[Array, "4"]:
    r"""Unit quaternion of a rotation matrix, scalar first, with $w \ge 0$.

    Parameters
    ----------
    R
        Rotation matrix (3, 3).

    Returns
    -------
    Array
        Unit quaternion (4,), scalar first; NaN for a matrix that is not a rotation.

    Notes
    -----
    All products $4 q_i q_j$ are linear in $R$; the row of the largest $q_i^2$,
    normalised, is the quaternion (the idea of Shepperd, 1978). No square root of a
    small number is taken, so the derivative is finite everywhere.

    References
    ----------
    S. W. Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1
    (1978), doi:10.2514/3.55767.
    """
    (R,) = as_floats(R=(R, (3, 3)))
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = R
    wx, wy, wz = r21 - r12, r02 - r20, r10 - r01
    xy, xz, yz = r01 + r10, r02 + r20, r12 + r21
    products = jnp.stack(
        [
            jnp.stack([1 + r00 + r11 + r22, wx, wy, wz]),
            jnp.stack([wx, 1 + r00 - r11 - r22, xy, xz]),
            jnp.stack([wy, xy, 1 - r00 + r11 - r22, yz]),
            jnp.stack([wz, xz, yz, 1 - r00 - r11 + r22]),
        ]
    )
    row = products[jnp.argmax(jnp.diagonal(products))]
    wxyz = row / jnp.sqrt(row @ row)
    wxyz = jnp.where(wxyz[0] < 0, -wxyz, wxyz)
    return jnp.where(is_rotation(R), wxyz, jnp.nan)


def quadratic_in_hat(v: Array, a: Array | float, b: Array) -> Array:
    """I + a hat(v) + b hat(v)^2."""
    V = hat(v)
    return jnp.eye(3, dtype=v.dtype) + a * V + b * matmul(V, V)
