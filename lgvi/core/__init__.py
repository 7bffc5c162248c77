"""The equations of rigid-body attitude: arrays in, arrays out, one state per call."""

from . import so3
from .diagnostics import determinant_error, energy, ortho_error, spatial_momentum
from .dynamics import rigid_body_step, simulate_free_rigid_body, simulate_rigid_body
from .inertia import (
    discrete_inertia,
    inertia_from_discrete,
    inertia_from_log_cholesky,
    inertia_from_principal_moments,
    log_cholesky_from_inertia,
)
from .step.solve import SolverInfo, solve_F, solve_F_with_info

__all__ = [
    "SolverInfo",
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
