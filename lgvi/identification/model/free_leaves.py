"""Free leaves of parameters as one vector, bodies with free leaves, functions of the vector."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from ...modules.body import AbstractRigidBody, PhysicalRigidBody, RigidBody
from ...modules.known_axes import KnownAxesRigidBody
from ..running.compilation import compiled

Quantity = Callable[[Any], Any]  # of the parameters


class FreeBody(NamedTuple):
    """A body with free leaves."""

    name: str  # empty for the body of a model
    position: int  # among all bodies of the parameters
    at: np.ndarray  # (p,), True where a free coordinate belongs to the body

    def label(self, quantity: str) -> str:
        """The name of a quantity of the body."""
        return f"{self.name} {quantity}" if self.name else quantity


def is_body(node: Any) -> bool:
    return isinstance(node, AbstractRigidBody)


def bodies_in(parameters: Any) -> list[AbstractRigidBody]:
    """All bodies, in the order of the leaves."""
    return [node for node in jax.tree.leaves(parameters, is_leaf=is_body) if is_body(node)]


def scaling_of(tree: Any) -> Any:
    """The derivative of all leaves where the inertia of each body is multiplied by e^s, at s = 0.

    Zero for leaves outside of bodies, and for leaves of bodies with unknown coordinates.
    """

    def derivative(node: Any) -> Any:
        if type(node) is PhysicalRigidBody:
            # Logarithms of the diagonal of a square root of the inertia.
            return eqx.tree_at(
                lambda body: body.log_cholesky, node, np.array([0.5, 0.5, 0.5, 0, 0, 0])
            )
        if type(node) is KnownAxesRigidBody:
            ones = np.ones(len(node.log_second_moments))
            return eqx.tree_at(lambda body: body.log_second_moments, node, ones)
        if type(node) is RigidBody:
            return node
        return jax.tree.map(lambda leaf: np.zeros(np.shape(leaf)), node)

    return jax.tree.map(derivative, tree, is_leaf=is_body)


class Free(NamedTuple):
    """The free leaves of some parameters, such as a model, as one vector."""

    names: tuple[str, ...]  # of each coordinate
    leaves: tuple[str, ...]  # the leaf of each coordinate
    units: tuple[str, ...]  # of each coordinate, empty where not known
    remedies: tuple[str, ...]  # what makes each coordinate observable, empty where not known
    below_zero: tuple[str, ...]  # the error where a coordinate is, empty if possible
    theta: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    max_step: np.ndarray  # change for which a linear model is good, infinite where not known
    scale_direction: np.ndarray  # multiplies the inertias by e and does nothing else, or zero
    selected: Any  # parameters of True where free
    bodies: tuple[FreeBody, ...]

    def put(self, parameters: Any, theta: Array | np.ndarray) -> Any:
        """The parameters with other values of the free leaves."""
        return put_leaves(parameters, self.selected, theta)

    @property
    def of_body(self) -> np.ndarray:
        """True where a coordinate belongs to a body (p,)."""
        return np.any([np.zeros(len(self.theta), bool), *(body.at for body in self.bodies)], axis=0)


def ravel(tree: Any) -> np.ndarray:
    """All leaves in one vector, in double precision."""
    leaves = [np.ravel(leaf).astype(float) for leaf in jax.tree.leaves(tree)]
    return np.concatenate([np.zeros(0), *leaves])


def unravel(tree: Any, vector: Array | np.ndarray) -> Any:
    """A tree with the structure of another tree, and the leaves from one vector."""
    leaves, structure = jax.tree.flatten(tree)
    ends = np.cumsum([leaf.size for leaf in leaves])
    parts = [
        vector[end - leaf.size : end].reshape(leaf.shape).astype(leaf.dtype)
        for leaf, end in zip(leaves, ends, strict=True)
    ]
    # `jnp.asarray` would compile a program for each shape.
    if isinstance(vector, np.ndarray):
        parts = jax.device_put(parts)
    return jax.tree.unflatten(structure, parts)


def put_leaves(tree: Any, selected: Any, vector: Array | np.ndarray) -> Any:
    """The tree with other values of the selected leaves."""
    leaves, fixed = eqx.partition(tree, selected)
    return eqx.combine(unravel(leaves, vector), fixed)


def put_own_leaves(tree: Any, own: Any, vector: Array | np.ndarray | None) -> Any:
    """The tree with other values of the own leaves of a window; unchanged without values."""
    return tree if vector is None else put_leaves(tree, own, vector)


def inertias_and_derivatives(parameters: Any, free: Free) -> tuple[np.ndarray, np.ndarray]:
    """Inertias (bodies, 3, 3) of the free bodies, and derivatives (bodies, 3, 3, p)."""
    number, bodies, chosen = len(free.bodies), bodies_in(parameters), bodies_in(free.selected)
    theta = free.theta.astype(jax.dtypes.canonicalize_dtype(float))
    J, derivatives = np.zeros((number, 3, 3)), np.zeros((number, 3, 3, len(theta)))
    for k, body in enumerate(free.bodies):
        selected = chosen[body.position]
        J[k], derivatives[k][..., body.at] = _inertia(
            bodies[body.position], selected, theta[body.at]
        )
    return J, derivatives


@compiled("an inertia")
def _inertia(body: AbstractRigidBody, selected: Any, theta: Array) -> tuple[Array, Array]:
    """The inertia for values (p,) of the selected leaves, and its derivative (3, 3, p).

    One program for all models with a body of one class, whatever else is free.
    """

    def inertia(theta: Array) -> Array:
        return put_leaves(body, selected, theta).inertia

    theta = jnp.asarray(theta)
    return inertia(theta), jax.jacfwd(inertia)(theta)


def linearise_quantity(
    quantity: Quantity, parameters: Any, free: Free, theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A function of the parameters, raveled to n numbers, and its Jacobian (n, p).

    At values (p,) of the free leaves, or at several values (draws, p) at once.
    """
    theta = theta.astype(jax.dtypes.canonicalize_dtype(float))
    values, jacobian = _linearised(quantity, parameters, free, theta)
    return np.asarray(values, float), np.asarray(jacobian, float)


def evaluate_quantity(
    quantity: Quantity, parameters: Any, free: Free, theta: np.ndarray
) -> np.ndarray:
    """A function, raveled to n numbers, at several values (draws, p) of the free leaves."""
    theta = theta.astype(jax.dtypes.canonicalize_dtype(float))
    return np.asarray(_evaluated(quantity, parameters, free, theta), float)


def _raveled(quantity: Quantity, parameters: Any, free: Free) -> Callable[[Array], Array]:
    return lambda theta: ravel_pytree(quantity(free.put(parameters, theta)))[0]


@compiled("numbers and their derivative")
def _linearised(
    quantity: Quantity, parameters: Any, free: Free, theta: Array | np.ndarray
) -> tuple[Array, Array]:
    numbers, theta = _raveled(quantity, parameters, free), jnp.asarray(theta)
    jacobian = jax.jacfwd(numbers)
    if theta.ndim == 1:
        return numbers(theta), jacobian(theta)
    return jax.vmap(numbers)(theta), jax.vmap(jacobian)(theta)


@compiled("numbers")
def _evaluated(quantity: Quantity, parameters: Any, free: Free, theta: Array | np.ndarray) -> Array:
    return jax.vmap(_raveled(quantity, parameters, free))(jnp.asarray(theta))
