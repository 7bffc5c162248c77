"""The compilation of programs, and the devices of programs.

Programs that compute little are compiled quickly, by options of XLA, not of JAX. Options that XLA
does not know are left out.
"""

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.sharding import AxisType, Mesh, PartitionSpec

from .progress import say_compiling, show_program

Result = TypeVar("Result")

# The older kernels: as fast for these programs, and compiled in two thirds of the time.
OPTIMISED = {"xla_cpu_use_fusion_emitters": False}
# Without optimisation: compiled in a quarter of the time, for programs that compute little.
QUICK = OPTIMISED | {"xla_backend_optimization_level": 0}
NO_MESH = Mesh(np.empty((), object), ())


def compiled(what: str) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """As `eqx.filter_jit`; compiled quickly unless the keyword `optimised` is True.

    The progress bar tells that `what`, the result of the function in words, is compiled.

    The devices are those of an argument: `jax.set_mesh` would run each program on all devices.
    """

    def decorate(function: Callable[..., Result]) -> Callable[..., Result]:
        @wraps(function)
        def traced(*arguments) -> Result:  # Python runs this only to compile a program
            say_compiling(what)
            return function(*arguments)

        @cache
        def program(optimised: bool):
            options: Any = {}
            if _known():
                options["compiler_options"] = OPTIMISED if optimised else QUICK
            return eqx.filter_jit(traced, **options)

        @wraps(function)
        def call(*arguments, optimised: bool = False) -> Result:
            with show_program(), jax.set_mesh(NO_MESH):
                return program(optimised)(*arguments)

        return call

    return decorate


@cache
def _known() -> bool:
    """Whether XLA knows the options on this machine, by one trial of all options."""
    if jax.default_backend() != "cpu":
        return False
    try:
        jax.jit(lambda: 0.0, compiler_options={**QUICK}).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def as_mesh(mesh: Any) -> Mesh | None:
    """The devices of this process in a mesh, along one axis; None for its first device alone.

    Raises
    ------
    TypeError
        If `mesh` is something else.
    """
    if mesh is None:
        return None
    if not isinstance(mesh, Mesh):
        raise TypeError(
            "Argument `mesh` must be a `jax.sharding.Mesh`, such as "
            f'`jax.make_mesh((jax.device_count(),), ("windows",))`, or None, but is {mesh!r}.'
        )
    local = [device for device in mesh.devices.flat if device.process_index == jax.process_index()]
    if local == jax.local_devices()[:1]:  # where everything is computed without a mesh
        return None
    return Mesh(np.array(local), ("windows",), axis_types=(AxisType.Auto,))


def on_devices(function: Callable[..., Any], mesh: Mesh | None) -> Callable[..., Any]:
    """A function of segments side by side, with a part of the segments on each device."""
    if mesh is None:
        return function
    parts = PartitionSpec("windows")
    return jax.shard_map(function, mesh=mesh, in_specs=parts, out_specs=parts, check_vma=False)


def count_devices(mesh: Mesh | None) -> int:
    """Number of devices."""
    return 1 if mesh is None else mesh.size
