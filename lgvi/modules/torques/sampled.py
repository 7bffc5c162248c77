"""A torque that is known at some times."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ...core.kernels.interpolation import interpolate
from ...core.kernels.vectors import matmul
from ...core.typed_arrays import as_floats
from ..errors import error_if
from ..fields import Frame, described_by, float_array, require_frame
from .law import AbstractTorque


class SampledTorque(AbstractTorque):
    r"""Torques at given times, with linear interpolation between them.

    For trajectories of order 2: the kinks at the samples spoil any higher one. Before the first
    sample and after the last the torque is that of the sample; `simulate` refuses to leave them.

    Parameters
    ----------
    t
        Times (samples,), s, increasing. Where a step ends at a sample, derivatives with respect
        to times are one-sided.
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
    torque: Float[Array, "samples 3"] = eqx.field(
        converter=float_array("torque"), metadata=described_by("N m")
    )
    frame: Frame = eqx.field(default="body", static=True)

    def __check_init__(self):
        if self.t.ndim != 1 or len(self.t) == 0:
            raise ValueError(
                f"Argument `t` must have shape (samples,), but its shape is {self.t.shape}."
            )
        if self.torque.shape != (len(self.t), 3):
            raise ValueError(
                f"Argument `torque` must have shape {(len(self.t), 3)}, an entry for each of `t`, "
                f"but its shape is {self.torque.shape}."
            )
        require_frame(self.frame)

    @property
    def depends_on_attitude(self) -> bool:
        """Whether the torques are given in the space frame."""
        return self.frame != "body"

    @property
    def highest_order(self) -> int:
        """2: linear interpolation has kinks at the samples."""
        return 2

    @property
    def reason_for_highest_order(self) -> str:
        """The kinks at the samples."""
        return "linear interpolation has kinks at the samples"

    def __call__(self, t: Float[ArrayLike, ""], R: Float[ArrayLike, "3 3"]) -> Float[Array, "3"]:
        """Torque (3,) in the body frame, N m."""
        (samples,) = self.t.shape
        times, torques, t, R = as_floats(
            times=(self.t, (samples,)),
            torques=(self.torque, (samples, 3)),
            t=(t, ()),
            R=(R, (3, 3)),
        )
        torque = interpolate(times, torques, t)
        return torque if self.frame == "body" else matmul(R.T, torque)

    def during(self, times: Callable[[], Array], throw: bool) -> "SampledTorque":
        """The law, checked: its times must increase and cover the times of a simulation.

        Raises
        ------
        RuntimeError
            If `throw` and it is not. Otherwise the torque is NaN.
        """
        needed = times()
        t, needed = as_floats(t=(self.t, self.t.shape), times=(needed, needed.shape))
        first, last = jnp.min(needed), jnp.max(needed)
        # What rounding may make of the time after many steps.
        margin = jnp.sqrt(jnp.finfo(t.dtype).eps) * (last - first)
        covered = (t[0] <= first + margin) & (last - margin <= t[-1])
        failed = ~(jnp.all(jnp.diff(t) > 0) & covered)
        if throw:
            torque = error_if(self.torque, failed, _describe_samples, lambda: (t, first, last))
        else:
            torque = jnp.where(failed, jnp.nan, self.torque)
        return SampledTorque(self.t, torque, self.frame)


def _describe_samples(t: np.ndarray, first: np.floating, last: np.floating) -> str:
    if not np.all(np.diff(t) > 0):
        index = int(np.argmin(np.diff(t) > 0))
        return (
            f"The times `t` of a `SampledTorque` must increase, but t[{index}] is {t[index]:.6g} "
            f"and t[{index + 1}] is {t[index + 1]:.6g}."
        )
    return (
        "The times `t` of a `SampledTorque` must cover those of the trajectory, from "
        f"{first:.6g} to {last:.6g} s, but go from {t[0]:.6g} to {t[-1]:.6g} s."
    )
