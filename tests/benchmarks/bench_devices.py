"""A batch on the cores of a CPU as one device and as two: least times of some calls.

The devices are made when JAX starts, so both are measured in processes.
"""

import json
import timeit

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import lgvi

from ..processes import run_module
from ..systems import GENERIC, R0

STEPS = 200
CALLS = 15


def attitudes(factor, pi0):
    return lgvi.simulate_free_rigid_body(R0, pi0, factor * GENERIC, 0.05, STEPS)[0]


def scalar(factor, pi0):
    return jnp.sum(attitudes(factor, pi0) * jnp.asarray(R0))


def measure() -> dict[str, float]:
    """Seconds of a call."""
    mesh = jax.make_mesh((jax.device_count(),), ("batch",), axis_types=(AxisType.Auto,))
    along = NamedSharding(mesh, PartitionSpec("batch"))
    found = {}
    for bodies in (1000, 8000):
        random = np.random.default_rng(0)
        factors, pi0s = random.uniform(0.9, 1.1, bodies), random.uniform(0.5, 1.5, (bodies, 3))
        arguments = jax.device_put((factors, pi0s), along)
        for name, function in {
            "trajectories": attitudes,
            "value and gradient": jax.value_and_grad(scalar, (0, 1)),
        }.items():
            run = jax.jit(jax.vmap(function))
            jax.block_until_ready(run(*arguments))
            found[f"{bodies:,} bodies, {name}"] = min(
                timeit.repeat(
                    lambda run=run, given=arguments: jax.block_until_ready(run(*given)),
                    number=1,
                    repeat=CALLS,
                )
            )
    return found


def measure_on(devices: int) -> dict[str, float]:
    flags = f"--xla_force_host_platform_device_count={devices}"
    found, _ = run_module("tests.benchmarks.bench_devices", JAX_PLATFORMS="cpu", XLA_FLAGS=flags)
    return found


def test_devices(line):
    one, two = measure_on(1), measure_on(2)
    for name, seconds in two.items():
        line(f"{name + ', two devices / one':52} {seconds / one[name]:7.2f}")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(measure()))
