"""What is learned, and what is not."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax

Tree = TypeVar("Tree")


def freeze(model: Tree, where: Callable[[Tree], Any]) -> tuple[Tree, Tree]:
    """Split a model into what is learned and what is not; `eqx.combine` puts them together again.

    An optimiser that is given zeros as the gradient of a leaf may move it all the same, for example
    by weight decay. It does not see what is fixed.

    Parameters
    ----------
    model
        Any pytree, such as a body, or a larger model with a body and an integrator.
    where
        What is not learned: a function that takes a part out of the model, or several as a tuple,
        such as `lambda model: model.integrator.dt`.

    Returns
    -------
    learned : the type of the model
        The other leaves that are floating-point arrays, and None elsewhere.
    fixed : the type of the model
        The rest, and None where `learned` has an array.

    Raises
    ------
    ValueError, TypeError
        If `where` is not a function, or takes something that is not a part of the model.
    """
    if not callable(where):
        raise TypeError(
            "Argument `where` must be a function that takes parts out of a model, such as "
            f"`lambda model: model.integrator`, but is {where!r}."
        )
    try:
        rest = eqx.tree_at(where, model, replace_fn=lambda _: False, is_leaf=lambda x: x is None)
    except Exception as error:
        raise ValueError(
            "Argument `where` must take parts out of a model, whole and as they are, such as "
            f"`lambda model: (model.integrator, model.body)`, but: {error}"
        ) from error
    return eqx.partition(model, jax.tree.map(eqx.is_inexact_array, rest))
