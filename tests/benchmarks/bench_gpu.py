"""Batches of bodies on the device that JAX has, a GPU or the cores of a CPU.

Steps a second, memory, and the part of the speed of the device's memory that storing trajectories
takes; values and gradients; exact motions. Compiled programs say how much memory they need.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import GENERIC, R0, rng
from .bench_work_precision import least_time

BODIES = 10**3, 10**4, 10**5, 10**6
WORK = 10**7  # bodies times steps of a call
STORED = 20  # steps, of which all are stored
DT, CALLS = 0.05, 5


def bodies(count, dtype):
    """Factors of the inertia and momenta."""
    random = rng(240, count)
    numbers = random.uniform(0.9, 1.1, count), random.uniform(0.5, 1.5, (count, 3))
    return jax.device_put(tuple(x.astype(dtype) for x in numbers))


def simulate(factor, pi0, steps, save_every):
    body = lgvi.RigidBody(factor * jnp.asarray(GENERIC, factor.dtype))
    integrator = lgvi.MoserVeselovIntegrator(jnp.asarray(DT, factor.dtype), throw=False)
    start = jnp.asarray(R0, factor.dtype)
    return integrator.simulate(body, start, pi0, steps=steps, save_every=save_every).R


def last_of(factor, pi0, steps):
    return jnp.sum(simulate(factor, pi0, steps, steps)[-1] * jnp.asarray(R0, factor.dtype))


def exact(factor, pi0, times):
    body = lgvi.RigidBody(factor * jnp.asarray(GENERIC, factor.dtype))
    return lgvi.free_motion(body, jnp.asarray(R0, factor.dtype), pi0, times)[0]


def measure(function, arguments):
    """The least time of a call, s, and the memory of the program with its results, bytes."""
    run = jax.jit(jax.vmap(function)).lower(*arguments).compile()
    jax.block_until_ready(run(*arguments))
    time = least_time(run, *arguments, repeat=CALLS)
    memory = run.memory_analysis()
    assert memory is not None
    return time, memory.temp_size_in_bytes + memory.output_size_in_bytes


def copying_speed(size):
    """Bytes read and written a second when an array of so many bytes is copied."""
    array = jnp.zeros(size // 8)
    run = jax.jit(lambda x: x + 1)
    jax.block_until_ready(run(array))
    return 2 * size / least_time(run, array, repeat=CALLS)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_batches_on_the_device(line, once, dtype):
    device, speed = jax.devices()[0], copying_speed(10**6 if once else 10**9)
    line(f"{device.device_kind}, {np.dtype(dtype)}; copies {speed / 1e9:.1f} GB/s")
    line(f"{'':10} {'million steps/s':>16} {'with gradient':>16} {'MB':>8} {'MB':>8}   stored: ")
    for count in BODIES[:1] if once else BODIES:
        steps = 10 if once else max(10, WORK // count)
        arguments = bodies(count, dtype)
        forward, memory = measure(partial(last_of, steps=steps), arguments)
        gradient = jax.value_and_grad(partial(last_of, steps=steps), (0, 1))
        both, memory_both = measure(gradient, arguments)
        stored, memory_stored = measure(partial(simulate, steps=STORED, save_every=1), arguments)
        motion, _ = measure(
            partial(exact, times=jnp.linspace(0, 1, STORED, dtype=dtype)), arguments
        )
        attitudes = count * STORED * 9 * np.dtype(dtype).itemsize
        line(
            f"{count:10,} {count * steps / forward / 1e6:16.1f} {count * steps / both / 1e6:16.1f} "
            f"{memory / 1e6:8.1f} {memory_both / 1e6:8.1f}   "
            f"{count * STORED / stored / 1e6:.1f} million steps/s, {memory_stored / 1e6:.1f} MB, "
            f"{attitudes / stored / speed:.0%} of the speed of memory; exact motion: "
            f"{count * STORED / motion / 1e6:.1f} million attitudes/s"
        )
