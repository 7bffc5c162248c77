"""Immutable, learnable pytree modules over the functional core."""

from .body import AbstractRigidBody, PhysicalRigidBody, RigidBody
from .constant_torque import ConstantTorque
from .damping import LinearDamping, QuadraticDamping
from .gyrostat import Gyrostat
from .integrator import MoserVeselovIntegrator
from .loss import AbstractLoss, Cauchy, Huber
from .potential import GravityGradient, PotentialTorque, UniformGravity
from .sampled_torque import SampledTorque
from .sensor import AttitudeSensor, Gyroscope
from .torque import AbstractTorque, ScaledTorque, TorqueSum
from .trajectory import Trajectory

__all__ = [
    "AbstractLoss",
    "AbstractRigidBody",
    "AbstractTorque",
    "AttitudeSensor",
    "Cauchy",
    "ConstantTorque",
    "GravityGradient",
    "Gyroscope",
    "Gyrostat",
    "Huber",
    "LinearDamping",
    "MoserVeselovIntegrator",
    "PhysicalRigidBody",
    "PotentialTorque",
    "QuadraticDamping",
    "RigidBody",
    "SampledTorque",
    "ScaledTorque",
    "TorqueSum",
    "Trajectory",
    "UniformGravity",
]
