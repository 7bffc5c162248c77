"""The drag of the air on a body that moves through it."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ...core.kernels.vectors import matmul
from ...core.typed_arrays import as_floats
from ..fields import described_by, float_array
from ..known_fields import AbstractOfKnownVectors
from ..known_vector import KnownVector, as_known_vector
from .law import AbstractForce


class AirDrag(AbstractOfKnownVectors, AbstractForce):
    r"""The drag of a body that moves through the air, at its centre of mass.

    With the velocity through the air in the body frame, $u = R^T(v - w)$,

    $$f = -D\,u - |u|\,C\,u.$$

    Linear drag that is much faster than the step, $h|D| > 2m$, makes the velocity change its sign
    at each step: take a smaller step there. The torque that drag has about the centre of mass is
    not in the law: [`QuadraticDamping`][lgvi.QuadraticDamping] is that of a body which turns.

    Parameters
    ----------
    linear
        Coefficients $D$, N s/m: a number, one for each axis of the body (3,), or a matrix (3, 3), a
        learnable leaf.
    quadratic
        Coefficients $C$, N s²/m²: the same, zero by default. For a body of area $A$ with a
        coefficient $C_D$ in air of density $\varrho$ it is $\varrho C_D A/2$.
    wind
        Velocity $w$ (3,) of the air, space frame, m/s, a learnable leaf; or a function of the time,
        s. `None`, by default, where the air is at rest.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    known_fields: ClassVar[tuple[str, ...]] = ("wind",)

    linear: Float[Array, "*of_linear"] = eqx.field(
        converter=float_array("linear"),
        metadata=described_by("N s/m", "a known mass, and speeds that change", "`wind` may blow"),
    )
    quadratic: Float[Array, "*of_quadratic"] = eqx.field(
        default=0.0,
        converter=float_array("quadratic"),
        metadata=described_by("N s²/m²", "a known mass, and high speeds", "`wind` may blow"),
    )
    wind: KnownVector | None = eqx.field(
        default=None,
        converter=lambda wind: None if wind is None else as_known_vector("wind", wind),
        metadata=described_by("m/s", "speeds that change"),
    )

    def __check_init__(self):
        for name in ("linear", "quadratic"):
            if (shape := getattr(self, name).shape) not in ((), (3,), (3, 3)):
                raise ValueError(
                    f"Argument `{name}` must have shape (), (3,) or (3, 3), but its shape is "
                    f"{shape}."
                )

    def __call__(
        self,
        t: Float[ArrayLike, ""],
        R: Float[ArrayLike, "3 3"],
        omega: Float[ArrayLike, "3"],
        v: Float[ArrayLike, "3"],
    ) -> Float[Array, "3"]:
        """Force (3,) in the body frame, N."""
        v, wind, R, D, C = as_floats(
            v=(v, (3,)),
            wind=(np.zeros(3, int) if self.wind is None else self.known_at("wind", t), (3,)),
            R=(R, (3, 3)),
            linear=(self.linear, self.linear.shape),
            quadratic=(self.quadratic, self.quadratic.shape),
        )
        u = matmul(R.T, v - wind)
        square = jnp.sum(u * u)
        speed = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
        return -_times(D, u) - speed * _times(C, u)


def _times(coefficients: Array, u: Array) -> Array:
    return matmul(coefficients, u) if coefficients.ndim > 1 else coefficients * u
