"""Programs that run a few dozen times, compiled in less time than others.

XLA's options for that are its own, not JAX's. Where it does not know them they are left out.
"""

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh

from .progress import say_compiling, show_program

Result = TypeVar("Result")

# Kernels in the old way: as fast for these programs, and compiled in two thirds of the time.
QUICK = {"xla_cpu_use_fusion_emitters": False}
# Without optimisation, in a quarter of the time: worth it where there is little to compute.
QUICKEST = QUICK | {"xla_backend_optimization_level": 0}
NO_MESH = Mesh(np.empty((), object), ())


def compiled(what: str) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """As `eqx.filter_jit`; a keyword `few` says that there is little to compute.

    Who waits is told `what` is compiled: what the function computes, in words.

    Devices are those of an argument: the mesh of `jax.set_mesh` would give each program to all.
    """

    def decorate(function: Callable[..., Result]) -> Callable[..., Result]:
        @wraps(function)
        def traced(*arguments) -> Result:  # Python runs this only to compile a program
            say_compiling(what)
            return function(*arguments)

        @cache
        def program(few: bool):
            options: Any = {"compiler_options": (QUICKEST if few else QUICK) if _known() else None}
            return eqx.filter_jit(traced, **options)

        @wraps(function)
        def call(*arguments, few: bool) -> Result:
            with show_program(), jax.set_mesh(NO_MESH):
                return program(few)(*arguments)

        return call

    return decorate


@cache
def _known() -> bool:
    """Whether XLA knows the options here: one trial of all of them."""
    if jax.default_backend() != "cpu":
        return False
    try:
        jax.jit(lambda: 0.0, compiler_options={**QUICKEST}).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
