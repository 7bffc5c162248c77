r"""Rotations: the group SO(3), its algebra, and the charts used by the integrator.

Conventions. A rotation matrix $R$ maps body coordinates to space coordinates.
Quaternions are unit, Hamilton, scalar first (`wxyz`). Angles are in radians.
Derivatives of all orders are finite at the identity and, except for the Cayley chart,
up to and including a half turn.

Each function takes one element. For leading batch axes wrap it in `jax.vmap`, once for
each axis: `jax.vmap(so3.exp)(gs)` gives rotations (n, 3, 3) of rotation vectors (n, 3).
"""

from .charts import cayley as cayley
from .charts import cayley_inverse as cayley_inverse
from .charts import distance as distance
from .charts import exp as exp
from .charts import hat as hat
from .charts import is_rotation as is_rotation
from .charts import log as log
from .charts import matrix_to_wxyz as matrix_to_wxyz
from .charts import vee as vee
from .charts import wxyz_to_matrix as wxyz_to_matrix
from .jacobians import left_jacobian as left_jacobian
from .jacobians import left_jacobian_inverse as left_jacobian_inverse
from .jacobians import right_jacobian as right_jacobian
from .jacobians import right_jacobian_inverse as right_jacobian_inverse
