"""The states at the beginning of trajectories, which are estimated beside a model."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy.spatial.transform import Rotation

from ...core import so3
from ...core.kernels.vectors import matmul
from ...core.typed_arrays import Shape, as_floats, as_real
from ...modules.sensors.sensor import states_of
from .model import Model

ArrayOrNumpy = Array | np.ndarray


def state_leaves(model: Model) -> Any:
    """The model of True where a leaf is a state of a trajectory; None without any."""
    states = jax.tree.map(lambda _: False, model)
    if model.rotors is not None and model.rotors.lag is not None:
        states = eqx.tree_at(lambda m: m.rotors.behind, states, True)
    if model.gravity is not None:
        states = eqx.tree_at(lambda m: (m.x0, m.v0), states, (True, True))
    for channel, sensor in model.sensors.items():
        for field in states_of(sensor):
            states = eqx.tree_at(
                lambda m, channel=channel, field=field: getattr(m.sensors[channel], field),
                states,
                replace_fn=lambda node: jax.tree.map(lambda _: True, node),
            )
    return states if any(jax.tree.leaves(states)) else None


def are_states(model: Model, own: Any) -> np.ndarray:
    """Whether each number of a trajectory's own leaves is a state (m,).

    `own` is a model of True where a leaf is a trajectory's own, or None.
    """
    if own is None:
        return np.zeros(0, bool)
    leaves, states = jax.tree.leaves(model), state_leaves(model)
    marks = [False] * len(leaves) if states is None else jax.tree.leaves(states)
    parts = [
        np.full(np.size(leaf), mark)
        for leaf, mark, is_own in zip(leaves, marks, jax.tree.leaves(own), strict=True)
        if is_own
    ]
    return np.concatenate([np.zeros(0, bool), *parts])


def _of_trajectories(name: str, value: ArrayLike | Sequence[Any], one: Shape) -> Array:
    """Numbers (trajectories, *one) of several trajectories, or of a single trajectory."""
    shape = as_real(name, value).shape
    if shape != one and shape[1:] != one:
        sizes = ", ".join(map(str, one))
        raise ValueError(
            f"Argument `{name}` must have shape (trajectories, {sizes}) or {one}, but its shape is "
            f"{shape}."
        )
    (array,) = as_floats(**{name: (value, shape)})
    return array[None] if shape == one else array


class InitialStates(eqx.Module):
    """States at the beginning of trajectories.

    Parameters
    ----------
    R
        Attitudes (trajectories, 3, 3), body to space.
    omega
        Angular velocities (trajectories, 3), body frame, rad/s.
    own
        Other states (trajectories, m), in this sequence: the position, m, and the velocity, m/s,
        of each [`PositionSensor`][lgvi.PositionSensor] with a `gravity` of its own; for rotors with
        a lag how far their speeds are behind the commands; for a model with a `gravity` the
        position, m, and the velocity, m/s, of its centre of mass. None stands for the states in the
        model, or for a model without states.
    """

    R: Float[ArrayOrNumpy, "*trajectories 3 3"]
    omega: Float[ArrayOrNumpy, "*trajectories 3"]
    own: Float[ArrayOrNumpy, "*trajectories m"] | None = None

    @classmethod
    def from_rates(
        cls, omega: Float[ArrayLike, "*trajectories 3"] | Sequence[Any]
    ) -> "InitialStates":
        """States of angular velocities (trajectories, 3), rad/s, whose attitudes are the identity.

        One angular velocity (3,) is one trajectory.

        Raises
        ------
        ValueError, TypeError
            For a wrong shape or type.
        """
        omega = _of_trajectories("omega", omega, (3,))
        identity = jnp.eye(3, dtype=omega.dtype)
        return cls(jnp.broadcast_to(identity, (len(omega), 3, 3)), omega)

    @classmethod
    def from_attitudes(
        cls, R: Float[ArrayLike, "*trajectories 3 3"] | Sequence[Any]
    ) -> "InitialStates":
        """States at rest in attitudes (trajectories, 3, 3), body to space.

        One attitude (3, 3) is one trajectory.

        Raises
        ------
        ValueError, TypeError
            For a wrong shape or type.
        """
        R = _of_trajectories("R", R, (3, 3))
        return cls(R, jnp.zeros((len(R), 3), R.dtype))

    @property
    def unknowns(self) -> int:
        """Number of unknowns of a trajectory."""
        return 6 if self.own is None else 6 + self.own.shape[-1]

    def moved(self, phi: ArrayOrNumpy) -> "InitialStates":
        """The states moved by a rotation vector, body frame, rad, and changes of `omega` and `own`.

        `phi` has these in sequence (..., 6+m), or (..., 6) without `own`; rates are in rad/s.
        """
        own = self.own
        if own is not None and phi.shape[-1] > 6:
            own = own + phi[..., 6:].astype(own.dtype)
        if all(isinstance(x, np.ndarray) for x in (self.R, self.omega, phi)):
            turned = self.R @ Rotation.from_rotvec(phi[..., :3]).as_matrix().astype(self.R.dtype)
            return InitialStates(turned, self.omega + phi[..., 3:6].astype(self.omega.dtype), own)
        turn = jnp.vectorize(so3.exp, signature="(3)->(3,3)")(phi[..., :3])
        return InitialStates(matmul(jnp.asarray(self.R), turn), self.omega + phi[..., 3:6], own)

    def put(self, index: np.ndarray, others: "InitialStates") -> "InitialStates":
        """All states, with the states of some trajectories replaced, as NumPy arrays."""

        def replaced(old: ArrayOrNumpy, new: ArrayOrNumpy) -> np.ndarray:
            values = np.array(old)
            values[index] = new
            return values

        return jax.tree.map(replaced, self, others)

    def at(self, index: np.ndarray | slice) -> "InitialStates":
        """The states of some trajectories, by index."""
        own = None if self.own is None else self.own[index]
        return InitialStates(self.R[index], self.omega[index], own)
