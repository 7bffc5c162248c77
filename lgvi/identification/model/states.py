"""The states at the beginning of trajectories, which are estimated beside a model."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from ...core import so3
from ...core.kernels.vectors import matmul

Numbers = Array | np.ndarray


class InitialStates(eqx.Module):
    """States at the beginning of trajectories.

    Attributes
    ----------
    R
        Attitudes (trajectories, 3, 3), body to space.
    omega
        Angular velocities (trajectories, 3), body frame, rad/s.
    """

    R: Float[Numbers, "*trajectories 3 3"]
    omega: Float[Numbers, "*trajectories 3"]

    def moved(self, phi: Numbers) -> "InitialStates":
        """With a rotation vector, body frame, rad, and a change of `omega`, rad/s (..., 6)."""
        if all(isinstance(x, np.ndarray) for x in (self.R, self.omega, phi)):
            turned = self.R @ Rotation.from_rotvec(phi[..., :3]).as_matrix().astype(self.R.dtype)
            return InitialStates(turned, self.omega + phi[..., 3:].astype(self.omega.dtype))
        turn = jnp.vectorize(so3.exp, signature="(3)->(3,3)")(phi[..., :3])
        return InitialStates(matmul(jnp.asarray(self.R), turn), self.omega + phi[..., 3:])

    def gap(self, following: "InitialStates") -> Array:
        """Turn and change of angular velocity to another state (6,)."""
        turn = so3.log(matmul(jnp.asarray(self.R).T, jnp.asarray(following.R)))
        return jnp.concatenate([turn, following.omega - self.omega])

    def at(self, index: np.ndarray | slice) -> "InitialStates":
        """The states of some trajectories, by index."""
        return InitialStates(self.R[index], self.omega[index])
