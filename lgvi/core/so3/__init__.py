r"""Rotations: the group SO(3), its algebra, and the charts used by the integrator.

Conventions. A rotation matrix $R$ maps body coordinates to space coordinates.
Quaternions are unit, Hamilton, scalar first (`wxyz`). Angles are in radians.
Derivatives of all orders are finite at the identity and, except for the Cayley chart,
up to and including a half turn.

Each function takes one element. For leading batch axes wrap it in `jax.vmap`, once for
each axis: `jax.vmap(so3.exp)(gs)` gives rotations (n, 3, 3) of rotation vectors (n, 3).
"""

from .charts import (
    cayley,
    cayley_inverse,
    exp,
    hat,
    is_rotation,
    log,
    matrix_to_wxyz,
    vee,
    wxyz_to_matrix,
)
from .jacobians import (
    left_jacobian,
    left_jacobian_inverse,
    right_jacobian,
    right_jacobian_inverse,
)

__all__ = [
    "cayley",
    "cayley_inverse",
    "exp",
    "hat",
    "is_rotation",
    "left_jacobian",
    "left_jacobian_inverse",
    "log",
    "matrix_to_wxyz",
    "right_jacobian",
    "right_jacobian_inverse",
    "vee",
    "wxyz_to_matrix",
]
