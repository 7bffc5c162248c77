"""A torque that is known at some times."""

from collections.abc import Callable

import equinox as eqx
from jaxtyping import Array, ArrayLike, Float

from ...core.kernels.vectors import matmul
from ...core.typed_arrays import as_floats
from ..fields import Frame, described_by, float_array, require_frame
from ..known_vector import require_samples, sample_at, values_during
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
        require_samples(self.t, "torque", self.torque)
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
        torque, R = as_floats(torque=(sample_at(self.t, self.torque, t), (3,)), R=(R, (3, 3)))
        return torque if self.frame == "body" else matmul(R.T, torque)

    def during(self, times: Callable[[], Array], throw: bool) -> "SampledTorque":
        """The law, checked: its times must increase and cover the times of a simulation.

        Raises
        ------
        RuntimeError
            If `throw` and it is not. Otherwise the torque is NaN.
        """
        torque = values_during("SampledTorque", self.t, self.torque, times, throw)
        return SampledTorque(self.t, torque, self.frame)
