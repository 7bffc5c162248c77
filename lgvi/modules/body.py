"""Rigid bodies as learnable modules: parameters only, never the state."""

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from ..core.diagnostics import energy
from ..core.inertia import discrete_inertia, inertia_from_log_cholesky
from ..core.kernels.vectors import matmul
from ..core.typed_arrays import as_floats
from .fields import computed_from, float_array, require_shape
from .physical_inertia import checked_coordinates, checked_inertia
from .printing import as_table, show


class AbstractRigidBody(eqx.Module):
    """Base class of all bodies: an inertia, and the momentum of rotors if there are any.

    Attributes
    ----------
    inertia
        Inertia (3, 3) about the centre of mass, body frame, kg m².
    rotor_momentum
        Momentum of rotors relative to the body, body frame, kg m²/s: (3,), or (steps, 3) for each
        step. None if the body has no rotors.
    """

    if TYPE_CHECKING:
        # Type checkers treat an abstract variable as a field, and would require its value
        # as the first argument of every body.
        @property
        def inertia(self) -> Float[Array, "3 3"]: ...
        @property
        def rotor_momentum(self) -> Float[Array, "*steps 3"] | None: ...
    else:
        inertia: eqx.AbstractVar[Float[Array, "3 3"]]
        rotor_momentum = None

    def __repr__(self) -> str:
        return show(self)

    def _repr_html_(self) -> str:
        """The inertia and its principal moments, for notebooks."""
        J = self.inertia
        known = isinstance(J, (jax.Array, np.ndarray)) and not isinstance(J, Tracer)
        if not known or J.shape != (3, 3) or not np.all(np.isfinite(J)):
            return f"<pre>{escape(repr(self))}</pre>"
        moments, axes = np.linalg.eigh(np.asarray(J, float))
        head = ["", "x", "y", "z", "principal moment", "axis in the body frame"]
        rows = [
            (name, *(f"{entry:.6g}" for entry in row), f"{moment:.6g}", np.round(axis, 4))
            for name, row, moment, axis in zip("xyz", np.asarray(J), moments, axes.T, strict=True)
        ]
        return f"<b>{type(self).__name__}</b>, inertia (kg m²){as_table(head, rows)}"

    def energy(self, pi: Float[ArrayLike, "3"]) -> Float[Array, ""]:
        r"""Kinetic energy $\tfrac12\,\omega\cdot J\omega$, J, of the body angular momentum (3,).

        Without rotors it is $\tfrac12\,\pi\cdot J^{-1}\pi$. With rotors it is without the energy
        of their spin; the motion conserves it while `rotor_momentum` is constant and there is no
        torque, and steps do so up to their error, without drift.
        """
        return energy(self._of_body(pi), self.inertia)

    def angular_velocity(self, pi: Float[ArrayLike, "3"]) -> Float[Array, "3"]:
        r"""Angular velocity $\omega = J^{-1}(\pi - \rho)$ (3,), body frame, rad/s."""
        of_body, J = as_floats(pi=(self._of_body(pi), (3,)), J=(self.inertia, (3, 3)))
        return jnp.linalg.solve(J, of_body)

    def angular_momentum(self, omega: Float[ArrayLike, "3"]) -> Float[Array, "3"]:
        r"""Angular momentum $\pi = J\omega + \rho$ (3,), body frame, kg m²/s."""
        omega, J, rotor = as_floats(
            omega=(omega, (3,)), J=(self.inertia, (3, 3)), rotor_momentum=(self._rotor(), (3,))
        )
        return matmul(J, omega) + rotor

    def _of_body(self, pi: ArrayLike) -> Array:
        """The momentum less that of rotors."""
        pi, rotor = as_floats(pi=(pi, (3,)), rotor_momentum=(self._rotor(), (3,)))
        return pi - rotor

    def _rotor(self) -> Array:
        if self.rotor_momentum is None:
            return jnp.zeros(3, jnp.asarray(self.inertia).dtype)
        if jnp.ndim(self.rotor_momentum) > 1:
            raise ValueError(
                "Argument `rotor_momentum` must have shape (3,) for velocities and energies, but "
                f"its shape is {self.rotor_momentum.shape}: make a body with that of one step."
            )
        return self.rotor_momentum

    def discrete_inertia(self) -> Float[Array, "3 3"]:
        r"""Discrete inertia $J_d = \tfrac12\operatorname{tr}(J)\,I - J$ (3, 3), kg m²."""
        return discrete_inertia(self.inertia)


class RigidBody(AbstractRigidBody):
    r"""A rigid body whose learnable leaf is its inertia matrix.

    A gradient step moves the nine entries freely, and nothing keeps the matrix symmetric or
    positive definite: to learn an inertia, prefer
    [`PhysicalRigidBody`][lgvi.PhysicalRigidBody].

    Parameters
    ----------
    inertia
        Inertia (3, 3) about the centre of mass, body frame, kg m²: symmetric positive
        definite, which an integrator checks. The principal moments may violate the triangle
        inequality, so that an optimiser can pass there, though no body has such moments.

    Raises
    ------
    ValueError
        For a wrong shape.
    """

    inertia: Float[Array, "3 3"] = eqx.field(converter=float_array("inertia"))

    def __check_init__(self):
        require_shape("inertia", self.inertia, (3, 3))

    @classmethod
    def from_principal_moments(
        cls,
        moments: Float[ArrayLike, "3"] | Sequence[ArrayLike],
        axes: Float[ArrayLike, "3 3"] | None = None,
    ) -> "RigidBody":
        """Body of given principal moments and axes.

        Parameters
        ----------
        moments
            Principal moments (3,), kg m², positive. They may violate the triangle inequality.
        axes
            Orthogonal matrix (3, 3) whose columns are the principal axes in body
            coordinates. The body axes by default.

        Returns
        -------
        RigidBody
            The body.

        Raises
        ------
        ValueError
            For a wrong shape.
        RuntimeError
            For moments that are not positive or axes that are not orthonormal; from
            inside a compiled function too, without values.
        """
        return cls(checked_inertia(moments, axes))


class PhysicalRigidBody(AbstractRigidBody):
    r"""A rigid body whose inertia is physically realisable for every value of its leaf.

    The learnable leaf holds the log-Cholesky coordinates of the discrete inertia (see
    [`inertia_from_log_cholesky`][lgvi.inertia_from_log_cholesky]). Whatever an optimiser
    does to it, the principal moments stay positive and satisfy the triangle inequality
    strictly (to rounding, as long as nothing overflows). Make a body with `from_inertia` or
    `from_principal_moments`.

    Parameters
    ----------
    log_cholesky
        Coordinates (6,).

    Raises
    ------
    ValueError
        For a wrong shape.
    """

    log_cholesky: Float[Array, "6"] = eqx.field(converter=float_array("log_cholesky"))

    def __check_init__(self):
        require_shape("log_cholesky", self.log_cholesky, (6,))

    @property
    @computed_from("log_cholesky")
    def inertia(self) -> Float[Array, "3 3"]:
        """Inertia (3, 3) about the centre of mass, body frame, kg m²."""
        return inertia_from_log_cholesky(self.log_cholesky)

    @classmethod
    def from_inertia(cls, inertia: Float[ArrayLike, "3 3"]) -> "PhysicalRigidBody":
        """Body of a given inertia.

        Parameters
        ----------
        inertia
            Inertia (3, 3) about the centre of mass, body frame, kg m², symmetric, with
            principal moments that satisfy the triangle inequality strictly.

        Returns
        -------
        PhysicalRigidBody
            The body.

        Raises
        ------
        ValueError
            For a wrong shape.
        RuntimeError
            For a matrix that is not symmetric or not the inertia of a body, naming the
            moments that violate the triangle inequality; from inside a compiled
            function too.
        """
        return cls(checked_coordinates(inertia))

    @classmethod
    def from_principal_moments(
        cls,
        moments: Float[ArrayLike, "3"] | Sequence[ArrayLike],
        axes: Float[ArrayLike, "3 3"] | None = None,
    ) -> "PhysicalRigidBody":
        """Body of given principal moments and axes.

        Parameters
        ----------
        moments
            Principal moments (3,), kg m², positive, satisfying the triangle inequality
            strictly.
        axes
            Orthogonal matrix (3, 3) whose columns are the principal axes in body
            coordinates. The body axes by default.

        Returns
        -------
        PhysicalRigidBody
            The body.

        Raises
        ------
        ValueError
            For a wrong shape.
        RuntimeError
            For unphysical moments, or axes that are not orthonormal; from inside a
            compiled function too, without values.
        """
        return cls(checked_coordinates(checked_inertia(moments, axes), "moments"))
