"""A fit by one process and by two, each on a core of its own: times of iterations, and of a gather.

Processes learn of one another when JAX starts, so all are measured in processes of their own.
"""

from time import perf_counter
from typing import Any

import jax
import numpy as np

import lgvi
from lgvi.identification import InitialStates, Model, identify, simulate_recordings
from lgvi.identification.running.processes import ProcessGroup

from ..processes import run_together
from .tosses import directions

TRAJECTORIES, SAMPLES = 256, 1000
GATHERS = 200


def measure(trajectories: int) -> dict[str, float]:
    """Seconds of a fit of so many trajectories of this process, and of a gather."""
    process, count = jax.process_index(), jax.process_count()
    mesh = jax.make_mesh((count,), ("windows",))
    sensor, random = lgvi.AttitudeSensor(1e-3), np.random.default_rng(process)
    model = Model(lgvi.PhysicalRigidBody.from_principal_moments([0.2, 0.35, 0.45]), sensor)
    omega = directions(random, trajectories) * random.uniform(1, 2, (trajectories, 1))
    states = InitialStates.from_rates(omega)
    recordings = simulate_recordings(
        model, np.arange(SAMPLES) * 0.02, states, key=jax.random.key(process)
    )
    start = Model(sensor)
    identify(start, recordings, mesh=mesh)
    begin = perf_counter()
    estimate = identify(start, recordings, mesh=mesh)
    fitted = perf_counter()
    processes = ProcessGroup(count)
    for _ in range(GATHERS):
        processes.gather(np.eye(7))
    gathered = perf_counter()
    return {
        "fit": fitted - begin,
        "iterations": estimate.iterations,
        "gather": (gathered - fitted) / GATHERS,
    }


def measure_by(count: int, trajectories: int) -> dict[str, Any]:
    """The same of the first of some processes, which have so many trajectories each."""
    module, call = "tests.benchmarks.bench_hosts", f"measure({trajectories})"
    return run_together(count, module, call, one_core=True)[0]


def test_hosts(line):
    one, two = measure_by(1, TRAJECTORIES), measure_by(2, TRAJECTORIES // 2)
    four = measure_by(4, 4)
    name = f"fit of {TRAJECTORIES} trajectories of {SAMPLES} attitudes, one process"
    line(f"{name + ', ms per iteration':72} {1e3 * one['fit'] / one['iterations']:7.1f}")
    line(f"{'two processes with half of them each / one':72} {two['fit'] / one['fit']:7.2f}")
    for count, found in (("two", two), ("four", four)):
        line(f"{f'gather by {count} processes, ms':72} {1e3 * found['gather']:7.1f}")
