"""Torques that brake a body: they depend on its angular velocity."""

import equinox as eqx
from jaxtyping import Array, ArrayLike, Float

from ..fields import float_array, require_shape
from .base import AbstractTorque


class LinearDamping(AbstractTorque):
    r"""The torque $-D\omega$ of linear damping, for trajectories of order 2.

    It depends on the angular velocity, so that it is not to be called: pass it, or a sum with
    other laws, to `simulate`. There each kick is by the implicit midpoint rule, so that damping
    alone never increases the kinetic energy, whatever the step. Damping that is much faster than
    the step, $h|D| > 4|J|$, is however too slow: take a smaller step there.

    Parameters
    ----------
    matrix
        Damping $D$ (3, 3), body frame, N m s, a learnable leaf. It dissipates energy if its
        symmetric part is positive semidefinite; the values are not checked.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    matrix: Float[Array, "3 3"] = eqx.field(converter=float_array("matrix"))

    def __check_init__(self):
        require_shape("matrix", self.matrix, (3, 3))

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Not a function of time and attitude: raises TypeError."""
        raise TypeError(
            "A `LinearDamping` depends on the angular velocity and cannot be called with `t` and "
            "`R`: pass it as `torque` to `simulate`."
        )


class QuadraticDamping(AbstractTorque):
    r"""The torque $-|\omega|\,C\omega$ of drag in air or water, for trajectories of order 2.

    As [`LinearDamping`][lgvi.LinearDamping] it depends on the angular velocity: it is not to be
    called, and never increases the kinetic energy.

    Parameters
    ----------
    matrix
        Coefficients $C$ (3, 3), body frame, N m s², or their diagonal (3,), a learnable leaf. It
        dissipates energy if its symmetric part is positive semidefinite; the values are not
        checked.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    matrix: Float[Array, "*shape"] = eqx.field(converter=float_array("matrix"))

    def __check_init__(self):
        if self.matrix.shape not in ((3,), (3, 3)):
            raise ValueError(
                "Argument `matrix` must have shape (3,) or (3, 3), but its shape is "
                f"{self.matrix.shape}."
            )

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Not a function of time and attitude: raises TypeError."""
        raise TypeError(
            "A `QuadraticDamping` depends on the angular velocity and cannot be called with `t` "
            "and `R`: pass it as `torque` to `simulate`."
        )
