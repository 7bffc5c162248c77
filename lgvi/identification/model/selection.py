"""Which leaves of some parameters are free, with their names, units and bounds."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from ...modules.body import AbstractRigidBody, PhysicalRigidBody, RigidBody
from ...modules.fields import description
from ...modules.known_axes import KnownAxesRigidBody
from ...modules.sensors.sensor import AbstractSensor
from .free_leaves import Free, FreeBody, is_body, ravel, scaling_of
from .model import Model
from .states import state_leaves

Where = Callable[[Any], Any]  # of the parameters, such as a model
Bound = tuple[Where, Any, Any]  # with a lower and an upper bound, of all numbers or of each
LARGE_CHANGE = 2.0  # of the logarithms that are coordinates of an inertia


def body_of(model: Model) -> Any:
    """The body of a model, which is estimated by default."""
    return model.body


class _Leaf(NamedTuple):
    """A free leaf."""

    name: str
    shape: tuple[int, ...]
    unit: str
    remedy: str
    below_zero: str

    def coordinates(self) -> list[str]:
        indices = [", ".join(map(str, index)) for index in np.ndindex(self.shape)]
        return [f"{self.name}[{index}]" if index else self.name for index in indices]

    def signs(self) -> list[str]:
        """The error of each coordinate below zero, empty where such values are possible."""
        on_diagonal = [len(index) < 2 or len(set(index)) == 1 for index in np.ndindex(self.shape)]
        return [self.below_zero if diagonal else "" for diagonal in on_diagonal]


def _name(parameters: Any, path: tuple[Any, ...]) -> str:
    """The name of a node; the name of a sensor of a model is the channel."""
    if not path:
        return "parameters"
    if isinstance(parameters, Model) and getattr(path[0], "name", "") == "sensors":
        path = (jax.tree_util.GetAttrKey(path[1].key), *path[2:])
    return jax.tree_util.keystr(path, simple=True, separator=".")


def _leaves(parameters: Any, selected: Any) -> list[_Leaf]:
    leaves = []
    chosen = eqx.filter(parameters, selected)
    for path, leaf in jax.tree_util.tree_leaves_with_path(chosen):
        told = description(parameters, path)
        name = _name(parameters, path)
        words = (told.get(key, "") for key in ("unit", "remedy", "below_zero"))
        leaves.append(_Leaf(name, leaf.shape, *words))
    return leaves


def select_free_leaves(parameters: Any, free: Where, bounds: Sequence[Bound]) -> Free:
    """Take the free leaves of some parameters.

    Raises
    ------
    ValueError, TypeError
        If `free` or a bound do not choose floating-point leaves that can be estimated.
    """
    selected = _selected("free", free, parameters)
    leaves = _leaves(parameters, selected)
    _require_fittable(parameters, selected)
    theta = ravel(eqx.filter(parameters, selected))
    leaf_of_coordinate = [leaf for leaf in leaves for _ in leaf.coordinates()]
    names = tuple(name for leaf in leaves for name in leaf.coordinates())
    lower, upper = _limits(parameters, selected, bounds, names, theta)
    return Free(
        names=names,
        leaves=tuple(leaf.name for leaf in leaf_of_coordinate),
        units=tuple(leaf.unit for leaf in leaf_of_coordinate),
        remedies=tuple(leaf.remedy for leaf in leaf_of_coordinate),
        below_zero=tuple(words for leaf in leaves for words in leaf.signs()),
        theta=theta,
        lower=lower,
        upper=upper,
        max_step=_max_step(parameters, selected),
        scale_direction=ravel(eqx.filter(scaling_of(parameters), selected)),
        selected=selected,
        bodies=tuple(_free_bodies(parameters, selected)),
    )


def select_own_leaves(own: Where, model: Model, selected: Any) -> Any:
    """The model of True where a leaf has a value for each trajectory.

    `selected` is True for leaves that all trajectories share. `own` may return an empty tuple.

    Raises
    ------
    ValueError, TypeError
        If `own` chooses other than floating-point leaves, leaves of the body, or free leaves.
    """
    chosen = _selected("own", own, model, may_be_empty=True)
    _require_no_noise("own", model, chosen)
    both = jax.tree.map(lambda a, b: a and b, chosen, selected)
    for leaf in _leaves(model, both):
        raise ValueError(
            f"Argument `own` must not choose `{leaf.name}`, which is free: a leaf is either shared "
            "by all trajectories or each one's own."
        )
    if any(jax.tree.leaves(chosen.body)):
        raise ValueError(
            "Argument `own` must not choose leaves of the body, which is one in all trajectories "
            "of its recordings."
        )
    return chosen


def add_state_leaves(own: Any, model: Model, selected: Any) -> Any:
    """Own leaves, or None, and the states of sensors and rotors; None without any leaves.

    Raises
    ------
    ValueError
        If a leaf that is a state is free.
    """
    states = state_leaves(model)
    if states is None:
        return own
    both = jax.tree.map(lambda a, b: a and b, states, selected)
    for leaf in _leaves(model, both):
        raise ValueError(
            f"The leaf `{leaf.name}` must not be free, nor depend on what is free: each trajectory "
            "begins with its own."
        )
    return states if own is None else jax.tree.map(lambda a, b: a or b, own, states)


def _free_bodies(parameters: Any, selected: Any) -> Iterator[FreeBody]:
    nodes = _nodes(AbstractRigidBody, parameters, selected)
    for position, (path, _, _) in enumerate(nodes):
        name = "" if isinstance(parameters, Model) else path
        at = ravel(eqx.filter(_marked(parameters, position), selected)) > 0
        if at.any():
            yield FreeBody(name, position, at)


def _marked(parameters: Any, position: int) -> Any:
    """The parameters with ones for all leaves of a body, and zeros for other leaves."""
    nodes, structure = jax.tree.flatten(parameters, is_leaf=is_body)
    index = [i for i, node in enumerate(nodes) if is_body(node)][position]
    marked = [
        jax.tree.map(lambda leaf, i=i: np.full(np.shape(leaf), float(i == index)), node)
        for i, node in enumerate(nodes)
    ]
    return jax.tree.unflatten(structure, marked)


def _max_step(parameters: Any, selected: Any) -> np.ndarray:
    def steps(node: Any) -> Any:
        most = LARGE_CHANGE if isinstance(node, (PhysicalRigidBody, KnownAxesRigidBody)) else np.inf
        return jax.tree.map(lambda leaf: np.full(np.shape(leaf), most), node)

    return ravel(eqx.filter(jax.tree.map(steps, parameters, is_leaf=is_body), selected))


def _require_fittable(parameters: Any, selected: Any) -> None:
    _require_no_noise("free", parameters, selected)
    for name, _, chosen in _nodes(RigidBody, parameters, selected):
        if any(jax.tree.leaves(chosen)):
            raise TypeError(
                f"Argument `{name}` must keep its inertia physical where that is free: use "
                "`PhysicalRigidBody`, not RigidBody."
            )


def _require_no_noise(argument: str, parameters: Any, selected: Any) -> None:
    for name, _, chosen in _nodes(AbstractSensor, parameters, selected):
        if any(jax.tree.leaves(chosen.sigma)):
            raise ValueError(
                f"Argument `{argument}` must not choose `{name}.sigma`: least squares does not "
                "find the noise. Its size is in the report; to learn it use "
                "`negative_log_likelihood`."
            )


def _nodes(kind: type, parameters: Any, selected: Any) -> Iterator[tuple[str, Any, Any]]:
    """The names of the nodes of a kind, the nodes, and trees of True where selected."""

    def is_node(node: Any) -> bool:
        return isinstance(node, kind)

    nodes = jax.tree_util.tree_leaves_with_path(parameters, is_leaf=is_node)
    chosen = jax.tree.leaves(selected, is_leaf=is_node)
    for (path, node), marks in zip(nodes, chosen, strict=True):
        if is_node(node):
            yield _name(parameters, path), node, marks


def _limits(
    parameters: Any, selected: Any, bounds: Sequence[Bound], names: Sequence[str], theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bounds of each coordinate, infinite without a bound."""
    lower, upper = np.full_like(theta, -np.inf), np.full_like(theta, np.inf)
    try:
        triples = [
            (where, np.asarray(least, float), np.asarray(most, float))
            for where, least, most in bounds
        ]
    except (TypeError, ValueError):
        raise TypeError(
            "Argument `bounds` must be triples of a function, a lower and an upper bound, but is "
            f"{bounds!r}."
        ) from None
    for i, (where, least, most) in enumerate(triples):
        chosen = _selected(f"bounds[{i}]", where, parameters)
        # Leaves of ones where bounded, raveled like the free leaves.
        ones = jax.tree.map(
            lambda leaf, free, bounded: np.full(leaf.shape, float(bounded)) if free else None,
            parameters, selected, chosen,
        )  # fmt: skip
        bounded = ravel(ones) > 0
        number = int(np.sum(bounded))
        if not number:
            raise ValueError(f"Argument `bounds[{i}]` must choose a leaf that is free.")
        one_leaf = len(jax.tree.leaves(eqx.filter(parameters, chosen))) == 1
        if any(bound.ndim and (bound.size != number or not one_leaf) for bound in (least, most)):
            raise ValueError(
                f"Argument `bounds[{i}]` must have bounds that are one number each, or, of one "
                f"leaf, one for each of its numbers, but has {least} and {most} for {number}."
            )
        if not np.all(least <= most):
            raise ValueError(
                f"Argument `bounds[{i}]` must have a lower bound that is not above the upper one, "
                f"but has {least} and {most}."
            )
        lower[bounded], upper[bounded] = least.ravel(), most.ravel()
    if (outside := (theta < lower) | (theta > upper)).any():
        i = int(np.argmax(outside))
        raise ValueError(
            f"The start of `{names[i]}` must be within its bounds {lower[i]:g} and {upper[i]:g}, "
            f"but is {theta[i]:g}."
        )
    return lower, upper


def names_of(parameters: Any, selected: Any) -> list[str]:
    """The name of each number of the selected leaves."""
    return [name for leaf in _leaves(parameters, selected) for name in leaf.coordinates()]


def _selected(name: str, where: Where, parameters: Any, may_be_empty: bool = False) -> Any:
    """The parameters of True where a function takes a leaf; `may_be_empty` allows no leaf."""
    if not callable(where):
        raise TypeError(
            f"Argument `{name}` must be a function that takes nodes out of a model, such as "
            f"`lambda model: model.body`, but is {where!r}."
        )
    nothing = jax.tree.map(lambda _: False, parameters)
    try:
        nodes = jax.tree.leaves(
            where(nothing), is_leaf=lambda node: node is None or isinstance(node, eqx.Module)
        )
        if may_be_empty and not nodes:
            return nothing
        if any(node is None for node in nodes):
            raise ValueError(
                "a node that it takes is None: give it first, such as a `torque`, or the "
                "`time_offset=0.0` or the `drag=0.0` of a sensor"
            )
        chosen = eqx.tree_at(
            where, nothing, replace_fn=lambda node: jax.tree.map(lambda _: True, node)
        )
    except Exception as error:
        words = f"there is no {error}" if isinstance(error, KeyError) else str(error)
        if "subscriptable" in words:
            words = (
                "an entry cannot be taken: take the whole leaf, and hold its other entries by "
                "equal `bounds`, such as `[(lambda model: model.sensors['angular_velocity'].bias, "
                "[-1, 0, 0], [1, 0, 0])]`"
            )
        if isinstance(error, KeyError) and isinstance(parameters, Model):
            words += f", and the sensors are {', '.join(map(repr, parameters.sensors))}"
        raise ValueError(
            f"Argument `{name}` must take nodes out of a model, such as "
            "`lambda model: (model.body, model.time_scale)`, whole and as they are, no entry nor "
            f"something computed from them, as `print(model)` lists them, but: {words}"
        ) from error
    chosen = jax.tree.map(lambda leaf, x: x and eqx.is_inexact_array(leaf), parameters, chosen)
    if not any(jax.tree.leaves(chosen)):
        raise ValueError(f"Argument `{name}` must choose a floating-point leaf, but chooses none.")
    return chosen
