"""Fields of modules: learnable leaves are floating-point arrays of a known shape."""

import inspect
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from ..core.typed_arrays import Shape, as_real


def float_array(name: str) -> Callable[[ArrayLike], Array]:
    """Field converter: numbers, lists and integer arrays become floating-point arrays.

    A Python number becomes a weakly typed array: it takes the precision of other operands.
    """

    def convert(value: ArrayLike) -> Array:
        array = as_real(name, value)
        if jnp.issubdtype(array.dtype, jnp.inexact):
            return array
        return jnp.asarray(float(value)) if isinstance(value, int) else array.astype(float)

    return convert


def described_by(unit: str, remedy: str = "", below_zero: str = "") -> dict[str, str]:
    """Metadata of a field for reports: its unit, and a remedy that makes it observable.

    Where no number of the field, nor of the diagonal of a matrix, can be below zero, `below_zero`
    says what is usually wrong if one is estimated so.
    """
    return {"unit": unit, "remedy": remedy, "below_zero": below_zero}


def description(module: Any, path: Sequence[Any]) -> dict[str, str]:
    """Metadata of a leaf, from the last field on its path that has a `described_by`."""
    metadata: dict[str, str] = {}
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey):
            declared = getattr(module, "__dataclass_fields__", {}).get(key.name)
            if declared is not None and "unit" in declared.metadata:
                metadata = dict(declared.metadata)
            module = getattr(module, key.name)
        elif isinstance(key, jax.tree_util.DictKey):
            module = module[key.key]
        elif isinstance(key, jax.tree_util.SequenceKey):
            module = module[key.idx]
        else:
            break  # a pytree of another kind, which has no fields
    return metadata


def require_shape(name: str, value: Array, shape: Shape) -> None:
    """Check a field; values are never checked, so that modules can be built under vmap.

    Raises
    ------
    ValueError
        If the shape is wrong, naming the field, the required shape and the actual shape.
    """
    if value.shape != shape:
        raise ValueError(
            f"Argument `{name}` must have shape {shape}, but its shape is {value.shape}."
        )


def shaped_array(name: str, value: ArrayLike, shape: Shape) -> Array:
    """A floating-point array of a known shape; raises as `require_shape` and `float_array`."""
    array = float_array(name)(value)
    require_shape(name, array, shape)
    return array


Frame = Literal["body", "space"]


def require_frame(frame: str) -> None:
    """Check the name of a frame."""
    if not isinstance(frame, str) or frame not in ("body", "space"):
        raise ValueError(f'Argument `frame` must be "body" or "space", but is {frame!r}.')


Signature = tuple[str, ...]  # names of arguments
Method = TypeVar("Method", bound=Callable[[Any], Any])


def computed_from(field: str) -> Callable[[Method], Method]:
    """A property that is computed from a field, and says so where a leaf is chosen.

    `equinox.tree_at` puts objects in the place of leaves, to see which its function takes.
    """

    def decorate(method: Any) -> Any:
        @wraps(method)
        def value(self):
            leaf = getattr(self, field)
            if isinstance(leaf, bool) or not eqx.is_array_like(leaf):
                name, kind = method.__name__, type(self)
                make = "from_inertia" if hasattr(kind, "from_inertia") else "from_principal_moments"
                raise TypeError(
                    f"`{name}` of a `{kind.__name__}` is computed from `{field}`, and is no leaf "
                    f"that can be chosen or replaced: take `{field}`, or make another body by "
                    f"`{kind.__name__}.{make}`."
                )
            return method(self)

        return value

    return decorate


# Names of the arguments of laws and controllers, by the quantity that they would be taken for.
_QUANTITIES = {
    **{name: name for name in ("t", "R", "omega", "pi", "v")},
    "time": "t",
    "attitude": "R",
    "angular_velocity": "omega",
    "momentum": "pi",
    "velocity": "v",
}


def require_function(name: str, value: Any, *signatures: Signature) -> Signature:
    """The first of the given signatures with which a function can be called.

    Raises
    ------
    TypeError
        If the value is not a function, none of the signatures fits, or an argument of the
        function has the name of another quantity than it would get, naming the argument.
    """
    allowed = " or ".join(f"({', '.join(each)})" for each in signatures)
    problem = f"Argument `{name}` must be a function of {allowed}, but"
    if isinstance(value, type) or not callable(value):
        raise TypeError(f"{problem} is {value!r}.")
    try:
        accepted = inspect.signature(value)
    except ValueError:  # some builtin functions have no signature
        return signatures[0]
    reasons = []
    for signature in signatures:
        try:
            names = accepted.bind(*signature).arguments
        except TypeError as error:
            reasons.append(error)
        else:
            for argument, quantity in names.items():
                if quantity in signature and _QUANTITIES.get(argument, quantity) != quantity:
                    raise TypeError(
                        f"{problem} an argument of {value!r} is `{argument}` where `{quantity}` "
                        "is given: quantities are told by their places."
                    )
            return signature
    raise TypeError(f"{problem} is {value!r}: {reasons[-1]}.")
