"""What produced a recording: a body, what acts on it, and sensors; and which leaves are free."""

import equinox as eqx
from jaxtyping import Array, Float

from ...modules.arguments import require_body
from ...modules.body import AbstractRigidBody
from ...modules.fields import float_array, require_shape
from ...modules.sensor import AttitudeSensor, Gyroscope
from ...modules.torques.base import Torque, as_law


class Model(eqx.Module):
    """What produces recordings. Each leaf can be estimated.

    Parameters
    ----------
    body
        The body, best a [`PhysicalRigidBody`][lgvi.PhysicalRigidBody].
    attitude
        The sensor of recorded attitudes.
    gyroscope
        The sensor of recorded angular velocities.
    torque
        A torque law that acts in addition to the recorded torques.
    rotor_inertia
        The factor between the recorded `rotor_momentum` and the momentum of the rotors: 1, or the
        spin inertia, kg m², where their speeds, rad/s, are recorded.
    time_scale
        The true duration of a recorded second.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    body: AbstractRigidBody
    attitude: AttitudeSensor | None = None
    gyroscope: Gyroscope | None = None
    torque: Torque | None = None
    rotor_inertia: Float[Array, ""] = eqx.field(default=1.0, converter=float_array("rotor_inertia"))
    time_scale: Float[Array, ""] = eqx.field(default=1.0, converter=float_array("time_scale"))

    def __check_init__(self):
        require_body(self.body)
        if self.body.rotor_momentum is not None:
            raise TypeError(
                "Argument `body` must be a body without rotors: those of a recording are its "
                "`rotor_momentum`."
            )
        if self.attitude is None and self.gyroscope is None:
            raise ValueError("A model must have an `attitude` sensor or a `gyroscope`.")
        for name, kind in (("attitude", AttitudeSensor), ("gyroscope", Gyroscope)):
            if not isinstance(value := getattr(self, name), (kind, type(None))):
                raise TypeError(
                    f"Argument `{name}` must be None or `{kind.__name__}`, but is {value!r}."
                )
        if self.torque is not None:
            as_law("torque", self.torque)
        require_shape("rotor_inertia", self.rotor_inertia, ())
        require_shape("time_scale", self.time_scale, ())

    @property
    def sensors(self) -> tuple[AttitudeSensor | None, Gyroscope | None]:
        """The sensor of attitudes and that of angular velocities."""
        return self.attitude, self.gyroscope

    @property
    def is_robust(self) -> bool:
        """Whether a sensor has a robust loss."""
        return any(sensor is not None and sensor.loss is not None for sensor in self.sensors)
