"""A body whose principal axes are known, with three moments to learn, or two by symmetry."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..core.kernels.vectors import matmul
from ..core.typed_arrays import as_floats
from .body import AbstractRigidBody
from .fields import computed_from, float_array
from .physical_inertia import checked_coordinates, checked_inertia

Axes = tuple[tuple[float, ...], ...]


def _numbers(name: str, value: Any) -> np.ndarray:
    """Known numbers, not traced ones."""
    try:
        return np.asarray(value, float)
    except (TypeError, ValueError):
        raise TypeError(f"Argument `{name}` must be known numbers, but is {value!r}.") from None


def _rows(axes: Any) -> Axes:
    rows = _numbers("axes", axes)
    if rows.shape != (3, 3) or not np.allclose(rows.T @ rows, np.eye(3), rtol=0, atol=1e-6):
        raise ValueError(
            f"Argument `axes` must be three rows of an orthogonal matrix, but is {axes!r}."
        )
    return tuple(tuple(row) for row in rows.tolist())


class KnownAxesRigidBody(AbstractRigidBody):
    r"""A rigid body with known principal axes, physically realisable for every value of its leaf.

    The inertia is $A\,\operatorname{diag}(\sum_i s_i - s_k)\,A^T$ with the principal axes in the
    columns of $A$ and the second moments of mass $s_k = \int x_k^2\,\mathrm{d}m$ along them, whose
    logarithms are the learnable leaf. So the principal moments stay positive and satisfy the
    triangle inequality strictly. Make a body with `from_principal_moments` or `axisymmetric`.

    Parameters
    ----------
    log_second_moments
        Logarithms of second moments of mass, kg m²: (3,), one for each axis; or (2,), one for all
        directions across the last axis, and one for the last axis.
    axes
        The axes $A$ in body coordinates, as a tuple of three rows. They are no leaf, and not
        learned.

    Raises
    ------
    ValueError
        For a wrong shape.
    """

    log_second_moments: Float[Array, " moments"] = eqx.field(
        converter=float_array("log_second_moments")
    )
    axes: Axes = eqx.field(static=True, converter=_rows)

    def __check_init__(self):
        if self.log_second_moments.shape not in ((3,), (2,)):
            raise ValueError(
                "Argument `log_second_moments` must have shape (3,) or (2,), but its shape is "
                f"{self.log_second_moments.shape}."
            )

    @property
    @computed_from("log_second_moments")
    def inertia(self) -> Float[Array, "3 3"]:
        """Inertia (3, 3) about the centre of mass, body frame, kg m²."""
        second = jnp.exp(self.log_second_moments)
        if len(second) == 2:
            second = jnp.stack([second[0], second[0], second[1]])
        axes = jnp.asarray(self.axes, second.dtype)
        return matmul(axes * (jnp.sum(second) - second)[None, :], axes.T)

    @classmethod
    def from_principal_moments(
        cls,
        moments: Float[ArrayLike, "3"] | Sequence[ArrayLike],
        axes: Float[ArrayLike, "3 3"] | None = None,
    ) -> "KnownAxesRigidBody":
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
        KnownAxesRigidBody
            The body.

        Raises
        ------
        ValueError
            For a wrong shape.
        RuntimeError
            For unphysical moments, or axes that are not orthonormal.
        """
        checked = checked_coordinates(checked_inertia(moments, axes), "moments")
        (moments,) = as_floats(moments=(moments, (3,)))
        second = jnp.sum(moments) / 2 - moments + 0 * checked[0]  # a failed check comes first
        return cls(jnp.log(second), np.eye(3) if axes is None else axes)

    @classmethod
    def axisymmetric(
        cls,
        moments: Float[ArrayLike, "2"] | Sequence[ArrayLike],
        axis: Float[ArrayLike, "3"] | Sequence[ArrayLike] = (0, 0, 1),
    ) -> "KnownAxesRigidBody":
        """Body with an axis of symmetry, which has two principal moments to learn.

        Parameters
        ----------
        moments
            Principal moments (2,), kg m², positive: about all directions across the axis, and
            about the axis, which is below twice the other.
        axis
            The axis (3,) in body coordinates, of any length. The third body axis by default.

        Returns
        -------
        KnownAxesRigidBody
            The body.

        Raises
        ------
        ValueError
            For a wrong shape, or an axis without a direction.
        RuntimeError
            For unphysical moments.
        """
        direction = _numbers("axis", axis)
        (moments,) = as_floats(moments=(moments, (2,)))
        length = np.linalg.norm(direction)
        if direction.shape != (3,) or not 0 < length < np.inf:
            raise ValueError(
                f"Argument `axis` must be three numbers that have a direction, but is {axis!r}."
            )
        # The last of the orthonormal columns is the axis.
        across = np.linalg.svd(direction[None] / length)[2][1:].T
        axes = np.column_stack([across, direction / length])
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        body = cls.from_principal_moments(jnp.stack([moments[0], moments[0], moments[1]]), axes)
        return cls(body.log_second_moments[1:], body.axes)
