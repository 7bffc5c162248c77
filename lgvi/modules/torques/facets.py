"""The torques of sunlight and of thin air on the flat faces of a spacecraft."""

from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ...core.kernels.vectors import matmul
from ...core.typed_arrays import as_floats
from ..fields import described_by, float_array, require_shape
from ..forces.law import Force
from ..known_vector import KnownVector, as_known_vector, require_direction
from .of_known_vectors import AbstractTorqueOfKnownVectors

SOLAR_PRESSURE = 4.56e-6  # N/m², of sunlight on a black surface at the distance of the Earth


class Facets(eqx.Module):
    """The flat faces of a body, in the body frame. Faces do not shade each other.

    Parameters
    ----------
    areas
        Areas (faces,), m².
    normals
        Directions (faces, 3) outward, whose lengths, above zero, have no effect.
    centres
        Centres (faces, 3) of the faces from the centre of mass, m. All three are learnable leaves.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    areas: Float[Array, " faces"] = eqx.field(
        converter=float_array("areas"), metadata=described_by("m²")
    )
    normals: Float[Array, "faces 3"] = eqx.field(
        converter=float_array("normals"), metadata=described_by("1")
    )
    centres: Float[Array, "faces 3"] = eqx.field(
        converter=float_array("centres"), metadata=described_by("m")
    )

    def __check_init__(self):
        if self.areas.ndim != 1:
            raise ValueError(
                f"Argument `areas` must have shape (faces,), but its shape is {self.areas.shape}."
            )
        for name in ("normals", "centres"):
            require_shape(name, getattr(self, name), (len(self.areas), 3))

    @classmethod
    def of_box(
        cls, edges: Sequence[float] | np.ndarray, centre: Sequence[float] | np.ndarray = (0, 0, 0)
    ) -> "Facets":
        """The six faces of a box with edges along the axes.

        Parameters
        ----------
        edges
            Lengths (3,) of the edges, m.
        centre
            Place (3,) of the middle of the box from the centre of mass, m.

        Raises
        ------
        ValueError, TypeError
            For a wrong shape or type.
        """
        lengths, middle = as_floats(edges=(edges, (3,)), centre=(centre, (3,)))
        normals = jnp.concatenate([jnp.eye(3), -jnp.eye(3)]).astype(lengths.dtype)
        areas = jnp.tile(jnp.roll(lengths, 1) * jnp.roll(lengths, 2), 2)
        return cls(areas, normals, middle[None] + normals * lengths[None] / 2)

    def seen_from(self, vector: Float[Array, "3"]) -> tuple[Array, Array, Array, Array]:
        """Areas (faces,), unit normals and centres (faces, 3), and the part of a vector along each
        normal (faces,), zero for faces that look away.
        """
        n = len(self.areas)
        vector, areas, normals, centres = as_floats(
            vector=(vector, (3,)),
            areas=(self.areas, (n,)),
            normals=(self.normals, (n, 3)),
            centres=(self.centres, (n, 3)),
        )
        normals = normals / jnp.linalg.norm(normals, axis=1, keepdims=True)
        return areas, normals, centres, jnp.maximum(matmul(normals, vector), 0)


class AbstractTorqueOfFacets(AbstractTorqueOfKnownVectors):
    """The torque and the force on a body of what acts on its faces."""

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        return jnp.sum(jnp.cross(*self._at_faces(t, R)), axis=0)

    @property
    def force_law(self) -> Force:
        """The sum of the forces on the faces."""
        return self._force

    def _force(self, t: Any, R: Any, omega: Any, v: Any) -> Float[Array, "3"]:
        return jnp.sum(self._at_faces(t, R)[1], axis=0)

    @abstractmethod
    def _at_faces(
        self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]
    ) -> tuple[Float[Array, "faces 3"], Float[Array, "faces 3"]]:
        """The centres of the faces, m, and the forces on them, N, body frame."""


class SolarPressure(AbstractTorqueOfFacets):
    r"""The torque of sunlight on the faces of a spacecraft.

    With the pressure $P$, the direction $s$ of the Sun in the body frame, and a face of area $A$
    with normal $n$ and centre $c$, which the Sun sees under $\cos\theta = n\cdot s > 0$,

    $$\tau = \sum c\times F,\qquad F = -P A\cos\theta\,
    \left((1-\rho)\,s + 2\left(\rho\cos\theta + \tfrac13\delta\right) n\right),$$

    where $\rho$ is the part of the light that is reflected as by a mirror, and $\delta$ the part
    that is reflected in all directions, by Lambert's law. The shadow of the Earth, and the heat
    that the faces radiate, are not in the law: `lambda t, R: lit(t) * law(t, R)` is one in which
    the Sun sets. Where a face comes into view the torque has a kink, and a step of a higher order
    is there of order 2 only.

    Parameters
    ----------
    facets
        The faces: [`Facets`][lgvi.Facets].
    sun
        Direction $s$ (3,) to the Sun, space frame, whose length, above zero, has no effect; or a
        function of the time, s.
    mirrored, diffuse
        The parts $\rho$ and $\delta$: numbers, or one for each face (faces,), learnable leaves.
    pressure
        Pressure $P$ of sunlight on a black surface, N/m², a learnable leaf; by default that at the
        distance of the Earth, $4.56\cdot10^{-6}$.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.

    References
    ----------
    J. R. Wertz (ed.), *Spacecraft Attitude Determination and Control*, Reidel 1978, section 17.2.
    O. Montenbruck, E. Gill, *Satellite Orbits*, Springer 2000, section 3.4.
    """

    known_fields: ClassVar[tuple[str, ...]] = ("sun",)

    facets: Facets
    sun: KnownVector = eqx.field(
        converter=partial(as_known_vector, "sun"), metadata=described_by("1")
    )
    mirrored: Float[Array, "*faces"] = eqx.field(
        default=0.0, converter=float_array("mirrored"), metadata=described_by("1")
    )
    diffuse: Float[Array, "*faces"] = eqx.field(
        default=0.0, converter=float_array("diffuse"), metadata=described_by("1")
    )
    pressure: Float[Array, ""] = eqx.field(
        default=SOLAR_PRESSURE, converter=float_array("pressure"), metadata=described_by("N/m²")
    )

    def __check_init__(self):
        _require_facets(self.facets)
        faces = self.facets.areas.shape
        for name in ("mirrored", "diffuse"):
            if (shape := getattr(self, name).shape) not in ((), faces):
                raise ValueError(
                    f"Argument `{name}` must have shape () or {faces}, but its shape is {shape}."
                )
        require_shape("pressure", self.pressure, ())
        require_direction("sun", self.sun)

    def _at_faces(
        self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]
    ) -> tuple[Float[Array, "faces 3"], Float[Array, "faces 3"]]:
        """The centres of the faces, m, and the forces on them, N, body frame."""
        sun = self.in_body("sun", t, R)
        s = sun / jnp.linalg.norm(sun)
        areas, normals, centres, cosines = self.facets.seen_from(s)
        n = len(areas)
        s, rho, delta, pressure, areas, normals, centres, cosines = as_floats(
            s=(s, (3,)),
            mirrored=(jnp.broadcast_to(self.mirrored, n), (n,)),
            diffuse=(jnp.broadcast_to(self.diffuse, n), (n,)),
            pressure=(self.pressure, ()),
            areas=(areas, (n,)),
            normals=(normals, (n, 3)),
            centres=(centres, (n, 3)),
            cosines=(cosines, (n,)),
        )
        along_normal = 2 * (rho * cosines + delta / 3)
        directions = (1 - rho)[:, None] * s[None] + along_normal[:, None] * normals
        return centres, -pressure * (areas * cosines)[:, None] * directions


class FreeMolecularDrag(AbstractTorqueOfFacets):
    r"""The torque of thin air on the faces of a spacecraft in a low orbit.

    With the density $\rho$, the velocity $v$ through the air in the body frame, and a face of
    area $A$ with normal $n$ and centre $c$, on which the air falls if $n\cdot v > 0$,

    $$\tau = \sum c\times F,\qquad F = -\tfrac12 C_D\,\rho A\,(n\cdot v)\,v.$$

    Molecules that stay on the face for a while give it all their momentum: $C_D = 2$, and a little
    more as they leave again. The velocity is that of the centre of mass: that of the faces about
    it, and of the molecules by their heat, are not in the law. Where a face comes into view the
    torque has a kink, and a step of a higher order is there of order 2 only.

    Parameters
    ----------
    facets
        The faces: [`Facets`][lgvi.Facets].
    velocity
        Velocity $v$ (3,) through the air, space frame, m/s; or a function of the time, s.
    density
        Density $\rho$, kg/m³, a learnable leaf.
    drag_coefficient
        Coefficient $C_D$, a learnable leaf; 2.2 by default.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.

    References
    ----------
    J. R. Wertz (ed.), *Spacecraft Attitude Determination and Control*, Reidel 1978, section 17.2.
    """

    known_fields: ClassVar[tuple[str, ...]] = ("velocity",)

    facets: Facets
    velocity: KnownVector = eqx.field(
        converter=partial(as_known_vector, "velocity"), metadata=described_by("m/s")
    )
    density: Float[Array, ""] = eqx.field(
        converter=float_array("density"),
        metadata=described_by("kg/m³", "a known `drag_coefficient`"),
    )
    drag_coefficient: Float[Array, ""] = eqx.field(
        default=2.2,
        converter=float_array("drag_coefficient"),
        metadata=described_by("1", "a known `density`"),
    )

    def __check_init__(self):
        _require_facets(self.facets)
        require_shape("density", self.density, ())
        require_shape("drag_coefficient", self.drag_coefficient, ())

    def _at_faces(
        self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]
    ) -> tuple[Float[Array, "faces 3"], Float[Array, "faces 3"]]:
        """The centres of the faces, m, and the forces on them, N, body frame."""
        v = self.in_body("velocity", t, R)
        areas, _, centres, along_normals = self.facets.seen_from(v)
        n = len(areas)
        v, density, coefficient, areas, centres, along_normals = as_floats(
            velocity=(v, (3,)),
            density=(self.density, ()),
            drag_coefficient=(self.drag_coefficient, ()),
            areas=(areas, (n,)),
            centres=(centres, (n, 3)),
            along_normals=(along_normals, (n,)),
        )
        return centres, -coefficient / 2 * density * (areas * along_normals)[:, None] * v[None]


def _require_facets(facets: object) -> None:
    if not isinstance(facets, Facets):
        raise TypeError(f"Argument `facets` must be `Facets`, but is {facets!r}.")
