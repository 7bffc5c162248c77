"""A rigid body that carries spinning rotors."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..core.checks import as_floats
from ..core.diagnostics import energy
from ..core.kernels.vectors import matmul
from .body import AbstractRigidBody
from .fields import float_array, require_shape


class Gyrostat(AbstractRigidBody):
    r"""A rigid body with rotors: reaction wheels, control moment gyros, propellers.

    The total body angular momentum, which is the state of a simulation, is

    $$\pi = J\omega + \rho$$

    with the inertia $J$ of the body with locked rotors, and the momentum $\rho$ of the rotors
    relative to the body. $R\pi$ is conserved without torque, whatever the rotors do; so the torque
    of a motor is not a torque here, but a change of $\rho$. With known rotors the scale of the
    inertia is observable from attitudes alone.

    Parameters
    ----------
    inertia
        Inertia (3, 3) about the centre of mass with the rotors locked, body frame, kg m²:
        symmetric positive definite. The values are not checked. A learnable leaf.
    rotor_momentum
        Momentum $\rho$ relative to the body, body frame, kg m²/s, a learnable leaf: (3,), or
        (steps, 3), the momentum in each step, best at the middle of the step. A simulation then has
        as many steps.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    inertia: Float[Array, "3 3"] = eqx.field(converter=float_array("inertia"))
    rotor_momentum: Float[Array, "*steps 3"] = eqx.field(converter=float_array("rotor_momentum"))

    def __check_init__(self):
        require_shape("inertia", self.inertia, (3, 3))
        shape = self.rotor_momentum.shape
        if len(shape) not in (1, 2) or shape[-1] != 3:
            raise ValueError(
                "Argument `rotor_momentum` must have shape (3,) or (steps, 3), but its shape is "
                f"{shape}."
            )

    def energy(self, pi: Float[ArrayLike, "3"]) -> Float[Array, ""]:
        r"""Kinetic energy $\tfrac12\,\omega\cdot J\omega$, J, without that of the rotors' spin.

        The motion conserves it while `rotor_momentum` is constant and there is no torque; steps
        do so up to their error, without drift.
        """
        return energy(self._of_body(pi), self.inertia)

    def angular_velocity(self, pi: Float[ArrayLike, "3"]) -> Float[Array, "3"]:
        r"""Angular velocity $\omega = J^{-1}(\pi - \rho)$ (3,), body frame, rad/s."""
        of_body, J = as_floats(pi=(self._of_body(pi), (3,)), J=(self.inertia, (3, 3)))
        return jnp.linalg.solve(J, of_body)

    def angular_momentum(self, omega: Float[ArrayLike, "3"]) -> Float[Array, "3"]:
        r"""Total angular momentum $\pi = J\omega + \rho$ (3,), body frame, kg m²/s."""
        omega, J, rotor = as_floats(
            omega=(omega, (3,)), J=(self.inertia, (3, 3)), rotor_momentum=(self._rotor(), (3,))
        )
        return matmul(J, omega) + rotor

    def _of_body(self, pi: ArrayLike) -> Array:
        pi, rotor = as_floats(pi=(pi, (3,)), rotor_momentum=(self._rotor(), (3,)))
        return pi - rotor

    def _rotor(self) -> Array:
        if self.rotor_momentum.ndim > 1:
            raise ValueError(
                "Argument `rotor_momentum` must have shape (3,) for velocities and energies, but "
                f"its shape is {self.rotor_momentum.shape}: make a `Gyrostat` of one step's."
            )
        return self.rotor_momentum
