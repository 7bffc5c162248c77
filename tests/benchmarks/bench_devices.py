"""A batch on the cores of a CPU as one device and as two: least times of some calls.

The devices are made when JAX starts, so both are measured in processes.
"""

import json
import os
import subprocess
import sys
import timeit
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import lgvi

from ..systems import GENERIC, R0

ROOT = Path(__file__).parents[2]
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


def in_process(devices: int) -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, "-m", "tests.benchmarks.bench_devices"],
        cwd=ROOT,
        env=os.environ | {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}"},
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="about the cores of a CPU")
def test_devices(line):
    one, two = in_process(1), in_process(2)
    for name, seconds in two.items():
        line(f"{name + ', two devices / one':52} {seconds / one[name]:7.2f}")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(measure()))
