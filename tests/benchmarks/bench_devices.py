"""A batch on the cores of a CPU as one device and as two, in small and in huge pages of memory.

Least times of some calls. Devices and pages are chosen when a process starts, so each is measured
in one of its own.
"""

import json
import sys
import timeit
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import lgvi

from ..processes import run_module
from ..systems import GENERIC, R0

SIZES = {1000: 200, 100_000: 50}  # steps for each number of bodies
CALLS = 9
HUGE_PAGES = {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}  # of the C library of Linux


def attitudes(factor, pi0, steps):
    return lgvi.simulate_free_rigid_body(R0, pi0, factor * GENERIC, 0.05, steps)[0]


def scalar(factor, pi0, steps):
    return jnp.sum(attitudes(factor, pi0, steps) * jnp.asarray(R0))


def measure(sizes: dict[int, int], calls: int) -> dict[str, float]:
    """Microseconds for each body and step, the least of some calls."""
    mesh = jax.make_mesh((jax.device_count(),), ("batch",), axis_types=(AxisType.Auto,))
    along = NamedSharding(mesh, PartitionSpec("batch"))
    found = {}
    for bodies, steps in sizes.items():
        random = np.random.default_rng(0)
        factors, pi0s = random.uniform(0.9, 1.1, bodies), random.uniform(0.5, 1.5, (bodies, 3))
        arguments = jax.device_put((factors, pi0s), along)
        for name, function in {
            "trajectories": attitudes,
            "value and gradient": jax.value_and_grad(scalar, (0, 1)),
        }.items():
            run = jax.jit(jax.vmap(partial(function, steps=steps)))
            jax.block_until_ready(run(*arguments))
            least = min(
                timeit.repeat(
                    lambda run=run, given=arguments: jax.block_until_ready(run(*given)),
                    number=1,
                    repeat=calls,
                )
            )
            found[f"{bodies:,} bodies, {name}"] = 1e6 * least / (bodies * steps)
    return found


def measure_on(devices: int, *arguments: str, **variables: str) -> dict[str, float]:
    flags = f"--xla_force_host_platform_device_count={devices}"
    found, _ = run_module(
        "tests.benchmarks.bench_devices",
        *arguments,
        JAX_PLATFORMS="cpu",
        XLA_FLAGS=flags,
        **variables,
    )
    return found


def test_devices_and_pages(line, once):
    given = ["once"] if once else []
    small, huge = ([measure_on(n, *given, **pages) for n in (1, 2)] for pages in ({}, HUGE_PAGES))
    columns = "1 device", "2 devices", "1, huge pages", "2, huge pages"
    line(f"{'us for each body and step':38}" + "".join(f"{column:>15}" for column in columns))
    for name in small[0]:
        line(f"{name:38}" + "".join(f"{found[name]:15.3f}" for found in small + huge))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    given = ({1000: 200}, 1) if "once" in sys.argv else (SIZES, CALLS)
    print(json.dumps(measure(*given)))
