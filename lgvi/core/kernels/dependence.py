"""What the results of a function depend on, by following its operations.

A derivative that is zero by chance does not mislead.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import Jaxpr
from jaxtyping import Array


def operations_of(function: Callable[..., Any], *arguments: Array | np.ndarray) -> Jaxpr:
    """The operations of a function of arrays, of which only shapes and types are used."""
    examples = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arguments]
    return jax.make_jaxpr(function)(*examples).jaxpr


def reached(jaxpr: Jaxpr, inputs: Sequence[int]) -> list[bool]:
    """Whether each result depends on one of some arguments, which are numbered."""
    variables = {id(jaxpr.invars[i]) for i in inputs}
    for operation in jaxpr.eqns:
        if any(id(x) in variables for x in operation.invars):
            variables.update(map(id, operation.outvars))
    return [id(x) in variables for x in jaxpr.outvars]
