"""Which leaves of a model are free, and these as one vector."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...modules.body import PhysicalRigidBody, RigidBody
from ...modules.fields import description
from ..compilation import compiled
from .model import Model

Where = Callable[[Any], Any]  # of a model
Bound = tuple[Where, float, float]
LARGE_CHANGE = 2.0  # of the logarithms that are coordinates of an inertia


def body_of(model: Model) -> Any:
    """What is estimated unless something else is asked for."""
    return model.body


class Free(NamedTuple):
    """The free leaves of a model as one vector."""

    names: tuple[str, ...]  # of each coordinate
    leaves: tuple[str, ...]  # the leaf of each coordinate
    units: tuple[str, ...]  # of each coordinate, empty where not known
    remedies: tuple[str, ...]  # what makes each coordinate observable, empty where not known
    theta: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    max_step: np.ndarray  # change for which a linear model is good, infinite where not known
    scale_direction: np.ndarray  # multiplies the inertia by e and does nothing else, or zero
    selected: Any  # a model of True where free

    def model(self, model: Model, theta: Array | np.ndarray) -> Model:
        """The model with other values of the free leaves."""
        leaves, fixed = eqx.partition(model, self.selected)
        return eqx.combine(unravel(leaves, theta), fixed)

    @property
    def of_body(self) -> np.ndarray:
        """True where a coordinate is one of the body's (p,)."""
        return np.array([leaf.split(".")[0] == "body" for leaf in self.leaves], bool)


class _Leaf(NamedTuple):
    """A free leaf."""

    name: str
    shape: tuple[int, ...]
    unit: str
    remedy: str

    def coordinates(self) -> list[str]:
        indices = [", ".join(map(str, index)) for index in np.ndindex(self.shape)]
        return [f"{self.name}[{index}]" if index else self.name for index in indices]


def _leaves(model: Model, selected: Any) -> list[_Leaf]:
    found = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(eqx.filter(model, selected)):
        told = description(model, path)
        if getattr(path[0], "name", "") == "sensors":  # by its channel
            path = (jax.tree_util.GetAttrKey(path[1].key), *path[2:])
        name = jax.tree_util.keystr(path).lstrip(".")
        found.append(_Leaf(name, leaf.shape, told.get("unit", ""), told.get("remedy", "")))
    return found


def select_free_leaves(model: Model, free: Where, bounds: Sequence[Bound]) -> Free:
    """Take the free leaves of a model.

    Raises
    ------
    ValueError, TypeError
        If `free` or a bound do not choose floating-point leaves that can be estimated.
    """
    selected = _selected("free", free, model)
    leaves = _leaves(model, selected)
    _require_fittable(model, selected, leaves)
    theta = ravel(eqx.filter(model, selected))
    each = [leaf for leaf in leaves for _ in leaf.coordinates()]
    names = tuple(name for leaf in leaves for name in leaf.coordinates())
    lower, upper = _limits(model, selected, bounds, names, theta)
    found = Free(
        names=names,
        leaves=tuple(leaf.name for leaf in each),
        units=tuple(leaf.unit for leaf in each),
        remedies=tuple(leaf.remedy for leaf in each),
        theta=theta,
        lower=lower,
        upper=upper,
        max_step=np.full_like(theta, np.inf),
        scale_direction=np.zeros_like(theta),
        selected=selected,
    )
    if isinstance(model.body, PhysicalRigidBody):
        of_body = np.flatnonzero(found.of_body)
        found.max_step[of_body] = LARGE_CHANGE
        if type(model.body) is PhysicalRigidBody:
            # Logarithms of the diagonal of a square root of the inertia.
            found.scale_direction[of_body[:3]] = 0.5
    return found


def _require_fittable(model: Model, selected: Any, leaves: list[_Leaf]) -> None:
    sigmas = [f"{channel}.sigma" for channel in model.sensors]
    for leaf in leaves:
        if leaf.name in sigmas:
            raise ValueError(
                f"Argument `free` must not choose `{leaf.name}`: least squares does not find the "
                "noise. Its size is in the report; to learn it use `negative_log_likelihood`."
            )
    if isinstance(model.body, RigidBody) and any(jax.tree.leaves(selected.body)):
        raise TypeError(
            "Argument `body` must keep its inertia physical where that is free: use "
            "`PhysicalRigidBody`, not RigidBody."
        )


def _limits(
    model: Model, selected: Any, bounds: Sequence[Bound], names: Sequence[str], theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of each coordinate, infinite where there is none."""
    lower, upper = np.full_like(theta, -np.inf), np.full_like(theta, np.inf)
    try:
        triples = [(where, float(least), float(most)) for where, least, most in bounds]
    except (TypeError, ValueError):
        raise TypeError(
            "Argument `bounds` must be triples of a function, a lower and an upper bound, but is "
            f"{bounds!r}."
        ) from None
    for i, (where, least, most) in enumerate(triples):
        chosen = _selected(f"bounds[{i}]", where, model)
        if not least < most:
            raise ValueError(
                f"Argument `bounds[{i}]` must have a lower bound below the upper one, but has "
                f"{least!r} and {most!r}."
            )
        # Leaves of ones where bounded, raveled as the free ones are.
        ones = jax.tree.map(
            lambda leaf, free, bounded: np.full(leaf.shape, float(bounded)) if free else None,
            model, selected, chosen,
        )  # fmt: skip
        bounded = ravel(ones) > 0
        if not bounded.any():
            raise ValueError(f"Argument `bounds[{i}]` must choose a leaf that is free.")
        lower[bounded], upper[bounded] = least, most
    if (outside := (theta < lower) | (theta > upper)).any():
        i = int(np.argmax(outside))
        raise ValueError(
            f"The start of `{names[i]}` must be within its bounds {lower[i]:g} and {upper[i]:g}, "
            f"but is {theta[i]:g}."
        )
    return lower, upper


def _selected(name: str, where: Where, model: Model) -> Any:
    if not callable(where):
        raise TypeError(
            f"Argument `{name}` must be a function that takes nodes out of a model, such as "
            f"`lambda model: model.body`, but is {where!r}."
        )
    nothing = jax.tree.map(lambda _: False, model)
    try:
        nodes = jax.tree.leaves(
            where(nothing), is_leaf=lambda node: node is None or isinstance(node, eqx.Module)
        )
        if any(node is None for node in nodes):
            raise ValueError(
                "a node that it takes is None: give it first, such as a `torque`, or the "
                "`time_offset=0.0` of a sensor"
            )
        chosen = eqx.tree_at(
            where, nothing, replace_fn=lambda node: jax.tree.map(lambda _: True, node)
        )
    except Exception as error:
        raise ValueError(
            f"Argument `{name}` must take nodes out of a model, such as "
            "`lambda model: (model.body, model.time_scale)`, whole and as they are, no entry nor "
            f"something computed from them, but: {error}"
        ) from error
    chosen = jax.tree.map(lambda leaf, it: it and eqx.is_inexact_array(leaf), model, chosen)
    if not any(jax.tree.leaves(chosen)):
        raise ValueError(f"Argument `{name}` must choose a floating-point leaf, but chooses none.")
    return chosen


def ravel(tree: Any) -> np.ndarray:
    """All leaves in one vector, in double precision."""
    return np.concatenate([np.ravel(leaf).astype(float) for leaf in jax.tree.leaves(tree)])


def unravel(tree: Any, vector: Array | np.ndarray) -> Any:
    """A tree like another one with leaves out of one vector."""
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


def inertia_and_derivative(model: Model, free: "Free") -> tuple[np.ndarray, np.ndarray]:
    """The inertia (3, 3), and its derivative (3, 3, p) in the free leaves."""
    theta = free.theta.astype(jax.dtypes.canonicalize_dtype(float))
    J, derivative = _inertia(model, free, theta, few=True)
    return np.asarray(J, float), np.asarray(derivative, float)


@compiled
def _inertia(model: Model, free: "Free", theta: Array | np.ndarray) -> tuple[Array, Array]:
    def inertia(theta: Array) -> Array:
        return free.model(model, theta).body.inertia

    theta = jnp.asarray(theta)
    return inertia(theta), jax.jacfwd(inertia)(theta)
