"""A force at a place of the body, such as that of a thruster."""

from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ...core.typed_arrays import as_floats
from ..fields import Frame, described_by, float_array, require_frame, require_shape
from ..forces.applied import AppliedForce
from ..known_vector import KnownVector, as_known_vector
from .of_known_vectors import AbstractTorqueOfKnownVectors


class Thruster(AbstractTorqueOfKnownVectors):
    r"""A known force at a place of the body: a thruster, or a cable. One law for both it makes.

    $$\tau = r\times f,$$

    and the force $f$ moves the centre of mass, where a simulation or a model has a `mass`. The
    momentum that the gas takes along as it turns with the body is not in the law.

    Parameters
    ----------
    place
        Where the force acts, $r$ (3,), from the centre of mass, body frame, m, a learnable leaf.
    thrust
        Force $f$ (3,), N, along the direction in which the body is pushed, a learnable leaf; or a
        function of the time, s, such as a [`SampledVector`][lgvi.SampledVector].
    frame
        The frame of the force, `"body"` or `"space"`, static.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape, type or frame.
    """

    known_fields: ClassVar[tuple[str, ...]] = ("thrust",)

    place: Float[Array, "3"] = eqx.field(
        converter=float_array("place"), metadata=described_by("m", "a known thrust")
    )
    thrust: KnownVector = eqx.field(
        converter=partial(as_known_vector, "thrust"),
        metadata=described_by("N", "a known place, and a known mass or inertia"),
    )
    frame: Frame = eqx.field(default="body", static=True)

    def __check_init__(self):
        require_shape("place", self.place, (3,))
        require_frame(self.frame)

    @property
    def depends_on_attitude(self) -> bool:
        """Whether the force is known in the space frame."""
        return self.frame != "body"

    @property
    def force_law(self) -> AppliedForce:
        """The force."""
        return AppliedForce(self.thrust, self.frame)

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        force = self.in_frame("thrust", self.frame, t, R)
        place, force = as_floats(place=(self.place, (3,)), thrust=(force, (3,)))
        return jnp.cross(place, force)
