"""Torque laws that come from a potential energy."""

from collections.abc import Callable
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ...core.kernels.vectors import Mat3, Vec3, matmul
from ...core.typed_arrays import as_floats
from ..arguments import inertia_of
from ..body import AbstractRigidBody
from ..fields import described_by, float_array, require_function, require_shape
from ..known_vector import KnownVector, as_known_vector
from ..units import STANDARD_GRAVITY
from .law import AbstractTorque
from .of_known_vectors import AbstractTorqueOfKnownVectors


def _inertia(value):
    return None if value is None else float_array("inertia")(value)


class PotentialTorque(AbstractTorque):
    r"""The torque of any potential energy $U(R)$, minus its left-trivialised gradient:

    $$\tau\cdot e = -\frac{d}{ds}\Big|_{s=0} U(R\operatorname{Exp}(s e)).$$

    Parameters
    ----------
    potential
        Function of the attitude (3, 3) that gives an energy, scalar, J. The gradient is by
        automatic differentiation. If it is a module, its leaves are learnable.
    """

    potential: Callable[[Array], Array]

    def __check_init__(self):
        require_function("potential", self.potential, ("R",))

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        (R,) = as_floats(R=(R, (3, 3)))
        gradient = jax.grad(self._energy)(R)
        # The derivative along R hat(e) is the sum of (row of gradient) . (row of R x e).
        rows = zip(Mat3.of(gradient), Mat3.of(R), strict=True)
        a, b, c = (row.cross(row_of_R) for row, row_of_R in rows)
        return -(a + b + c).array()

    def potential_energy(
        self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]
    ) -> Float[Array, ""]:
        """The potential energy, scalar, J."""
        (R,) = as_floats(R=(R, (3, 3)))
        return self._energy(R)

    def _energy(self, R: Array) -> Array:
        return as_floats(**{"potential(R)": (self.potential(R), ())})[0]


class UniformGravity(AbstractTorque):
    r"""Weight of a body that turns about a fixed point: the 3D pendulum and the heavy top.

    With the vertical unit vector $e_3$, up along the space frame's z axis, and the offset
    $\rho$,

    $$U = m g\, e_3\cdot R\rho,\qquad \tau = m g\, (R^Te_3)\times\rho.$$

    The body's inertia is then that about the pivot.

    Parameters
    ----------
    mass
        Mass $m$, kg, a learnable leaf.
    offset
        Vector $\rho$ (3,) from the pivot to the centre of mass, body frame, m, a learnable leaf.
    g
        Acceleration of gravity, m/s², a learnable leaf; the standard one by default.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    mass: Float[Array, ""] = eqx.field(
        converter=float_array("mass"),
        metadata=described_by("kg", below_zero="the `offset` may be reversed"),
    )
    offset: Float[Array, "3"] = eqx.field(
        converter=float_array("offset"), metadata=described_by("m")
    )
    g: Float[Array, ""] = eqx.field(
        default=STANDARD_GRAVITY,
        converter=float_array("g"),
        metadata=described_by("m/s²", below_zero="the `offset` may be reversed"),
    )

    def __check_init__(self):
        require_shape("mass", self.mass, ())
        require_shape("offset", self.offset, (3,))
        require_shape("g", self.g, ())

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        R, weight, offset = self._values(R)
        return weight * jnp.cross(R[2], offset)

    def potential_energy(
        self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]
    ) -> Float[Array, ""]:
        """The potential energy, scalar, J, nothing where the centre of mass is level."""
        R, weight, offset = self._values(R)
        return weight * Vec3.of(R[2]).dot(Vec3.of(offset))

    def _values(self, R):
        R, mass, g, offset = as_floats(
            R=(R, (3, 3)), mass=(self.mass, ()), g=(self.g, ()), offset=(self.offset, (3,))
        )
        return R, mass * g, offset


class GravityGradient(AbstractTorqueOfKnownVectors):
    r"""Torque of a central body's gravity gradient, on a body small against the distance.

    With the position $r$ relative to the centre of attraction and $n = R^T r/|r|$, to second
    order in size over distance,

    $$U = \frac{3\mu}{2|r|^3}\, n\cdot Jn,\qquad \tau = \frac{3\mu}{|r|^3}\, n\times Jn.$$

    Parameters
    ----------
    mu
        Gravitational parameter $\mu = GM$ of the centre, m³/s², a learnable leaf.
    position
        Position $r$ of the centre of mass (3,), space frame, m, a learnable leaf; or a function
        of the time, s, that gives it.
    inertia
        Inertia $J$ (3, 3), body frame, kg m². `None` is that of the body which `simulate` is
        given; to call the law yourself, give it here.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.

    References
    ----------
    P. C. Hughes, *Spacecraft Attitude Dynamics*, Wiley 1986, chapter 8.
    """

    known_fields: ClassVar[tuple[str, ...]] = ("position",)

    mu: Float[Array, ""] = eqx.field(
        converter=float_array("mu"),
        metadata=described_by("m³/s²", below_zero="the attitudes may be space to body"),
    )
    position: KnownVector = eqx.field(converter=partial(as_known_vector, "position"))
    inertia: Float[Array, "3 3"] | None = eqx.field(default=None, converter=_inertia)

    def __check_init__(self):
        require_shape("mu", self.mu, ())
        if self.inertia is not None:
            require_shape("inertia", self.inertia, (3, 3))

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        strength, n, Jn = self._values(t, R)
        return strength * jnp.cross(n, Jn)

    def potential_energy(
        self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]
    ) -> Float[Array, ""]:
        """The part of the potential energy, scalar, J, that depends on the attitude."""
        strength, n, Jn = self._values(t, R)
        return strength / 2 * Vec3.of(n).dot(Vec3.of(Jn))

    def of_body(self, body: AbstractRigidBody) -> "GravityGradient":
        """The law with the inertia of the body, unless it has its own."""
        inertia = inertia_of(body) if self.inertia is None else self.inertia
        return GravityGradient(self.mu, self.position, inertia)

    def _values(self, t, R):
        if self.inertia is None:
            raise ValueError(
                "Argument `inertia` of `GravityGradient` must be given to call it, but is None; "
                "`simulate` takes that of the body."
            )
        r, R, J, mu = as_floats(
            position=(self.known_at("position", t), (3,)),
            R=(R, (3, 3)),
            inertia=(self.inertia, (3, 3)),
            mu=(self.mu, ()),
        )
        distance = jnp.linalg.norm(r)
        n = matmul(R.T, r / distance)
        # Divided one by one: the third power of a distance in metres may overflow in float32.
        return 3 * mu / distance / distance / distance, n, matmul((J + J.T) / 2, n)
