"""Immutable, learnable pytree modules over the functional core."""

from .body import AbstractRigidBody, PhysicalRigidBody, RigidBody
from .exact_motion import free_motion
from .gyrostat import Gyrostat
from .integrator import MoserVeselovIntegrator
from .known_axes import KnownAxesRigidBody
from .loss import AbstractLoss, Cauchy, Huber
from .mass.properties import MassProperties, PrincipalAxes
from .multirotor import Multirotor
from .sensors import (
    Accelerometer,
    AttitudeSensor,
    DirectionSensor,
    Gyroscope,
    Magnetometer,
    PositionSensor,
)
from .sensors.base import AbstractSensor, InvalidReadingError, MotionState
from .torques.base import AbstractTorque, ScaledTorque, TorqueSum
from .torques.constant import ConstantTorque
from .torques.damping import LinearDamping, QuadraticDamping
from .torques.potential import GravityGradient, PotentialTorque, UniformGravity
from .torques.sampled import SampledTorque
from .trajectory import Trajectory

__all__ = [
    "AbstractLoss",
    "AbstractRigidBody",
    "AbstractSensor",
    "AbstractTorque",
    "Accelerometer",
    "AttitudeSensor",
    "Cauchy",
    "ConstantTorque",
    "DirectionSensor",
    "GravityGradient",
    "Gyroscope",
    "Gyrostat",
    "Huber",
    "InvalidReadingError",
    "KnownAxesRigidBody",
    "LinearDamping",
    "Magnetometer",
    "MassProperties",
    "MoserVeselovIntegrator",
    "MotionState",
    "Multirotor",
    "PhysicalRigidBody",
    "PositionSensor",
    "PotentialTorque",
    "PrincipalAxes",
    "QuadraticDamping",
    "RigidBody",
    "SampledTorque",
    "ScaledTorque",
    "TorqueSum",
    "Trajectory",
    "UniformGravity",
    "free_motion",
]
