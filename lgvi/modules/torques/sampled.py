"""A torque that is known at some times."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ...core.checks import as_floats
from ...core.kernels.vectors import matmul
from ..fields import float_array, require_shape
from .base import AbstractTorque
from .constant import Frame, require_frame


class SampledTorque(AbstractTorque):
    r"""Torques at given times, with linear interpolation between them.

    For trajectories of order 2: the kinks at the samples spoil any higher one. Before the first
    sample and after the last the torque is that of the sample; `simulate` refuses to leave them.

    Parameters
    ----------
    t
        Times (samples,), s, increasing. Where a step ends at a sample, derivatives with respect
        to times are those of one side.
    torque
        Torques (samples, 3), N m, a learnable leaf.
    frame
        The frame of the torques, `"body"` or `"space"`, static.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape, type or frame.
    """

    t: Float[Array, " samples"] = eqx.field(converter=float_array("t"))
    torque: Float[Array, "samples 3"] = eqx.field(converter=float_array("torque"))
    frame: Frame = eqx.field(default="body", static=True)

    def __check_init__(self):
        if self.t.ndim != 1 or len(self.t) == 0:
            raise ValueError(
                f"Argument `t` must have shape (samples,), but its shape is {self.t.shape}."
            )
        require_shape("torque", self.torque, (len(self.t), 3))
        require_frame(self.frame)

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        (samples,) = self.t.shape
        times, torques, t, R = as_floats(
            times=(self.t, (samples,)),
            torques=(self.torque, (samples, 3)),
            t=(t, ()),
            R=(R, (3, 3)),
        )
        torque = jax.vmap(jnp.interp, in_axes=(None, None, 1))(t, times, torques)
        return torque if self.frame == "body" else matmul(R.T, torque)
