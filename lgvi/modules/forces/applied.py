"""A force that is known: constant, a function of time, or sampled."""

from functools import partial
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, ArrayLike, Float

from ..fields import Frame, described_by, require_frame
from ..known_fields import AbstractOfKnownVectors
from ..known_vector import KnownVector, as_known_vector
from .law import AbstractForce


class AppliedForce(AbstractOfKnownVectors, AbstractForce):
    r"""A known force at the centre of mass: $f$ in the body frame, or $R^Tf$ in the space frame.

    Parameters
    ----------
    force
        Force $f$ (3,), N, a learnable leaf; or a function of the time, s, such as a
        [`SampledVector`][lgvi.SampledVector].
    frame
        The frame of the force, `"body"` or `"space"`, static.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape, type or frame.
    """

    known_fields: ClassVar[tuple[str, ...]] = ("force",)

    force: KnownVector = eqx.field(
        converter=partial(as_known_vector, "force"), metadata=described_by("N", "a known mass")
    )
    frame: Frame = eqx.field(default="body", static=True)

    def __check_init__(self):
        require_frame(self.frame)

    def __call__(
        self,
        t: Float[ArrayLike, ""],
        R: Float[ArrayLike, "3 3"],
        omega: Float[ArrayLike, "3"],
        v: Float[ArrayLike, "3"],
    ) -> Float[Array, "3"]:
        """Force (3,) in the body frame, N."""
        return self.in_frame("force", self.frame, t, R)
