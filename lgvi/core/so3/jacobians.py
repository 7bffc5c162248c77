r"""Jacobians of the exponential map: how a rotation changes with its rotation vector.

$$\operatorname{Exp}(g + \delta) \approx \operatorname{Exp}(J_l\,\delta)\operatorname{Exp}(g)
  = \operatorname{Exp}(g)\operatorname{Exp}(J_r\,\delta).$$
"""

from jaxtyping import Array, ArrayLike, Float

from ..typed_arrays import as_floats, as_one_program
from .charts import quadratic_in_hat
from .series import cosine_remainder, sinc_sqrt, sine_remainder


@as_one_program
def left_jacobian(g: Float[ArrayLike, "3"]) -> Float[Array, "3 3"]:
    r"""Left Jacobian of `exp`: the change of the rotation in the space frame.

    $$J_l(g) = I + \frac{1-\cos\theta}{\theta^2}\,\hat g
      + \frac{\theta-\sin\theta}{\theta^3}\,\hat g^2,\qquad \theta = |g|,$$

    so that $\operatorname{Exp}(g+\delta) = \operatorname{Exp}(J_l\delta)\operatorname{Exp}(g)
    + O(|\delta|^2)$. A spatial angular velocity is $J_l(g)\,\dot g$.

    Parameters
    ----------
    g
        Rotation vector (3,), rad.

    Returns
    -------
    Array
        Matrix (3, 3).

    References
    ----------
    T. D. Barfoot, "State Estimation for Robotics", Cambridge 2017, section 7.1.5,
    doi:10.1017/9781316671528.
    """
    (g,) = as_floats(g=(g, (3,)))
    x = g @ g
    return quadratic_in_hat(g, sinc_sqrt(x / 4) ** 2 / 2, sine_remainder(x))


@as_one_program
def left_jacobian_inverse(g: Float[ArrayLike, "3"]) -> Float[Array, "3 3"]:
    r"""Inverse of the left Jacobian.

    $$J_l(g)^{-1} = I - \tfrac12\hat g
      + \frac{1-\frac\theta2\cot\frac\theta2}{\theta^2}\,\hat g^2,\qquad \theta = |g| < 2\pi,$$

    so that $\operatorname{Log}(\operatorname{Exp}(\delta)\operatorname{Exp}(g)) = g +
    J_l^{-1}\delta + O(|\delta|^2)$ where $\theta < \pi$.

    Parameters
    ----------
    g
        Rotation vector (3,), rad, shorter than $2\pi$; at $2\pi$ the Jacobian is singular.

    Returns
    -------
    Array
        Matrix (3, 3).
    """
    (g,) = as_floats(g=(g, (3,)))
    x = g @ g / 4
    return quadratic_in_hat(g, -0.5, cosine_remainder(x) / (4 * sinc_sqrt(x)))


@as_one_program
def right_jacobian(g: Float[ArrayLike, "3"]) -> Float[Array, "3 3"]:
    r"""Right Jacobian of `exp`, $J_r(g) = J_l(-g) = J_l(g)^T$: the change in the body frame.

    $\operatorname{Exp}(g+\delta) = \operatorname{Exp}(g)\operatorname{Exp}(J_r\delta)
    + O(|\delta|^2)$. A body angular velocity is $J_r(g)\,\dot g$.

    Parameters
    ----------
    g
        Rotation vector (3,), rad.

    Returns
    -------
    Array
        Matrix (3, 3).
    """
    return left_jacobian(g).T


@as_one_program
def right_jacobian_inverse(g: Float[ArrayLike, "3"]) -> Float[Array, "3 3"]:
    r"""Inverse of the right Jacobian, $J_r(g)^{-1} = J_l(g)^{-T}$.

    $\operatorname{Log}(\operatorname{Exp}(g)\operatorname{Exp}(\delta)) = g + J_r^{-1}\delta
    + O(|\delta|^2)$ where $|g| < \pi$.

    Parameters
    ----------
    g
        Rotation vector (3,), rad, shorter than $2\pi$; at $2\pi$ the Jacobian is singular.

    Returns
    -------
    Array
        Matrix (3, 3).
    """
    return left_jacobian_inverse(g).T
