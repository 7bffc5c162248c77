"""A body whose inertia is known in time."""

import equinox as eqx
from jaxtyping import Array, Float

from .body import AbstractRigidBody
from .fields import float_array


class VaryingRigidBody(AbstractRigidBody):
    r"""A body whose inertia is known in time: booms unfold, masses slide, fuel is pumped.

    The body angular momentum, which is the state of a simulation, is

    $$\pi = J(t)\,\omega,$$

    as long as what moves in the body has no angular momentum relative to the body frame: booms that
    unfold in opposite pairs, masses on lines through the centre of mass. Mass that leaves the body
    or joins it has angular momentum of its own, which is not in this model. A step with the inertia
    at its middle is of order 2. Without torque $R\pi$ is conserved to rounding, whatever the
    inertia does; the energy $\tfrac12\,\pi\cdot J^{-1}\pi$ is not, as what moves the parts does
    work.

    It is for simulations of order 2, under torques that depend on nothing but time.
    `RigidBody(body.inertia[k])` has the velocity and the energy in step `k`.

    Parameters
    ----------
    inertia
        Inertias (steps, 3, 3) about the centre of mass, body frame, kg m²: those in the steps, best
        at the middle of each step, symmetric positive definite, which an integrator checks. A
        learnable leaf. A simulation has as many steps.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    inertia: Float[Array, "steps 3 3"] = eqx.field(converter=float_array("inertia"))

    def __check_init__(self):
        shape = self.inertia.shape
        if len(shape) != 3 or shape[1:] != (3, 3) or 0 in shape:
            raise ValueError(
                "Argument `inertia` must have shape (steps, 3, 3) and at least one step, but its "
                f"shape is {shape}."
            )
