"""A torque that is constant in the body, or in space."""

import equinox as eqx
from jaxtyping import Array, ArrayLike, Float

from ...core.kernels.vectors import matmul
from ...core.typed_arrays import as_floats
from ..fields import Frame, described_by, float_array, require_frame, require_shape
from .law import AbstractTorque


class ConstantTorque(AbstractTorque):
    r"""A constant torque: $\tau$ in the body frame, or $R^T\tau$ for one in the space frame.

    Parameters
    ----------
    torque
        Torque (3,), N m, a learnable leaf.
    frame
        The frame in which it is constant, `"body"` or `"space"`, static.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape, type or frame.
    """

    torque: Float[Array, "3"] = eqx.field(
        converter=float_array("torque"), metadata=described_by("N m")
    )
    frame: Frame = eqx.field(default="body", static=True)

    def __check_init__(self):
        require_shape("torque", self.torque, (3,))
        require_frame(self.frame)

    @property
    def depends_on_attitude(self) -> bool:
        """Whether it is constant in space."""
        return self.frame != "body"

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        torque, R = as_floats(torque=(self.torque, (3,)), R=(R, (3, 3)))
        return torque if self.frame == "body" else matmul(R.T, torque)
