"""What an identification is given: checked, and put together."""

from collections.abc import Sequence
from typing import Any

from jaxtyping import ArrayLike

from ..modules.body import AbstractRigidBody
from ..modules.integrator import MoserVeselovIntegrator
from ..modules.sensor import AttitudeSensor, Gyroscope
from ..modules.torque import Torque
from .model import Model
from .recordings import Recordings
from .residuals import InitialStates
from .samples import SENSED

Sensor = AttitudeSensor | Gyroscope


def model_of(
    body: AbstractRigidBody,
    recordings: Recordings,
    sensors: Sensor | Sequence[Sensor],
    torque: Torque | None,
    rotor_inertia: ArrayLike,
    time_scale: ArrayLike,
) -> Model:
    """A model with a sensor for all that was recorded, and for nothing else.

    Raises
    ------
    ValueError, TypeError
        If there are others.
    """
    given: dict[str, Any] = {}
    for sensor in sensors if isinstance(sensors, Sequence) else (sensors,):
        kinds = {AttitudeSensor: "attitude", Gyroscope: "gyroscope"}
        if type(sensor) not in kinds or kinds[type(sensor)] in given:
            raise TypeError(
                "Argument `sensors` must be an `AttitudeSensor`, a `Gyroscope`, or one of each, "
                f"but is {sensors!r}."
            )
        given[kinds[type(sensor)]] = sensor
    if not isinstance(recordings, Recordings):
        raise TypeError(f"Argument `recordings` must be `Recordings`, but is {recordings!r}.")
    require_sensors("sensors", (given.get("attitude"), given.get("gyroscope")), recordings)
    return Model(body, torque=torque, rotor_inertia=rotor_inertia, time_scale=time_scale, **given)


def require_sensors(
    name: str, sensors: tuple[Sensor | None, Sensor | None], recordings: Recordings
) -> None:
    for kind, sensor in zip(SENSED, sensors, strict=True):
        if (getattr(recordings, kind) is None) != (sensor is None):
            have = "have" if sensor is None else "do not have"
            raise ValueError(
                f"Argument `{name}` must have a sensor for what was recorded and for nothing "
                f"else, but the recordings {have} `{kind}`."
            )


def require_scalar_step(integrator: MoserVeselovIntegrator | None) -> None:
    if integrator is not None and integrator.dt.ndim:
        raise ValueError(
            "Argument `integrator` must have a scalar `dt`, the longest step, but its shape is "
            f"{integrator.dt.shape}."
        )


def require_states(name: str, states: InitialStates, recordings: Recordings) -> None:
    count, shapes = len(recordings), (states.R.shape, states.omega.shape)
    if shapes != ((count, 3, 3), (count, 3)):
        raise ValueError(
            f"Argument `{name}` must have the states of {count} trajectories, but its shapes are "
            f"{shapes[0]} and {shapes[1]}."
        )
