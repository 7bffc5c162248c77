"""The exact motion of a body without torque."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..core.exact.motion import free_motion as exact
from ..core.typed_arrays import as_floats, as_real
from .arguments import inertia_of
from .body import AbstractRigidBody
from .convergence_error import describe_impossible, is_possible
from .errors import error_if


def free_motion(
    body: AbstractRigidBody,
    R0: Float[ArrayLike, "3 3"],
    pi0: Float[ArrayLike, "3"],
    times: Float[ArrayLike, "*times"],
) -> tuple[Float[Array, "*times 3 3"], Float[Array, "*times 3"]]:
    r"""Exact motion of a body without torque, at any times.

    The solution of $\dot R = R\,\widehat{J^{-1}\pi}$, $\dot\pi = \pi\times J^{-1}\pi$ in Jacobi's
    elliptic and theta functions. There are no steps: each time costs the same, however long it is,
    and the error is rounding. It is differentiable with respect to body, state and times.

    Parameters
    ----------
    body
        The body, without rotors. As for an integrator, its moments may violate the triangle
        inequality.
    R0
        Attitude (3, 3) at time zero, body to space.
    pi0
        Body angular momentum (3,) at time zero, kg m²/s.
    times
        Times (times,), s, in any order, positive or negative; or one time.

    Returns
    -------
    R : Array
        Attitudes (times, 3, 3), body to space; (3, 3) for one time.
    pi : Array
        Body angular momenta (times, 3), kg m²/s; (3,) for one time.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type, and for a body with rotors.
    RuntimeError
        If `R0` is not a rotation, the inertia is not symmetric and positive definite, or the
        momentum or a time is not finite; from inside a compiled function too, without values.

    Notes
    -----
    The error is about that of rounding the inertia, the momentum and the angle turned, also with
    equal moments, about a principal axis and near the separatrix. Near the unstable axis and the
    separatrix a motion leaves its neighbours exponentially, and so does rounding: a spin exactly
    about the middle axis stays for a growth by about 1e60, in float32 by 1e7. First derivatives are
    nearly as exact, and so are all derivatives with respect to momentum and times. Second
    derivatives with respect to the inertia lose accuracy where exactly two moments are nearly
    equal, and are NaN where two are equal.

    References
    ----------
    R. van Zon, J. Schofield, "Numerical implementation of the exact dynamics of free rigid
    bodies", J. Comput. Phys. 225 (2007), doi:10.1016/j.jcp.2006.11.019. E. Celledoni, F. Fasso,
    N. Saefstroem, A. Zanna, "The exact computation of the free rigid body motion and its use in
    splitting methods", SIAM J. Sci. Comput. 30 (2008), doi:10.1137/070704393.
    """
    inertia = inertia_of(body)
    if body.rotor_momentum is not None:
        raise ValueError(
            "Argument `body` must have no rotors, but is a "
            f"{type(body).__name__}: simulate it with a `MoserVeselovIntegrator`."
        )
    shape = as_real("times", times).shape
    if len(shape) > 1:
        raise ValueError(
            f"Argument `times` must be one time or have shape (times,), but its shape is {shape}."
        )
    R0, pi0, J, times = as_floats(
        R0=(R0, (3, 3)), pi0=(pi0, (3,)), inertia=(inertia, (3, 3)), times=(times, shape)
    )
    R, pi = exact(R0, pi0, J, times.reshape(-1))
    result = R.reshape(*shape, 3, 3), pi.reshape(*shape, 3)
    finite = jnp.all(jnp.isfinite(pi0)) & jnp.all(jnp.isfinite(times))

    def describe(R0: np.ndarray, J: np.ndarray, pi0: np.ndarray, times: np.ndarray) -> str:
        return describe_impossible("R0", R0, J) or _describe_not_finite(pi0, times)

    return error_if(result, ~(is_possible(R0, J) & finite), describe, lambda: (R0, J, pi0, times))


def _describe_not_finite(pi0: np.ndarray, times: np.ndarray) -> str:
    if not np.all(np.isfinite(pi0)):
        return f"Argument `pi0` must be finite, but is {pi0}."
    first = np.flatnonzero(~np.isfinite(np.atleast_1d(times)))[0]
    return f"Argument `times` must be finite, but entry {first} is {np.atleast_1d(times)[first]}."
