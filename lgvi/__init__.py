"""Lie-group variational integrators for rigid-body attitude, in JAX and Equinox."""

from .core import (
    SolverInfo,
    determinant_error,
    discrete_inertia,
    energy,
    inertia_from_discrete,
    inertia_from_log_cholesky,
    inertia_from_principal_moments,
    log_cholesky_from_inertia,
    ortho_error,
    rigid_body_step,
    simulate_free_rigid_body,
    simulate_rigid_body,
    so3,
    solve_F,
    solve_F_with_info,
    spatial_momentum,
)
from .modules import (
    AbstractRigidBody,
    MoserVeselovIntegrator,
    PhysicalRigidBody,
    RigidBody,
    Trajectory,
)

__version__ = "0.1.0"

__all__ = [
    "AbstractRigidBody",
    "MoserVeselovIntegrator",
    "PhysicalRigidBody",
    "RigidBody",
    "SolverInfo",
    "Trajectory",
    "determinant_error",
    "discrete_inertia",
    "energy",
    "inertia_from_discrete",
    "inertia_from_log_cholesky",
    "inertia_from_principal_moments",
    "log_cholesky_from_inertia",
    "ortho_error",
    "rigid_body_step",
    "simulate_free_rigid_body",
    "simulate_rigid_body",
    "so3",
    "solve_F",
    "solve_F_with_info",
    "spatial_momentum",
]
