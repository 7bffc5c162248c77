"""Times of trajectories under laws, of gyrostats, and of their derivatives."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi

from ..systems import GENERIC, R0, rotation

STEPS, DT = 20_000, 0.05
PI0 = GENERIC @ np.array([0.5, 1.0, 1.5])
WEIGHT = rotation(71)
PENDULUM = lgvi.UniformGravity(1.3, np.array([0.1, 0.2, 1.0]), 1.0)
GRADIENT = lgvi.GravityGradient(0.5, np.array([1.0, 0.5, -0.7]), GENERIC)


def damp(t, R, pi):
    return -0.01 * pi


class Case(NamedTuple):
    body: lgvi.RigidBody | lgvi.Gyrostat
    torque: Callable[..., Any] | None = None
    controller: Callable[..., Any] | None = None
    order: int = 2


BODY = lgvi.RigidBody(jnp.asarray(GENERIC))
CASES = {
    "pendulum": Case(BODY, PENDULUM),
    "pendulum, order 4": Case(BODY, PENDULUM, order=4),
    "pendulum, order 8": Case(BODY, PENDULUM, order=8),
    "gravity gradient": Case(BODY, GRADIENT),
    "controller": Case(BODY, controller=damp),
    "rotors": Case(lgvi.Gyrostat(jnp.asarray(GENERIC), np.array([0.1, -0.2, 0.3]))),
}


def trajectory(case):
    """States as a function of what a fit would learn."""
    dynamic, static = eqx.partition((case.body, case.torque), eqx.is_array)

    def run(dynamic, dt, pi0):
        body, torque = eqx.combine(dynamic, static)
        integrator = lgvi.MoserVeselovIntegrator(dt, order=case.order, throw=False)
        given = {"torque": torque, "controller": case.controller}
        return integrator.simulate(body, R0, pi0, steps=STEPS, **given)[:2]

    return run, (dynamic, jnp.asarray(DT), jnp.asarray(PI0))


@pytest.mark.parametrize("name", CASES)
def test_trajectory(clock, compiled, name):
    run, arguments = trajectory(CASES[name])
    clock(name, compiled(name, run, *arguments), STEPS, *arguments, rounds=5)


@pytest.mark.parametrize("name", CASES)
def test_gradient(clock, compiled, name):
    run, arguments = trajectory(CASES[name])

    def scalar(*arguments):
        return jnp.sum(run(*arguments)[0] * WEIGHT)

    gradient = jax.value_and_grad(scalar, argnums=(0, 1, 2))
    name = f"{name}: gradient"
    clock(name, compiled(name, gradient, *arguments), STEPS, *arguments, rounds=5)
