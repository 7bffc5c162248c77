"""Against adaptive Runge-Kutta methods, at equal error of the attitude."""

import timeit

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import GENERIC, R0, euler_equations, hat

SPAN, SAMPLES = 20.0, 101
PI0 = GENERIC @ np.array([0.7, -0.4, 0.5])
TIMES = np.linspace(0, SPAN, SAMPLES)
EXACT = euler_equations(R0, PI0, GENERIC, TIMES)[0]
TOLERANCES = np.logspace(-1, -12, 34)


def error(Rs):
    """Largest angle to the exact attitudes, rad."""
    return np.max(np.linalg.norm(np.asarray(Rs) - EXACT, axis=(1, 2))) / np.sqrt(2)


def adaptive(solver):
    inverse, axes = jnp.asarray(np.linalg.inv(GENERIC)), jnp.asarray([hat(e) for e in np.eye(3)])

    def rates(t, state, _):
        R, pi = state
        omega = inverse @ pi
        return R @ jnp.tensordot(omega, axes, 1), jnp.cross(pi, omega)

    @jax.jit
    def run(tolerance):
        controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(rates),
            solver,
            0.0,
            SPAN,
            0.01,
            (jnp.asarray(R0), jnp.asarray(PI0)),
            saveat=diffrax.SaveAt(ts=jnp.asarray(TIMES)),
            stepsize_controller=controller,
            max_steps=100_000,
        )
        assert solution.ys is not None
        return solution.ys[0]

    return run


@pytest.mark.parametrize("steps", [500, 5000, 50_000])
@pytest.mark.parametrize(
    "solver", [diffrax.Tsit5(), diffrax.Dopri8()], ids=lambda s: type(s).__name__
)
def test_equal_error(clock, line, solver, steps):
    run = jax.jit(
        lambda dt: lgvi.simulate_free_rigid_body(R0, PI0, GENERIC, dt, steps)[0][:: steps // 100]
    )
    dt = jnp.asarray(SPAN / steps)
    ours = error(run(dt))
    other = adaptive(solver)
    # The loosest tolerance that is as good.
    tolerance = next(t for t in TOLERANCES if error(other(t)) <= ours)
    name = type(solver).__name__
    times = clock(f"{name} {steps}", other, 1, tolerance), least_time(run, dt)
    line(
        f"{f'{name} / lgvi at {ours:.0e} rad over 20 s':42} {1e3 * times[1]:8.3f} ms "
        f"{times[0] / times[1]:8.2f}"
    )


def least_time(run, *arguments):
    return min(timeit.repeat(lambda: jax.block_until_ready(run(*arguments)), repeat=15, number=1))
