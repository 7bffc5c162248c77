"""Torque laws that depend on vectors which are known, such as a field or a position."""

from ..known_fields import AbstractOfKnownVectors
from .law import HIGHEST_ORDER, AbstractTorque


class AbstractTorqueOfKnownVectors(AbstractOfKnownVectors, AbstractTorque):
    """A torque law with fields that are vectors (3,), functions of time, or sampled."""

    @property
    def highest_order(self) -> int:
        """2 if a vector is sampled: linear interpolation has kinks at the samples."""
        return 2 if self.sampled_fields else HIGHEST_ORDER

    @property
    def reason_for_highest_order(self) -> str:
        """The kinks at the samples, if a vector is sampled."""
        kinks = "linear interpolation has kinks at the samples"
        return kinks if self.sampled_fields else super().reason_for_highest_order
