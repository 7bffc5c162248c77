"""A rigid body that carries spinning rotors."""

import equinox as eqx
from jaxtyping import Array, Float

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
        symmetric positive definite, which an integrator checks. A learnable leaf.
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
        if len(shape) not in (1, 2) or shape[-1] != 3 or 0 in shape:
            raise ValueError(
                "Argument `rotor_momentum` must have shape (3,) or (steps, 3) and at least one "
                f"step, but its shape is {shape}."
            )
