"""The bodies among some parameters: their inertias, and the directions that scale them."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...modules.body import AbstractRigidBody, PhysicalRigidBody, RigidBody
from ...modules.known_axes import KnownAxesRigidBody


class FreeBody(NamedTuple):
    """A body with free leaves."""

    name: str  # empty for that of a model
    position: int  # among all bodies of the parameters
    at: np.ndarray  # (p,), True where a free coordinate is one of its

    def label(self, quantity: str) -> str:
        """What a quantity of the body is called."""
        return f"{self.name} {quantity}" if self.name else quantity


def is_body(node: Any) -> bool:
    return isinstance(node, AbstractRigidBody)


def bodies_in(parameters: Any) -> list[AbstractRigidBody]:
    """All bodies, in the order of the leaves."""
    return [node for node in jax.tree.leaves(parameters, is_leaf=is_body) if is_body(node)]


class Inertias(eqx.Module):
    """The function of parameters that gives the inertias of some bodies (bodies, 3, 3)."""

    positions: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, parameters: Any) -> Array:
        bodies = bodies_in(parameters)
        return jnp.stack([bodies[i].inertia for i in self.positions])


def scaling_of(tree: Any) -> Any:
    """The derivative of all leaves where the inertia of each body is multiplied by e^s, at s = 0.

    Zero for leaves that are not those of a body, or of a body whose coordinates are not known.
    """

    def of_node(node: Any) -> Any:
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

    return jax.tree.map(of_node, tree, is_leaf=is_body)
