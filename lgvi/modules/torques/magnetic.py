"""The torque of a magnetic field on a magnet."""

from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ...core.kernels.vectors import Vec3
from ...core.typed_arrays import as_floats
from ..fields import described_by
from ..known_vector import KnownVector, as_known_vector
from .of_known_vectors import AbstractTorqueOfKnownVectors


class MagneticTorque(AbstractTorqueOfKnownVectors):
    r"""The torque of a field $B$ on a magnetic dipole $m$: of magnetorquers, and of what is left
    when these are off.

    $$U = -m\cdot R^TB,\qquad \tau = m\times R^TB.$$

    A spacecraft with recorded magnetorquers and a residual dipole has the sum of two laws:
    `MagneticTorque(residual, field) + gain * MagneticTorque(commands, field)`.

    Parameters
    ----------
    dipole
        Dipole $m$ (3,), body frame, A m², a learnable leaf; or a function of the time, s, that
        gives it, such as a [`SampledVector`][lgvi.SampledVector] of recorded commands.
    field
        Field $B$ (3,), space frame, T, a learnable leaf; or a function of the time, s.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.

    References
    ----------
    J. R. Wertz (ed.), *Spacecraft Attitude Determination and Control*, Reidel 1978, section 17.2.
    """

    known_fields: ClassVar[tuple[str, ...]] = ("dipole", "field")

    dipole: KnownVector = eqx.field(
        converter=partial(as_known_vector, "dipole"), metadata=described_by("A m²")
    )
    field: KnownVector = eqx.field(
        converter=partial(as_known_vector, "field"), metadata=described_by("T")
    )

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        dipole, field = self._values(t, R)
        return jnp.cross(dipole, field)

    def potential_energy(
        self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]
    ) -> Float[Array, ""]:
        """The potential energy, scalar, J."""
        dipole, field = self._values(t, R)
        return -Vec3.of(dipole).dot(Vec3.of(field))

    def _values(self, t, R):
        return as_floats(
            dipole=(self.known_at("dipole", t), (3,)), field=(self.in_body("field", t, R), (3,))
        )
