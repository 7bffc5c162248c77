"""What an identification is given: checked, and put together."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..modules.convergence_error import attitude_tolerance
from ..modules.integrator import MoserVeselovIntegrator
from .data.recordings import Recordings
from .model.model import Model
from .model.states import InitialStates, state_leaves


def in_one_precision(parameters: Any) -> Any:
    """Parameters, such as a model, in the default precision.

    An estimate would be rounded to the precision of its leaf in each iteration.
    """
    floats, others = eqx.partition(parameters, is_float)
    dtype = jax.dtypes.canonicalize_dtype(float)
    floats = jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf).astype(dtype)), floats)
    return eqx.combine(floats, others)


def as_arrays(parameters: Any) -> Any:
    """Parameters with arrays for floats, as these are in dictionaries and other containers.

    A module's own floats stay as they are: an Equinox module has arrays where it can be learned.
    """

    def is_module(node: Any) -> bool:
        return isinstance(node, eqx.Module)

    return jax.tree.map(
        lambda node: jnp.asarray(node) if isinstance(node, (float, np.floating)) else node,
        parameters,
        is_leaf=is_module,
    )


def is_float(leaf: Any) -> bool:
    """Whether a leaf is an array of real numbers."""
    return eqx.is_array(leaf) and jnp.issubdtype(leaf.dtype, jnp.floating)


def require_instance(name: str, value: Any, kind: type) -> None:
    if not isinstance(value, kind):
        # An array, or a module of many leaves, would fill the screen.
        was = repr(value)
        was = was if len(was) < 80 else f"of the type `{type(value).__name__}`"
        raise TypeError(f"Argument `{name}` must be `{kind.__name__}`, but is {was}.")


def require_key(name: str, value: Any) -> None:
    """A random key of JAX: typed, or of the older kind, two integers."""
    typed = isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key)
    older = isinstance(value, (jax.Array, np.ndarray)) and value.dtype == np.uint32
    if not (typed and value.shape == ()) and not (older and value.shape == (2,)):
        raise TypeError(
            f"Argument `{name}` must be a random key, as `jax.random.key` makes it, but is "
            f"{value!r}."
        )


def require_parts(parts: Any) -> None:
    """Check the configurations of a joint fit."""
    if not isinstance(parts, Mapping) or not parts:
        raise TypeError(
            "Argument `parts` must be a mapping of names to pairs of a function, which gives a "
            f"`Model`, and recordings, with one at least, but is {parts!r}."
        )
    for name, part in parts.items():
        if not isinstance(name, str):
            raise TypeError(f"Argument `parts` must have names that are strings, but has {name!r}.")
        pair = part if isinstance(part, tuple) and len(part) == 2 else (None, None)
        if not callable(pair[0]) or not isinstance(pair[1], Recordings):
            raise TypeError(
                f"Argument `parts` must have a pair of a function and `Recordings` for each name, "
                f"but for {name!r} has {part!r}."
            )


def require_starts(
    starts: Mapping[str, InitialStates] | None, parts: Mapping[str, tuple[Model, Recordings]]
) -> list[InitialStates | None]:
    """The initial states of each configuration, None where they are not given."""
    starts = {} if starts is None else starts
    if not isinstance(starts, Mapping):
        raise TypeError(
            "Argument `starts` must be a mapping of names of parts to initial states, but is "
            f"{starts!r}."
        )
    for name, states in starts.items():
        if name not in parts:
            raise ValueError(f"Argument `starts` must have names of parts, but has {name!r}.")
        require_states(f"starts[{name!r}]", states, *parts[name])
        require_rotations(f"starts[{name!r}]", states)
    return [starts.get(name) for name in parts]


def scalar_step(integrator: MoserVeselovIntegrator) -> float:
    """The longest step, s, of an argument `integrator`."""
    require_instance("integrator", integrator, MoserVeselovIntegrator)
    dt = integrator.dt
    if dt is None or dt.ndim:
        what = "it is None" if dt is None else f"its shape is {dt.shape}"
        raise ValueError(
            f"Argument `integrator` must have a scalar `dt`, the longest step, but {what}."
        )
    if not 0 < float(dt) < np.inf:
        raise ValueError(
            "Argument `integrator` must have a `dt` above 0 s, the longest step, but it is "
            f"{float(dt)}."
        )
    return float(dt)


def require_states(name: str, states: InitialStates, model: Model, recordings: Recordings) -> None:
    require_instance(name, states, InitialStates)
    count, shapes = len(recordings), (states.R.shape, states.omega.shape)
    if shapes != ((count, 3, 3), (count, 3)):
        raise ValueError(
            f"Argument `{name}` must have the states of {count} trajectories, but its shapes are "
            f"{shapes[0]} and {shapes[1]}."
        )
    if states.own is None:
        return
    own, shape = state_leaves(model), np.shape(states.own)
    if own is None:
        raise ValueError(
            f"Argument `{name}` must have None as `own`, as nothing in the model has a state, "
            f"but the shape of `own` is {shape}."
        )
    numbers = sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(model, own)))
    if shape != (count, numbers):
        raise ValueError(
            f"Argument `{name}` must have `own` of shape {(count, numbers)}, the states of sensors "
            f"and rotors, or None, but its shape is {shape}."
        )


def require_rotations(name: str, states: InitialStates) -> None:
    R = np.asarray(states.R, float)
    error = np.max(np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)))
    if not error <= attitude_tolerance(jax.dtypes.canonicalize_dtype(float)):
        raise ValueError(
            f"Argument `{name}` must have rotation matrices `R`, but R^T R - I has an entry of "
            f"{error:.2g}."
        )
    if not np.all(np.isfinite(states.omega)):
        raise ValueError(f"Argument `{name}` must have finite `omega`, but an entry is not.")
    if states.own is not None and not np.all(np.isfinite(states.own)):
        raise ValueError(f"Argument `{name}` must have finite `own`, but an entry is not.")
