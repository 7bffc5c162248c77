"""Processes that fit together, and the exchange of values between the processes."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cache, reduce
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec


class ProcessGroup(NamedTuple):
    """A number of processes, with different windows; by default a single process.

    All processes call the same methods in the same order, with different values, and get results
    that are equal to the last bit, so that all processes decide alike.
    """

    number: int = 1

    @classmethod
    def of(cls, mesh: Any) -> "ProcessGroup":
        """The processes with devices in a mesh; one process without a mesh, or with local devices.

        Raises
        ------
        ValueError
            If the mesh has devices of other processes, but not of all processes, or no devices.
        """
        if mesh is None:
            return cls()
        processes = {device.process_index for device in np.ravel(mesh.devices)}
        if not processes:
            raise ValueError("Argument `mesh` must have a device, but is empty.")
        if processes == {jax.process_index()}:
            return cls()
        if len(processes) != jax.process_count():
            raise ValueError(
                "Argument `mesh` must have devices of this process alone, or of all "
                f"{jax.process_count()} processes, but has those of the processes "
                f"{', '.join(map(str, sorted(processes)))}."
            )
        return cls(len(processes))

    @property
    def are_several(self) -> bool:
        """Whether there is another process."""
        return self.number > 1

    def gather(self, values: Any) -> np.ndarray:
        """The values of all processes (processes, ...), which have one shape.

        Raises
        ------
        ConnectionError
            If another process has ended, or the exchange failed for another reason.
        """
        values = np.asarray(values)
        if not self.are_several:
            return values[None]
        sharding, replicate = _replication(self.number)
        data = np.frombuffer(values.tobytes(), np.uint8)  # JAX may have no double precision
        try:
            parts = jax.make_array_from_process_local_data(sharding, data[None])
            rows = np.asarray(replicate(parts).addressable_data(0))
        except (ValueError, RuntimeError) as error:
            raise ConnectionError(
                "Another process of the fit has ended, or the exchange with it failed."
            ) from error
        return np.frombuffer(rows.tobytes(), values.dtype).reshape(self.number, *values.shape)

    @contextmanager
    def checked(self) -> Iterator[None]:
        """A context in which arguments are checked: an error in one process ends all processes."""
        try:
            yield
        except Exception:
            self.any(True)
            raise
        if self.any(False):
            raise ValueError("Another process refused its arguments: its own output has the error.")

    def sum(self, values: Any) -> np.ndarray:
        """The sum over processes."""
        return reduce(np.add, self.gather(values))

    def largest(self, value: float) -> float:
        """The largest value of the processes."""
        return np.max(self.gather(value)).item()

    def smallest(self, value: float) -> float:
        """The smallest value of the processes."""
        return np.min(self.gather(value)).item()

    def any(self, value: bool) -> bool:
        """Whether `value` is True in a process."""
        return bool(self.largest(value))

    def of_first(self, values: Any) -> np.ndarray:
        """The values of the first process, as other processors may round otherwise."""
        return self.gather(values)[0]

    def stack(self, values: np.ndarray) -> np.ndarray:
        """The values of all processes in sequence; sizes may differ, and are padded by zeros.

        The first axis is not padded.
        """
        if not self.are_several:
            return values
        shapes = self.gather(np.array(values.shape))
        missing = np.max(shapes, axis=0) - values.shape
        padded = np.pad(values, [(0, size) for size in missing])
        arrays = self.gather(padded)
        return np.concatenate([x[:count] for x, count in zip(arrays, shapes[:, 0], strict=True)])

    def names(self, names: Iterable[str]) -> list[str]:
        """The names that all processes give, one process after another."""
        text = "\0".join(names).encode()
        letters = self.stack(np.frombuffer(text + b"\0", np.uint8))
        return [name for name in letters.tobytes().decode().split("\0") if name]


SINGLE_PROCESS = ProcessGroup()


@cache
def _replication(number: int) -> tuple[NamedSharding, Callable[..., Any]]:
    """The sharding of arrays with a row for each process, and a function that replicates them."""
    first = {device.process_index: device for device in reversed(jax.devices())}
    mesh = Mesh(np.array([first[process] for process in range(number)]), ("processes",))
    by_process, by_all = (NamedSharding(mesh, PartitionSpec(*axes)) for axes in (["processes"], []))
    return by_process, jax.jit(lambda rows: rows, out_shardings=by_all)
