"""Work and precision: the time that each method takes for attitudes of a given accuracy.

Beside the library's methods stand two adaptive Runge-Kutta methods.
"""

import timeit
from functools import partial
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import GENERIC, R0, euler_equations, hat
from .methods import FORCED

SPAN, SAMPLES = 20.0, 100
PI0 = GENERIC @ np.array([0.7, -0.4, 0.5])
TIMES = np.linspace(0, SPAN, SAMPLES + 1)
TARGETS = 1e-3, 1e-6, 1e-9
OFFSET, POSITION = np.array([0.1, 0.2, 1.0]), np.array([1.0, 0.5, -0.7])
BODY = lgvi.RigidBody(jnp.asarray(GENERIC))
# Steps between two samples.
COUNTS = [1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 64, 128, 256]


class System(NamedTuple):
    torque: lgvi.AbstractTorque | None
    methods: dict[str, dict]


FREE = {f"order {order}": {"order": order} for order in (2, 4, 6, 8, 10, 12)}
SYSTEMS = {
    "free": System(None, FREE),
    "pendulum": System(lgvi.UniformGravity(1.3, OFFSET, 1.0), FORCED),
    "gravity gradient": System(lgvi.GravityGradient(0.5, POSITION, GENERIC), FORCED),
}


def error(Rs, exact):
    """Largest angle to the exact attitudes, rad."""
    return np.max(np.linalg.norm(np.asarray(Rs) - exact, axis=(1, 2))) / np.sqrt(2)


def variational(system, settings, count):
    integrator = lgvi.MoserVeselovIntegrator(SPAN / SAMPLES / count, throw=False, **settings)
    simulate = partial(integrator.simulate, steps=count * SAMPLES, save_every=count)
    return jax.jit(lambda pi0: simulate(BODY, R0, pi0, torque=system.torque).R)


def adaptive(system, solver):
    inverse, axes = jnp.asarray(np.linalg.inv(GENERIC)), jnp.asarray([hat(e) for e in np.eye(3)])

    def rates(t, state, _):
        R, pi = state
        omega = inverse @ pi
        torque = 0.0 if system.torque is None else system.torque(t, R)
        return R @ jnp.tensordot(omega, axes, 1), jnp.cross(pi, omega) + torque

    @jax.jit
    def run(pi0, tolerance):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(rates),
            solver,
            0.0,
            SPAN,
            0.01,
            (jnp.asarray(R0), pi0),
            saveat=diffrax.SaveAt(ts=jnp.asarray(TIMES)),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=100_000,
        )
        assert solution.ys is not None
        return solution.ys[0]

    return run


def least_time(run, *arguments, repeat=50):
    times = timeit.repeat(lambda: jax.block_until_ready(run(*arguments)), repeat=repeat, number=1)
    return min(times)


def write(line, name, times):
    cells = (f"{1e3 * time:9.3f}" if time is not None else f"{'-':>9}" for time in times)
    line(f"{name:42} {' '.join(cells)} ms")


@pytest.mark.parametrize("name", SYSTEMS)
def test_time_for_an_accuracy(line, once, name):
    targets = TARGETS[:1] if once else TARGETS
    system, pi0 = SYSTEMS[name], jnp.asarray(PI0)
    torque = None if system.torque is None else eqx.filter_jit(system.torque)
    given = None if torque is None else lambda t, R, omega: np.asarray(torque(t, R))
    exact = euler_equations(R0, PI0, GENERIC, TIMES, given)[0]
    line(f"{name + ', error in rad over 20 s:':42} {' '.join(f'{x:9.0e}' for x in targets)}")
    best = {}
    for method, settings in system.methods.items():
        times = dict.fromkeys(targets)
        for count in COUNTS:
            run = variational(system, settings, count)
            reached = error(run(pi0), exact)
            for target in targets:
                if times[target] is None and reached <= target:
                    times[target] = least_time(run, pi0)
            if None not in times.values():
                break
        write(line, method, times.values())
        best[method] = times
    for solver in (diffrax.Tsit5(), diffrax.Dopri8()):
        run, times = adaptive(system, solver), dict.fromkeys(targets)
        for tolerance in np.logspace(-2, -13, 45):
            if None not in times.values():
                break
            reached = error(run(pi0, tolerance), exact)
            for target in targets:
                if times[target] is None and reached <= target:
                    times[target] = least_time(run, pi0, tolerance)
        write(line, type(solver).__name__, times.values())
        best[type(solver).__name__] = times
    if name == "free" and not once:
        ratio = min(best["Tsit5"][1e-9], best["Dopri8"][1e-9]) / best["order 8"][1e-9]
        line(f"{'better of both / order 8 at 1e-9 rad':42} {ratio:9.1f}            >= 8")
