"""Immutable, learnable pytree modules over the functional core."""

from .body import AbstractRigidBody, PhysicalRigidBody, RigidBody
from .gyrostat import Gyrostat
from .integrator import MoserVeselovIntegrator
from .potential import GravityGradient, PotentialTorque, UniformGravity
from .torque import (
    AbstractTorque,
    ConstantTorque,
    LinearDamping,
    SampledTorque,
    ScaledTorque,
    TorqueSum,
)
from .trajectory import Trajectory

__all__ = [
    "AbstractRigidBody",
    "AbstractTorque",
    "ConstantTorque",
    "GravityGradient",
    "Gyrostat",
    "LinearDamping",
    "MoserVeselovIntegrator",
    "PhysicalRigidBody",
    "PotentialTorque",
    "RigidBody",
    "SampledTorque",
    "ScaledTorque",
    "TorqueSum",
    "Trajectory",
    "UniformGravity",
]
