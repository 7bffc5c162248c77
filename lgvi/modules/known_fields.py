"""Laws with fields that are known vectors, such as a magnetic field or a wind."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..core.kernels.vectors import matmul
from ..core.typed_arrays import as_floats
from .fields import Frame
from .known_vector import SampledVector, known_vector_at, sampled_during


class AbstractOfKnownVectors(eqx.Module):
    """A law with fields that are vectors (3,), functions of time, or sampled.

    Attributes
    ----------
    known_fields
        The names of these fields.
    """

    known_fields: ClassVar[tuple[str, ...]]

    @property
    def sampled_fields(self) -> list[str]:
        """The names of the fields that are sampled."""
        fields = self.known_fields
        return [name for name in fields if isinstance(getattr(self, name), SampledVector)]

    def during(self, times: Callable[[], Array], throw: bool) -> Any:
        """The law with sampled vectors that are checked, as by `SampledTorque`."""
        checked = {
            name: sampled_during(getattr(self, name), times, throw) for name in self.sampled_fields
        }
        return replace(self, **checked) if checked else self

    def known_at(self, name: str, t: Float[ArrayLike, ""]) -> Float[Array, "3"]:
        """The vector of a field at a time."""
        return known_vector_at(name, getattr(self, name), jnp.asarray(t))

    def in_frame(
        self, name: str, frame: Frame, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]
    ) -> Float[Array, "3"]:
        """The vector of a field, which is known in a frame, in the axes of the body."""
        return self.known_at(name, t) if frame == "body" else self.in_body(name, t, R)

    def in_body(
        self, name: str, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]
    ) -> Float[Array, "3"]:
        """The vector of a field in space, in the axes of a body at an attitude."""
        vector, R = as_floats(**{name: (self.known_at(name, t), (3,)), "R": (R, (3, 3))})
        return matmul(R.T, vector)
