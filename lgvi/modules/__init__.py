"""Immutable, learnable pytree modules over the functional core."""

from .body import AbstractRigidBody, PhysicalRigidBody, RigidBody
from .integrator import MoserVeselovIntegrator, Trajectory

__all__ = [
    "AbstractRigidBody",
    "MoserVeselovIntegrator",
    "PhysicalRigidBody",
    "RigidBody",
    "Trajectory",
]
