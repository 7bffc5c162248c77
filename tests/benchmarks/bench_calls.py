"""What a short call costs, by the functions and through Equinox: medians of many calls, us.

How JAX starts programs is set before its first, so both ways are measured in processes.
"""

import json
import sys
import timeit

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..processes import run_module
from ..systems import GENERIC, R0

CALLS = 2000


def median(run, *arguments) -> float:
    jax.block_until_ready(run(*arguments))
    times = timeit.repeat(lambda: jax.block_until_ready(run(*arguments)), number=1, repeat=CALLS)
    return 1e6 * float(np.median(times))


def measure() -> dict[str, float]:
    R, J, pi0 = jnp.asarray(R0), jnp.asarray(GENERIC), jnp.asarray(GENERIC @ [0.5, 1.0, 1.5])
    body, integrator = lgvi.RigidBody(J), lgvi.MoserVeselovIntegrator(dt=0.05)
    found = {"an empty program": median(jax.jit(lambda R, pi0, J: R + J), R, pi0, J)}
    for steps in (1, 10, 100):
        free = jax.jit(
            lambda R, pi0, J, steps=steps: lgvi.simulate_free_rigid_body(R, pi0, J, 0.05, steps)
        )
        found[f"functions, {steps} steps"] = median(free, R, pi0, J)

    def simulate(integrator, body, R, pi0):
        return integrator.simulate(body, R, pi0, steps=100)

    def by_method(integrator, body, R, pi0):
        return eqx.filter_jit(integrator.simulate)(body, R, pi0, steps=100)

    for name, run in {
        "modules, jax.jit": jax.jit(simulate),
        "modules, eqx.filter_jit": eqx.filter_jit(simulate),
        "eqx.filter_jit(integrator.simulate)": by_method,
    }.items():
        found[f"{name}, 100 steps"] = median(run, integrator, body, R, pi0)
    return found


@pytest.mark.parametrize("dispatch", ["asynchronous", "synchronous"])
def test_calls(line, dispatch):
    times, _ = run_module("tests.benchmarks.bench_calls", dispatch)
    line(f"{dispatch} dispatch:")
    for name, time in times.items():
        is_wanted = dispatch == "synchronous" and name.startswith("functions")
        wanted = "<= 30 us" if is_wanted else ""
        line(f"{name:46} {time:7.1f} us          {wanted}".rstrip())


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_cpu_enable_async_dispatch", sys.argv[1] == "asynchronous")
    print(json.dumps(measure()))
