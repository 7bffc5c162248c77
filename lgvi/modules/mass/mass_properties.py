"""Mass, centre of mass and inertia of a body, and what follows for bodies joined or taken apart."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, ArrayLike, Bool, Float

from ...core.inertia import discrete_inertia, inertia_from_discrete
from ...core.kernels.matrix_properties import is_symmetric
from ...core.kernels.vectors import matmul
from ...core.typed_arrays import as_floats
from ..fields import described_by, float_array, require_shape
from ..mass import elements
from ..printing import show
from .mesh import measure_mesh


class PrincipalAxes(NamedTuple):
    """Principal moments of inertia and their axes.

    Attributes
    ----------
    moments
        Principal moments (3,) about the centre of mass, kg m², the smallest first.
    axes
        Rotation (3, 3) whose columns are the unit axes.
    """

    moments: Float[Array, "3"]
    axes: Float[Array, "3 3"]


class MassProperties(eqx.Module):
    r"""Mass, centre of mass and inertia of a body in one frame.

    `a + b` is the body of two that are joined, in the same frame, and `a - b` is the rest of `a`
    when `b` is taken out of it:

    $$m = m_a + m_b,\quad m\,c = m_a c_a + m_b c_b,\quad
      J = J_a + J_b + \frac{m_a m_b}{m}\left(|d|^2 I - d\,d^T\right),\quad d = c_b - c_a.$$

    `sum` adds several. Of bodies without mass the inertias are added, and the centre of `a + b`
    is in the middle. Where $m = 0$, but not $m\,c$, there is no such body, and its centre is not
    finite. All is differentiable, so that the standard error of a difference, by
    [`Estimate.standard_error`][lgvi.identification.Estimate] of a fit that has estimated both, has
    the errors of both.

    Parameters
    ----------
    mass
        Mass, kg.
    centre
        Centre of mass (3,), m.
    inertia
        Inertia (3, 3) about the centre of mass, along the axes of the frame, kg m².

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    mass: Float[Array, ""] = eqx.field(converter=float_array("mass"), metadata=described_by("kg"))
    centre: Float[Array, "3"] = eqx.field(
        converter=float_array("centre"), metadata=described_by("m")
    )
    inertia: Float[Array, "3 3"] = eqx.field(
        converter=float_array("inertia"), metadata=described_by("kg m²")
    )

    def __check_init__(self):
        require_shape("mass", self.mass, ())
        require_shape("centre", self.centre, (3,))
        require_shape("inertia", self.inertia, (3, 3))

    def __repr__(self) -> str:
        return show(self)

    @classmethod
    def box(
        cls, mass: Float[ArrayLike, ""], sides: Float[ArrayLike, "3"] | Sequence[ArrayLike]
    ) -> "MassProperties":
        """A solid box about the origin.

        Parameters
        ----------
        mass
            Mass, kg.
        sides
            Lengths (3,) of the sides along x, y and z, m.

        Returns
        -------
        MassProperties
            The box.
        """
        mass, sides = as_floats(mass=(mass, ()), sides=(sides, (3,)))
        return cls._of_second_moments(mass, mass * sides**2 / 12)

    @classmethod
    def cylinder(
        cls,
        mass: Float[ArrayLike, ""],
        radius: Float[ArrayLike, ""],
        length: Float[ArrayLike, ""],
    ) -> "MassProperties":
        """A solid cylinder about the origin, with its axis along z.

        Parameters
        ----------
        mass
            Mass, kg.
        radius, length
            Radius and length, m.

        Returns
        -------
        MassProperties
            The cylinder.
        """
        mass, radius, length = as_floats(mass=(mass, ()), radius=(radius, ()), length=(length, ()))
        squares = jnp.stack([radius**2 / 4, radius**2 / 4, length**2 / 12])
        return cls._of_second_moments(mass, mass * squares)

    @classmethod
    def sphere(cls, mass: Float[ArrayLike, ""], radius: Float[ArrayLike, ""]) -> "MassProperties":
        """A solid sphere about the origin.

        Parameters
        ----------
        mass
            Mass, kg.
        radius
            Radius, m.

        Returns
        -------
        MassProperties
            The sphere.
        """
        mass, radius = as_floats(mass=(mass, ()), radius=(radius, ()))
        return cls._of_second_moments(mass, jnp.broadcast_to(mass * radius**2 / 5, 3))

    @classmethod
    def rod(cls, mass: Float[ArrayLike, ""], length: Float[ArrayLike, ""]) -> "MassProperties":
        """A thin rod about the origin, along z.

        Parameters
        ----------
        mass
            Mass, kg.
        length
            Length, m.

        Returns
        -------
        MassProperties
            The rod.
        """
        mass, length = as_floats(mass=(mass, ()), length=(length, ()))
        return cls._of_second_moments(mass, mass * length**2 / 12 * jnp.eye(3, dtype=mass.dtype)[2])

    @classmethod
    def _of_second_moments(cls, mass: Array, moments: Array) -> "MassProperties":
        return cls(mass, jnp.zeros_like(moments), inertia_from_discrete(jnp.diag(moments)))

    @classmethod
    def from_mesh(
        cls,
        mesh: Any,
        mass: Float[ArrayLike, ""] | None = None,
        density: Float[ArrayLike, ""] | None = None,
    ) -> "MassProperties":
        """A solid body with the surface of a mesh. It needs the package trimesh.

        Parameters
        ----------
        mesh
            A `trimesh.Trimesh`, or the path of a file that trimesh reads, such as STL. Lengths are
            in m: scale the mesh first if they are not.
        mass
            Mass, kg; or give `density`.
        density
            Density, kg/m³.

        Returns
        -------
        MassProperties
            The body, in the frame of the mesh.

        Raises
        ------
        ValueError, TypeError
            If the mesh is not closed, or not exactly one of `mass` and `density` is given.
        FileNotFoundError, ImportError
            If the file or trimesh is missing.
        """
        if (mass is None) == (density is None):
            raise ValueError(
                "Argument `mass` or `density` must be given, and not both, but "
                f"{'none is' if mass is None else 'both are'}."
            )
        name, value = ("density", density) if mass is None else ("mass", mass)
        (size,) = as_floats(**{name: (value, ())})  # pyright: ignore[reportArgumentType]
        volume, centre, inertia = measure_mesh(mesh)
        whole = size * volume if mass is None else size
        return cls(whole, jnp.asarray(centre), whole * (inertia / volume))

    @classmethod
    def from_pseudo_inertia(cls, P: Float[ArrayLike, "4 4"]) -> "MassProperties":
        """The body of a pseudo-inertia (4, 4), the inverse of `pseudo_inertia`.

        The centre of a body without mass is the origin.
        """
        (P,) = as_floats(P=(P, (4, 4)))
        mass, first = P[3, 3], P[:3, 3]
        centre = _over(first, mass, jnp.zeros_like(mass))
        return cls(mass, centre, inertia_from_discrete(P[:3, :3] - jnp.outer(first, centre)))

    def __add__(self, other: "MassProperties") -> "MassProperties":
        if not isinstance(other, MassProperties):
            return NotImplemented
        mass = self.mass + other.mass
        apart = other.centre - self.centre
        off = _size(self, other)
        centre = self.centre + _over(other.mass * apart, mass, other.mass * off, apart / 2)
        moved = _over(other.mass * _about(self.mass, apart), mass, other.mass * self.mass * off**2)
        return MassProperties(mass, centre, self.inertia + other.inertia + moved)

    def __radd__(self, other: int) -> "MassProperties":
        """The body itself: `sum` begins with zero."""
        return self if other == 0 else NotImplemented

    def __sub__(self, other: "MassProperties") -> "MassProperties":
        if not isinstance(other, MassProperties):
            return NotImplemented
        mass = self.mass - other.mass
        apart = other.centre - self.centre  # from the centre of both together
        off = _size(self, other)
        centre = self.centre - _over(other.mass * apart, mass, other.mass * off)
        moved = _over(other.mass * _about(self.mass, apart), mass, other.mass * self.mass * off**2)
        return MassProperties(mass, centre, self.inertia - other.inertia - moved)

    def moved(self, by: Float[ArrayLike, "3"] | Sequence[ArrayLike]) -> "MassProperties":
        """The body moved by a vector (3,), m, without a turn."""
        centre, by = as_floats(centre=(self.centre, (3,)), by=(by, (3,)))
        return MassProperties(self.mass, centre + by, self.inertia)

    def rotated(self, R: Float[ArrayLike, "3 3"]) -> "MassProperties":
        """The body turned about the origin by a rotation (3, 3).

        If `R` and `p` are the attitude and the origin of a frame in another one,
        `body.rotated(R).moved(p)` is the body of the former in the latter.
        """
        R, centre, J = as_floats(
            R=(R, (3, 3)), centre=(self.centre, (3,)), inertia=(self.inertia, (3, 3))
        )
        turned = matmul(matmul(R, J), R.T)
        return MassProperties(self.mass, matmul(R, centre), (turned + turned.T) / 2)

    def inertia_about(
        self, point: Float[ArrayLike, "3"] | Sequence[ArrayLike]
    ) -> Float[Array, "3 3"]:
        r"""Inertia (3, 3) about a point $p$ (3,), kg m².

        It is $J + m\,(|d|^2 I - d\,d^T)$ with $d = c - p$.
        """
        centre, point = as_floats(centre=(self.centre, (3,)), point=(point, (3,)))
        return self.inertia + _about(self.mass, centre - point)

    @property
    def pseudo_inertia(self) -> Float[Array, "4 4"]:
        r"""Pseudo-inertia (4, 4), the second moment of the mass in homogeneous coordinates.

        $$P = \int \begin{pmatrix} x \\ 1\end{pmatrix}\begin{pmatrix} x^T & 1\end{pmatrix} dm
          = \begin{pmatrix} J_d + m\,c\,c^T & m\,c\\ m\,c^T & m\end{pmatrix}$$

        It is positive definite exactly if there is a body of positive density that has it.

        References
        ----------
        P. M. Wensing, S. Kim, J.-J. E. Slotine, "Linear matrix inequalities for physically
        consistent inertial parameter identification: a statistical perspective on the mass
        distribution", IEEE Robot. Autom. Lett. 3 (2018), doi:10.1109/LRA.2017.2729659.
        """
        c, m = self.centre, self.mass
        second = discrete_inertia(self.inertia) + m * jnp.outer(c, c)
        return jnp.block([[second, m * c[:, None]], [m * c[None, :], jnp.reshape(m, (1, 1))]])

    @property
    def is_physical(self) -> Bool[Array, ""]:
        """Whether there is such a body: its mass is positive, and its pseudo-inertia definite.

        Sums of such bodies are such; a difference need not be, nor is a thin rod, whose
        pseudo-inertia is singular. The inertia must be symmetric. In float32 a body that is a
        thousand times as wide as thick counts as singular.
        """
        # The same as of the pseudo-inertia: the mass, and what remains about the centre.
        second = discrete_inertia(self.inertia)
        rounding = 8 * jnp.finfo(second.dtype).eps * jnp.trace(second)
        positive = jnp.all(jnp.linalg.eigvalsh(second) > rounding) & is_symmetric(self.inertia)
        return (self.mass > 0) & positive & jnp.all(jnp.isfinite(self.centre))

    def principal(self) -> PrincipalAxes:
        """Principal moments and axes.

        The derivative of the axes is NaN where two moments are equal, as the axes are not
        determined there.
        """
        moments, axes = jnp.linalg.eigh(self.inertia)
        return PrincipalAxes(moments, axes.at[:, 2].multiply(jnp.linalg.det(axes)))

    def distance(self, other: "MassProperties") -> Float[Array, ""]:
        r"""Affine-invariant distance to another body, of the pseudo-inertias.

        $$d = \sqrt{\tfrac12\sum_{i=1}^4 \log^2\lambda_i(P_1^{-1}P_2)}$$

        It is the same in every frame and in all units, and infinite or NaN if a body is not
        physical. For bodies that differ by a small factor $1 + \varepsilon$ of all masses it is
        $\sqrt2\,\varepsilon$.

        References
        ----------
        T. Lee, F. C. Park, "A geometric algorithm for robust multibody inertial parameter
        identification", IEEE Robot. Autom. Lett. 3 (2018), doi:10.1109/LRA.2018.2799426.
        """
        if not isinstance(other, MassProperties):
            raise TypeError(f"Argument `other` must be `MassProperties`, but is {other!r}.")
        # From the centre of the first, or far from the origin rounding would hide the inertia.
        first, second = (each.moved(-self.centre).pseudo_inertia for each in (self, other))
        lower = jnp.linalg.cholesky(first)
        half = solve_triangular(lower, second, lower=True)
        ratio = solve_triangular(lower, half.T, lower=True)
        squares = jnp.sum(jnp.log(jnp.linalg.eigvalsh(ratio)) ** 2) / 2
        # At zero the derivative of the root has no limit, and is set to zero.
        return jnp.where(squares == 0, 0, jnp.sqrt(jnp.where(squares == 0, 1, squares)))

    def to_urdf(self) -> str:
        """The element `<inertial>` of a link in URDF, along the axes of the frame."""
        return elements.write_urdf(self._as_inertial())

    @classmethod
    def from_urdf(cls, text: str, link: str | None = None) -> "MassProperties":
        """The body of an element `<inertial>` in URDF, in the frame of its link.

        Parameters
        ----------
        text
            The element, or a link or a robot with such an element.
        link
            The name of the link, where several have one.

        Returns
        -------
        MassProperties
            The body.

        Raises
        ------
        ValueError
            If the element is missing or malformed.
        """
        return cls(*elements.read_urdf(text, link))

    def to_mjcf(self) -> str:
        """The element `<inertial>` of a body in MJCF, the format of MuJoCo, with `fullinertia`."""
        return elements.write_mjcf(self._as_inertial())

    @classmethod
    def from_mjcf(cls, text: str, body: str | None = None) -> "MassProperties":
        """The body of an element `<inertial>` in MJCF, in the frame of its body.

        Parameters
        ----------
        text
            The element, with `fullinertia`, or `diaginertia` and perhaps `quat`; or a body or a
            model with such an element.
        body
            The name of the body, where several have one, or geoms instead.

        Returns
        -------
        MassProperties
            The body.

        Raises
        ------
        ValueError
            If the element is missing or malformed, or its axes are given otherwise; if a setting
            of the compiler changes the body: `balanceinertia`, `boundmass`, `boundinertia`,
            `settotalmass`, `fusestatic`, `alignfree` or `inertiafromgeom`.
        """
        return cls(*elements.read_mjcf(text, body))

    def _as_inertial(self) -> elements.Inertial:
        leaves = self.mass, self.centre, self.inertia
        if any(isinstance(each, Tracer) for each in leaves):
            raise TypeError("A body must be written outside of `jax.jit` and its like.")
        if self.mass.ndim:
            raise ValueError("One body is written per call, but this is a batch of them.")
        mass, centre, inertia = (np.asarray(each, float) for each in leaves)
        if not mass > 0:
            raise ValueError(f"A body must have a mass above 0 to be written, but is {self}.")
        if not all(np.all(np.isfinite(each)) for each in (mass, centre, inertia)):
            raise ValueError(f"A body must be finite to be written, but is {self}.")
        if not is_symmetric(inertia):
            raise ValueError(f"A body must have a symmetric inertia to be written, but is {self}.")
        return elements.Inertial(mass.item(), centre, inertia)


def _size(a: MassProperties, b: MassProperties) -> Array:
    """The distance of the centres of two bodies that rounding alone may leave."""
    return (
        64
        * jnp.finfo(a.centre.dtype).eps
        * jnp.maximum(jnp.max(jnp.abs(a.centre)), jnp.max(jnp.abs(b.centre)))
    )


def _over(x: Array, mass: Array, rounding: Array, instead: ArrayLike = 0.0) -> Array:
    """`x / mass`; where both are zero, `x` to rounding, another value, with finite derivatives."""
    both = (mass == 0) & jnp.all(jnp.abs(x) <= jnp.abs(rounding))
    return jnp.where(both, instead, x / jnp.where(both, 1, mass))


def _about(mass: Array, d: Array) -> Array:
    """The inertia (3, 3) of a point of some mass at `d` (3,)."""
    return mass * (jnp.sum(d**2) * jnp.eye(3, dtype=d.dtype) - jnp.outer(d, d))
