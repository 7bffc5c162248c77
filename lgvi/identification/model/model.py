"""The model of a recording: a body, the torques and rotors that act, and sensors."""

from collections import OrderedDict
from dataclasses import fields
from typing import Any, overload

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ...modules.arguments import require_body
from ...modules.body import AbstractRigidBody, PhysicalRigidBody
from ...modules.centre_of_mass import SpecificForce, as_mass
from ...modules.fields import (
    described_by,
    description,
    float_array,
    require_shape,
    shaped_array,
)
from ...modules.forces.law import Force, require_force
from ...modules.mass.mass_properties import MassProperties
from ...modules.multirotor import Multirotor
from ...modules.printing import numbers_of, show
from ...modules.sensors.sensor import Sensors, by_channel, loss_of, require_state_fields
from ...modules.torques.law import Torque, as_law
from ...modules.varying_body import VaryingRigidBody
from ..data.formats import require_own_names


def _with_a_body(body: Any, sensors: Any) -> tuple[Any, Any]:
    """A body and sensors; sensors may be the first argument, without a body."""
    if sensors is None and not isinstance(body, AbstractRigidBody):
        body, sensors = None, body
    if body is None:
        body = PhysicalRigidBody.from_principal_moments([1.0, 1.0, 1.0])
    return body, sensors


def _start_of_centre(name: str, value: ArrayLike | None, gravity: Array | None) -> Array | None:
    """The position or the velocity of the centre of mass at the start; None without gravity."""
    if gravity is None:
        if value is not None:
            raise ValueError(f"Argument `{name}` must be None where `gravity` is None.")
        return None
    return jnp.zeros_like(gravity) if value is None else shaped_array(name, value, (3,))


class Model(eqx.Module):
    """The source of recordings: a body, what acts on it, and sensors. Each leaf can be estimated.

    Parameters
    ----------
    body
        The body, best a [`PhysicalRigidBody`][lgvi.PhysicalRigidBody]. `Model(sensors)` has a
        `PhysicalRigidBody` with three moments of 1 kg m², the start of a fit without knowledge.
    sensors
        The sensor of each channel of the recordings: one, such as an
        [`AttitudeSensor`][lgvi.AttitudeSensor] or a [`Gyroscope`][lgvi.Gyroscope]; several; or a
        mapping of the names of channels to sensors, where two of them are of one kind.
    torque
        A torque law that acts in addition to the recorded torques.
    rotor_inertia
        The factor between the recorded `rotor_momentum` and the momentum of the rotors: 1, or the
        spin inertia, kg m², where their speeds, rad/s, are recorded. Where the speed of one rotor
        is recorded, as one column, the spin inertia times the unit vector along its axis (3,).
    rotor_delay
        The delay, s, of the momenta of the rotors against the recorded times: a learnable leaf if
        given as a number, such as 0.0. `None` is no delay. Before the first reading, and after the
        last, the recorded momentum continues along a line.
    time_scale
        The true duration of a recorded second.
    rotors
        The rotors whose `rotor_speed` is recorded, with their torque and their momentum; `None`
        where no `rotor_speed` is recorded.
    mass
        Mass, kg, or [`MassProperties`][lgvi.MassProperties], of which it is taken. With a mass an
        accelerometer feels the `force`, the thrust of the `rotors`, and the forces of `torque` laws
        that have one. `None` where no sensor feels a force.
    force
        A force law, such as [`AirDrag`][lgvi.AirDrag], or a sum of laws. Needs a `mass`.
    gravity
        Acceleration of gravity (3,), space frame, m/s², such as (0, 0, -9.81). With it the centre
        of mass moves, from a position and a velocity that each trajectory has of its own, as a
        [`PositionSensor`][lgvi.PositionSensor] without a `gravity` or a
        [`VelocitySensor`][lgvi.VelocitySensor] reads it. `None` where no sensor reads its motion,
        and no force depends on its velocity.
    x0, v0
        Position (3,), m, and velocity (3,), m/s, of the centre of mass at the start, space frame,
        for a model with a `gravity`; zero by default. Each trajectory has its own, in `own` of its
        [`InitialStates`][lgvi.identification.InitialStates], which a fit eliminates.

    Attributes
    ----------
    sensors
        The sensors by the names of their channels, such as `model.sensors["attitude"]`.

    Raises
    ------
    ValueError, TypeError
        For a wrong shape or type.
    """

    body: AbstractRigidBody
    sensors: OrderedDict[str, Any]  # with different attributes
    torque: Torque | None
    rotor_inertia: Float[Array, "*axes"] = eqx.field(
        metadata=described_by("kg m²", "a recorded rotor")
    )
    time_scale: Float[Array, ""] = eqx.field(
        metadata=described_by("1", "a gyroscope, or a known torque,", "the log may run backwards")
    )
    rotor_delay: Float[Array, ""] | None = eqx.field(
        metadata=described_by("s", "a rotor whose speed changes")
    )
    rotors: Multirotor | None
    mass: Float[Array, ""] | None = eqx.field(
        metadata=described_by(
            "kg", "a known force, such as a known thrust,", "a force may be reversed"
        )
    )
    force: Force | None
    gravity: Float[Array, "3"] | None = eqx.field(
        metadata=described_by("m/s²", "a sensor of attitudes")
    )
    x0: Float[Array, "3"] | None = eqx.field(metadata=described_by("m"))
    v0: Float[Array, "3"] | None = eqx.field(metadata=described_by("m/s"))

    @overload
    def __init__(
        self,
        sensors: Sensors,
        /,
        *,
        torque: Torque | None = None,
        rotor_inertia: Float[ArrayLike, "*axes"] = 1.0,
        time_scale: Float[ArrayLike, ""] = 1.0,
        rotor_delay: Float[ArrayLike, ""] | None = None,
        rotors: Multirotor | None = None,
        mass: Float[ArrayLike, ""] | MassProperties | None = None,
        force: Force | None = None,
        gravity: Float[ArrayLike, "3"] | None = None,
        x0: Float[ArrayLike, "3"] | None = None,
        v0: Float[ArrayLike, "3"] | None = None,
    ): ...

    @overload
    def __init__(
        self,
        body: AbstractRigidBody,
        sensors: Sensors,
        torque: Torque | None = None,
        rotor_inertia: Float[ArrayLike, "*axes"] = 1.0,
        time_scale: Float[ArrayLike, ""] = 1.0,
        rotor_delay: Float[ArrayLike, ""] | None = None,
        rotors: Multirotor | None = None,
        mass: Float[ArrayLike, ""] | MassProperties | None = None,
        force: Force | None = None,
        gravity: Float[ArrayLike, "3"] | None = None,
        x0: Float[ArrayLike, "3"] | None = None,
        v0: Float[ArrayLike, "3"] | None = None,
    ): ...

    def __init__(
        self,
        body: AbstractRigidBody | Sensors | None = None,
        sensors: Sensors | None = None,
        torque: Torque | None = None,
        rotor_inertia: Float[ArrayLike, "*axes"] = 1.0,
        time_scale: Float[ArrayLike, ""] = 1.0,
        rotor_delay: Float[ArrayLike, ""] | None = None,
        rotors: Multirotor | None = None,
        mass: Float[ArrayLike, ""] | MassProperties | None = None,
        force: Force | None = None,
        gravity: Float[ArrayLike, "3"] | None = None,
        x0: Float[ArrayLike, "3"] | None = None,
        v0: Float[ArrayLike, "3"] | None = None,
    ):
        self.body, all_sensors = _with_a_body(body, sensors)
        self.sensors = by_channel(all_sensors)
        self.torque = torque
        self.rotor_inertia = float_array("rotor_inertia")(rotor_inertia)
        self.time_scale = float_array("time_scale")(time_scale)
        delay = None if rotor_delay is None else float_array("rotor_delay")(rotor_delay)
        self.rotor_delay = delay
        self.rotors = rotors
        self.mass = None if mass is None else as_mass(mass)
        self.force = force
        self.gravity = None if gravity is None else shaped_array("gravity", gravity, (3,))
        self.x0, self.v0 = (
            _start_of_centre(name, value, self.gravity)
            for name, value in {"x0": x0, "v0": v0}.items()
        )

    def __check_init__(self):
        require_body(self.body)
        if isinstance(self.body, VaryingRigidBody):
            raise TypeError("Argument `body` must have one inertia, but has one for each step.")
        if self.body.rotor_momentum is not None:
            raise TypeError(
                "Argument `body` must be a body without rotors: those of a recording are its "
                "`rotor_momentum`."
            )
        if not self.sensors:
            raise ValueError("Argument `sensors` must have a sensor, but is empty.")
        require_own_names(self.sensors)
        for channel, sensor in self.sensors.items():
            if isinstance(sensor, type):
                raise TypeError(
                    "Argument `sensors` must have sensors and not their classes, but has "
                    f"{sensor.__name__}."
                )
            require_state_fields(sensor)
            if channel in {field.name for field in fields(self)}:  # names of leaves begin with it
                raise ValueError(f"Argument `sensors` must not have a channel named `{channel}`.")
        if isinstance(self.torque, Multirotor):
            raise TypeError(
                "Argument `torque` must be a torque law, but is a `Multirotor`: give it as "
                "argument `rotors`."
            )
        if self.torque is not None:
            as_law("torque", self.torque)
        if not isinstance(self.rotors, Multirotor | None):
            raise TypeError(
                f"Argument `rotors` must be a `Multirotor` or None, but is {self.rotors!r}."
            )
        if self.rotor_inertia.shape not in ((), (3,)):
            raise ValueError(
                "Argument `rotor_inertia` must have shape () or (3,), but its shape is "
                f"{self.rotor_inertia.shape}."
            )
        if self.force is not None:
            require_force("force", self.force)
            if self.mass is None:
                raise ValueError("Argument `mass` must be given where there is a `force`.")
        require_shape("time_scale", self.time_scale, ())
        if self.rotor_delay is not None:
            require_shape("rotor_delay", self.rotor_delay, ())

    def __repr__(self) -> str:
        return show(self)

    def __str__(self) -> str:
        """A table of the leaves that can be estimated, as `free` takes them from the model."""
        rows, absent = [("leaf", "value", "unit")], []
        paths = jax.tree_util.tree_leaves_with_path(self, is_leaf=lambda leaf: leaf is None)
        for path, leaf in paths:
            name = jax.tree_util.keystr(path).removeprefix(".")
            told = description(self, path)
            if name.endswith(".sigma") or name in ("x0", "v0"):
                continue  # the noise is not found by least squares; a start is a trajectory's own
            if eqx.is_inexact_array(leaf):
                rows.append((name, numbers_of(leaf), told.get("unit", "")))
            elif leaf is None and told:
                absent.append(name)
        width, size = (max(len(row[i]) for row in rows) for i in range(2))
        lines = [f"{name:{width}}  {value:{size}}  {unit}".rstrip() for name, value, unit in rows]
        if absent:
            lines += ["", f"None, and free after a number is given: {', '.join(absent)}"]
        return "\n".join(lines)

    @property
    def specific_force(self) -> SpecificForce | None:
        """The forces of laws over the mass; None without a mass."""
        if self.mass is None:
            return None
        return SpecificForce.of(self.mass, self.force, self.torque)

    @property
    def is_robust(self) -> bool:
        """Whether a sensor has a robust loss."""
        return any(loss_of(sensor) is not None for sensor in self.sensors.values())
