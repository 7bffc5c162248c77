r"""Inertia matrices: the discrete inertia and coordinates of all physical inertias.

The discrete inertia $J_d = \tfrac12\operatorname{tr}(J)\,I - J$ is the second moment of
the mass distribution about the centre of mass, $\int r r^T\,dm$. A rigid body with inertia
$J$ exists exactly if $J_d$ is positive semidefinite, which is the triangle inequality of
the principal moments.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .kernels.vectors import matmul
from .typed_arrays import as_floats, as_one_program


@as_one_program
def discrete_inertia(J: Float[ArrayLike, "3 3"]) -> Float[Array, "3 3"]:
    r"""Discrete inertia $J_d = \tfrac12\operatorname{tr}(J)\,I - J$.

    Parameters
    ----------
    J
        Inertia (3, 3) about the centre of mass, body frame, kg m².

    Returns
    -------
    Array
        Discrete inertia (3, 3), body frame, kg m².

    References
    ----------
    J. Moser, A. P. Veselov, "Discrete versions of some classical integrable systems and
    factorization of matrix polynomials", Commun. Math. Phys. 139 (1991),
    doi:10.1007/BF02352494.
    """
    (J,) = as_floats(J=(J, (3, 3)))
    return jnp.trace(J) / 2 * jnp.eye(3, dtype=J.dtype) - J


@as_one_program
def inertia_from_discrete(Jd: Float[ArrayLike, "3 3"]) -> Float[Array, "3 3"]:
    r"""Inertia $J = \operatorname{tr}(J_d)\,I - J_d$, the inverse of `discrete_inertia`.

    Parameters
    ----------
    Jd
        Discrete inertia (3, 3), body frame, kg m².

    Returns
    -------
    Array
        Inertia (3, 3), body frame, kg m².
    """
    (Jd,) = as_floats(Jd=(Jd, (3, 3)))
    d = jnp.diagonal(Jd)
    # The diagonal as a sum of two terms: tr(Jd) - Jd_ii would cancel for a rod.
    return jnp.diag(jnp.roll(d, 1) + jnp.roll(d, 2)) - (Jd - jnp.diag(d))


@as_one_program
def inertia_from_principal_moments(
    moments: Float[ArrayLike, "3"] | Sequence[ArrayLike],
    axes: Float[ArrayLike, "3 3"] | None = None,
) -> Float[Array, "3 3"]:
    r"""Inertia $J = A \operatorname{diag}(m) A^T$.

    Parameters
    ----------
    moments
        Principal moments $m$ (3,), kg m².
    axes
        Orthogonal matrix $A$ (3, 3) whose columns are the principal axes in body
        coordinates. The identity by default.

    Returns
    -------
    Array
        Inertia (3, 3), body frame, kg m².
    """
    if axes is None:
        (moments,) = as_floats(moments=(moments, (3,)))
        return jnp.diag(moments)
    moments, axes = as_floats(moments=(moments, (3,)), axes=(axes, (3, 3)))
    J = matmul(axes * moments[None, :], axes.T)
    return (J + J.T) / 2


@as_one_program
def inertia_from_log_cholesky(coordinates: Float[ArrayLike, "6"]) -> Float[Array, "3 3"]:
    r"""Physical inertia from the log-Cholesky coordinates of its discrete inertia.

    $J = \operatorname{tr}(J_d)\,I - J_d$ with $J_d = M D^2 M^T$,
    $D = \operatorname{diag}(e^{\theta_1}, e^{\theta_2}, e^{\theta_3})$ and $M$ unit lower
    triangular with $M_{21} = \theta_4$, $M_{31} = \theta_5$, $M_{32} = \theta_6$. So $MD$ is
    the Cholesky factor of $J_d$.

    Parameters
    ----------
    coordinates
        $\theta$ (6,): three logarithms of the diagonal of the Cholesky factor, then its
        entries below the diagonal divided by the diagonal entry of their column.

    Returns
    -------
    Array
        Inertia (3, 3), body frame, kg m²; every real $\theta$ gives an inertia whose
        principal moments satisfy the triangle inequality strictly.

    Notes
    -----
    Dividing by the diagonal makes the last three coordinates free of units: a change of
    the unit of inertia only adds a constant to the first three. An optimiser that takes
    steps of the same size in every coordinate then works equally well for a satellite and
    for a drone. The drawback is large coordinates for bodies that are nearly flat across the
    first or second body axis. A factor of $J$ instead of $J_d$ would only ensure that $J$
    is positive definite.

    References
    ----------
    P. M. Wensing, S. Kim, J.-J. E. Slotine, "Linear matrix inequalities for physically
    consistent inertial parameter identification", IEEE RA-L 3 (2018),
    doi:10.1109/LRA.2017.2729659. C. Rucker, P. M. Wensing, "Smooth parameterization of
    rigid-body inertia", IEEE RA-L 7 (2022), doi:10.1109/LRA.2022.3144517.
    """
    (theta,) = as_floats(coordinates=(coordinates, (6,)))
    M = jnp.eye(3, dtype=theta.dtype).at[(1, 2, 2), (0, 0, 1)].set(theta[3:])
    factor = M * jnp.exp(theta[None, :3])
    return inertia_from_discrete(matmul(factor, factor.T))


@as_one_program
def log_cholesky_from_inertia(J: Float[ArrayLike, "3 3"]) -> Float[Array, "6"]:
    """Log-Cholesky coordinates, the inverse of `inertia_from_log_cholesky`.

    Parameters
    ----------
    J
        Inertia (3, 3), body frame, kg m², symmetric, with principal moments that satisfy
        the triangle inequality strictly; otherwise the result contains NaN.

    Returns
    -------
    Array
        Coordinates (6,).
    """
    (J,) = as_floats(J=(J, (3, 3)))
    factor = jnp.linalg.cholesky(discrete_inertia(J))
    diagonal = jnp.diagonal(factor)
    below = (factor / diagonal[None, :])[(1, 2, 2), (0, 0, 1)]
    return jnp.concatenate([jnp.log(diagonal), below])
