"""The exact motion at many times, beside steps: per time, in us, and what is compiled for it."""

from time import perf_counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import GENERIC, R0, rng

TIMES, BODIES, DT = 20_000, 10_000, 0.05
PI0 = jnp.asarray(GENERIC @ np.array([0.5, 1.0, 1.5]))
WEIGHTS = jnp.asarray(rng(41).normal(size=(TIMES, 3, 3)))


def exact(J, pi0):
    return lgvi.free_motion(lgvi.RigidBody(J), R0, pi0, DT * jnp.arange(TIMES))[0]


def stepped(J, pi0):
    integrator = lgvi.MoserVeselovIntegrator(DT, order=8)
    return integrator.simulate(lgvi.RigidBody(J), R0, pi0, steps=TIMES - 1).R


def weighted(attitudes):
    return lambda J, pi0: jnp.sum(WEIGHTS * attitudes(J, pi0))


PROGRAMS = {
    "value": lambda attitudes: attitudes,
    "value and gradient in pi0": lambda attitudes: jax.value_and_grad(weighted(attitudes), 1),
    "value and gradient in J, pi0": lambda attitudes: jax.value_and_grad(
        weighted(attitudes), (0, 1)
    ),
}


@pytest.mark.parametrize("what", PROGRAMS)
@pytest.mark.parametrize("attitudes", [exact, stepped])
def test_many_times_of_one_body(clock, line, attitudes, what):
    name, arguments = f"{attitudes.__name__}: {what}", (jnp.asarray(GENERIC), PI0)
    start = perf_counter()
    program = jax.jit(PROGRAMS[what](attitudes)).lower(*arguments).compile()
    seconds = perf_counter() - start
    time = clock(name, program, TIMES, *arguments)
    line(f"{name:42} {1e6 * time:11.3f}   compiled in {seconds:.1f} s")


def test_one_time_of_many_bodies(clock, line):
    Js = jnp.asarray(GENERIC * np.linspace(1, 2, BODIES)[:, None, None])
    run = jax.jit(jax.vmap(lambda J: lgvi.free_motion(lgvi.RigidBody(J), R0, PI0, 3.0)))
    time = clock("exact: one time of many bodies", run, BODIES, Js)
    line(f"{'exact: one time of 10,000 bodies':42} {1e6 * time:11.3f}")
