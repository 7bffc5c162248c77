"""Windows on several devices, each of which has some and tells the others nothing."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, PartitionSpec
from jaxtyping import Array


def as_mesh(mesh: Any) -> Mesh | None:
    """The devices of this process in a mesh, along one axis; None for its first device alone.

    Raises
    ------
    TypeError
        If it is something else.
    """
    if mesh is None:
        return None
    if not isinstance(mesh, Mesh):
        raise TypeError(
            "Argument `mesh` must be a `jax.sharding.Mesh`, such as "
            f'`jax.make_mesh((jax.device_count(),), ("windows",))`, or None, but is {mesh!r}.'
        )
    own = [each for each in np.ravel(mesh.devices) if each.process_index == jax.process_index()]
    if own == jax.local_devices()[:1]:  # where everything is computed without a mesh
        return None
    return Mesh(np.array(own), ("windows",), axis_types=(AxisType.Auto,))


def on_devices(
    function: Callable[..., Any], axes: Sequence[int | None], mesh: Mesh | None
) -> Callable[..., Any]:
    """A function of windows side by side, along `axes` of its arguments, of a part on each device.

    None are arguments that all windows share.
    """
    if mesh is None:
        return function
    parts, whole = PartitionSpec("windows"), PartitionSpec()
    given = tuple(whole if axis is None else parts for axis in axes)
    # The decomposition of a table is a call of LAPACK, which JAX would gather on one device.
    return jax.shard_map(function, mesh=mesh, in_specs=given, out_specs=parts, check_vma=False)


def triangularise(tables: Array | np.ndarray, mesh: Mesh | None) -> Array:
    """The triangles of QR decompositions of tables (windows, rows, columns), on one of the devices.

    As a batch they use all cores of a CPU; such calls of several devices of a CPU wait for one
    another for ever (jaxlib 0.10). Those make them one by one, each for itself.
    """

    def triangle(table: Array) -> Array:
        return jnp.linalg.qr(table, mode="r")

    tables = jnp.asarray(tables)
    on_cores = mesh is not None and mesh.devices.flat[0].platform == "cpu"
    return jax.lax.map(triangle, tables) if on_cores else triangle(tables)


def count_devices(mesh: Mesh | None) -> int:
    """Number of devices."""
    return 1 if mesh is None else mesh.size
