"""One configuration of an identification: the model as a function of parameters."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...core.kernels.dependence import operations_of, reached
from ..data.recordings import Recordings
from ..running.compilation import compiled
from .free_leaves import Free, linearise_quantity, put_leaves, ravel, unravel
from .model import Model
from .states import InitialStates, are_states


class ModelAt(NamedTuple):
    """A model, with a vector of some leaves, which depends on the free leaves."""

    model: Model
    selected: Any  # a model of True where a leaf is in the vector
    leaves: np.ndarray  # (q,), or (n, q) for n values of the free leaves
    jacobian: np.ndarray | None  # (q, p), or (n, q, p); None where the vector is the free leaves
    own: Any = None  # a model of True where a leaf is a trajectory's own


class ModelOfLeaves(NamedTuple):
    """A model as a function of the free leaves, within a program; fields as in `Configuration`."""

    model: Model
    function: Callable[[Any], Model] | None
    selected: Any
    own: Any

    def at(self, parameters: Any, free: Free, theta: Array) -> Model:
        """The model for values (p,) of the free leaves."""
        if self.function is None:
            return put_leaves(self.model, self.selected, theta)
        return eqx.combine(_floats(self.function(free.put(parameters, theta))), self.model)


class Configuration(NamedTuple):
    """A model as a function of the parameters, and the recordings.

    The function is None where the parameters are the model.
    """

    name: str
    recordings: Recordings
    model: Model  # at the start
    function: Callable[[Any], Model] | None
    selected: Any  # leaves of the model that depend on the free leaves
    own: Any = None  # leaves of the model with a value for each trajectory; None without any

    @classmethod
    def of_function(
        cls,
        name: str,
        recordings: Recordings,
        function: Callable[[Any], Model],
        parameters: Any,
        free: Free,
    ) -> "Configuration":
        """The configuration of a function that gives a model.

        Raises
        ------
        TypeError, ValueError
            If the function gives no model, or no leaf of the model depends on the free leaves.
        """
        return cls.of_model(name, recordings, function, function(parameters), parameters, free)

    @classmethod
    def of_model(
        cls,
        name: str,
        recordings: Recordings,
        function: Callable[[Any], Model],
        model: Any,
        parameters: Any,
        free: Free,
    ) -> "Configuration":
        """The configuration of a function, with the value of the function at the parameters."""
        if not isinstance(model, Model):
            raise TypeError(
                "Argument `parts` must have functions that give a `Model`, but that of "
                f"{name!r} gives {model!r}."
            )
        model = eqx.combine(_floats(model), model)
        selected = _select_dependent(function, parameters, free, model)
        if not any(jax.tree.leaves(selected)):
            raise ValueError(
                "Argument `parts` must have models that depend on what is free, but that of "
                f"{name!r} does not."
            )
        return cls(name, recordings, model, function, selected)

    @property
    def own_start(self) -> np.ndarray:
        """The own leaves of a trajectory, at the start (m,)."""
        return np.zeros(0) if self.own is None else ravel(eqx.filter(self.model, self.own))

    @property
    def is_state(self) -> np.ndarray:
        """Whether each number of `own_start` is a state of a sensor (m,)."""
        return are_states(self.model, self.own)

    def initial_states(self, states: InitialStates) -> InitialStates:
        """Initial states whose `own` has no leaves except the states of sensors."""
        is_state = self.is_state
        if states.own is None or not is_state.any():
            return InitialStates(states.R, states.omega)
        return InitialStates(states.R, states.omega, states.own[:, : len(is_state)][:, is_state])

    def own_of(self, states: InitialStates) -> Any:
        """The own leaves of each trajectory (trajectories, ...), alone in a model."""
        if self.own is None:
            return None
        leaves = eqx.filter(self.model, self.own)
        rows = [unravel(leaves, row) for row in np.asarray(states.own)]
        return jax.tree.map(lambda *values: np.stack(values), *rows)

    def at(self, parameters: Any, free: Free, theta: np.ndarray) -> ModelAt:
        """The model for values (p,) of the free leaves, or for n values (n, p) at once."""
        if self.function is None:
            return ModelAt(self.model, self.selected, theta, None, self.own)
        theta = theta.astype(jax.dtypes.canonicalize_dtype(float))
        floats, leaves, jacobian = _evaluated(self.function, self.selected, parameters, free, theta)
        model = eqx.combine(floats, self.model)
        jacobian = np.asarray(jacobian, float)
        return ModelAt(model, self.selected, np.asarray(leaves), jacobian, self.own)

    @property
    def of_leaves(self) -> ModelOfLeaves:
        """The model as a function that programs can call."""
        return ModelOfLeaves(self.model, self.function, self.selected, self.own)

    def model_at(self, parameters: Any, free: Free, theta: np.ndarray) -> Model:
        """The model for values (p,) of the free leaves."""
        at = self.at(parameters, free, theta)
        return put_leaves(at.model, at.selected, at.leaves)


def _floats(model: Model) -> Model:
    """The floating-point leaves alone, in the default precision."""
    dtype = jax.dtypes.canonicalize_dtype(float)
    return jax.tree.map(lambda x: x.astype(dtype), eqx.filter(model, eqx.is_inexact_array))


@compiled("the model")
def _evaluated(
    function: Callable[[Any], Model],
    selected: Any,
    parameters: Any,
    free: Free,
    theta: Array | np.ndarray,
) -> tuple[Model, Array, Array]:
    """The model's floating-point leaves for the first `theta`; all vectors and Jacobians."""

    def leaves(theta: Array) -> tuple[Array, Model]:
        floats = _floats(function(free.put(parameters, theta)))
        chosen = jax.tree.leaves(eqx.filter(floats, selected))
        empty = jnp.zeros(0, theta.dtype)
        return jnp.concatenate([empty, *(leaf.ravel() for leaf in chosen)]), floats

    theta = jnp.asarray(theta)
    values, floats = jax.vmap(leaves)(jnp.atleast_2d(theta))
    jacobian, _ = jax.vmap(jax.jacfwd(leaves, has_aux=True))(jnp.atleast_2d(theta))
    if theta.ndim == 1:
        values, jacobian = values[0], jacobian[0]
    return jax.tree.map(lambda x: x[0], floats), values, jacobian


def _select_dependent(
    function: Callable[[Any], Model], parameters: Any, free: Free, model: Model
) -> Any:
    """The model of True where a floating-point leaf depends on the free leaves.

    The operations of the function are followed, so that a derivative that is zero by chance does
    not mislead.
    """

    def floats(theta: Array) -> list[Array]:
        return jax.tree.leaves(_floats(function(free.put(parameters, theta))))

    theta = free.theta.astype(jax.dtypes.canonicalize_dtype(float))
    depends = iter(reached(operations_of(floats, theta), [0]))
    selected = jax.tree.map(lambda leaf: eqx.is_inexact_array(leaf) and next(depends), model)
    for channel in model.sensors:
        if selected.sensors[channel].sigma and _moves(function, parameters, free, channel):
            raise ValueError(
                f"The `sigma` of `{channel}` must not depend on what is free: least squares does "
                "not find the noise. Its size is in the report."
            )
        selected = eqx.tree_at(lambda m, c=channel: m.sensors[c].sigma, selected, False)
    return selected


def _moves(function: Callable[[Any], Model], parameters: Any, free: Free, channel: str) -> bool:
    """Whether the noise of a sensor changes with the free leaves."""

    def sigma(parameters: Any) -> Array:
        return jnp.asarray(function(parameters).sensors[channel].sigma)

    # Also beside the start, where no derivative is zero by chance.
    beside = free.theta + 0.01 * (1 + abs(free.theta)) * np.linspace(1, 2, len(free.theta))
    at = np.stack([free.theta, beside])
    return bool(linearise_quantity(sigma, parameters, free, at)[1].any())
