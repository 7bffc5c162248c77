"""Damping: torques against the angular velocity of a body."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ...core.kernels.vectors import matmul
from ...core.typed_arrays import as_floats
from ..fields import described_by, float_array, require_shape
from .law import AbstractTorque


class LinearDamping(AbstractTorque):
    r"""The torque $-D\omega$ of linear damping, for trajectories of order 2.

    A simulation takes each kick by the implicit midpoint rule, so that damping alone never
    increases the kinetic energy, whatever the step. Damping that is much faster than the step,
    $h|D| > 4|J|$, is however too slow: take a smaller step there.

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

    matrix: Float[Array, "3 3"] = eqx.field(
        converter=float_array("matrix"),
        metadata=described_by("N m s", below_zero="the log may run backwards"),
    )

    def __check_init__(self):
        require_shape("matrix", self.matrix, (3, 3))

    def __call__(
        self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"], omega: Float[ArrayLike, "3"]
    ) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        D, omega = as_floats(matrix=(self.matrix, (3, 3)), omega=(omega, (3,)))
        return -matmul(D, omega)

    @property
    def depends_on_attitude(self) -> bool:
        """False."""
        return False

    @property
    def depends_on_rate(self) -> bool:
        """True."""
        return True

    @property
    def linear_damping(self) -> Float[Array, "3 3"]:
        """The matrix."""
        return self.matrix


class QuadraticDamping(AbstractTorque):
    r"""The torque $-|\omega|\,C\omega$ of drag in air or water, for trajectories of order 2.

    As [`LinearDamping`][lgvi.LinearDamping] it never increases the kinetic energy.

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

    matrix: Float[Array, "*shape"] = eqx.field(
        converter=float_array("matrix"),
        metadata=described_by("N m s²", below_zero="the log may run backwards"),
    )

    def __check_init__(self):
        if self.matrix.shape not in ((3,), (3, 3)):
            raise ValueError(
                "Argument `matrix` must have shape (3,) or (3, 3), but its shape is "
                f"{self.matrix.shape}."
            )

    def __call__(
        self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"], omega: Float[ArrayLike, "3"]
    ) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        C, omega = as_floats(matrix=(self.quadratic_damping, (3, 3)), omega=(omega, (3,)))
        return -jnp.linalg.norm(omega) * matmul(C, omega)

    @property
    def depends_on_attitude(self) -> bool:
        """False."""
        return False

    @property
    def depends_on_rate(self) -> bool:
        """True."""
        return True

    @property
    def quadratic_damping(self) -> Float[Array, "3 3"]:
        """The matrix (3, 3)."""
        return self.matrix if self.matrix.ndim > 1 else jnp.diag(self.matrix)
