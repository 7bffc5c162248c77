"""Planned experiments against random ones, and against what repetitions of them reach.

Random experiments are drawn and judged here without the code of the plan: a motion is simulated,
and scaled down until it is within the limits; `identifiability` says what it tells. It takes ten
minutes:
python -m pytest -n 0 -q -o python_files="proof_planning.py" tests/benchmarks
"""

from collections.abc import Callable
from time import process_time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.identification import (
    InitialStates,
    Limits,
    Model,
    Motors,
    Recordings,
    Wheels,
    identifiability,
    identify,
    plan,
    simulate_recordings,
)

from ..systems import rng

RANDOM, REPETITIONS = 100, 100
RATE = 6.0  # rad/s, of a throw
AXES = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 3**0.5  # of wheels
SPIN, SPEED, ACCELERATION = 2e-4, 400.0, 40.0  # kg m², rad/s, rad/s²
ARM = 0.0884  # m
HOVER = float(np.sqrt(0.6 * 9.81 / 4 / 2.5e-6))  # rad/s
LOWEST, HIGHEST = 0.6 * HOVER, 1.3 * HOVER


def moments(model: Model):
    return jnp.linalg.eigvalsh(model.body.inertia)


def ratios(model: Model):
    J = model.body.inertia
    return jnp.linalg.eigvalsh(J) / jnp.trace(J)


def body_and_bias(model: Model):
    return model.body, model.sensors["angular_velocity"].bias


class Case(NamedTuple):
    """An experiment to plan."""

    model: Model
    start: Model  # of a fit, which knows nothing of the inertia
    times: np.ndarray
    limits: Limits
    quantity: Callable[[Model], Any]
    options: dict[str, Any]
    draw: Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]  # rates, commands
    calm: float  # a command that does nothing
    channel: str  # of the commands, empty without any


def throws(count: int, principal: list[float]) -> Case:
    """Throws before a camera."""
    camera = lgvi.AttitudeSensor(sigma=1e-3)

    def draw(random):
        directions = random.normal(size=(count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        sizes = RATE * random.uniform(size=(count, 1)) ** (1 / 3)  # evenly in the ball
        return sizes * directions, np.zeros((count, 0, 0))

    return Case(
        Model(lgvi.PhysicalRigidBody.from_principal_moments(principal), camera),
        Model(camera),
        np.arange(40) * 0.02,
        Limits(rate=RATE, trajectories=count),
        ratios,
        {},
        draw,
        0.0,
        "",
    )


def spacecraft() -> Case:
    """Four wheels that start at rest, and a gyroscope with a bias."""
    principal = lgvi.so3.exp(jnp.array([0.1, -0.2, 0.15]))
    body = lgvi.PhysicalRigidBody.from_principal_moments([1.1, 1.6, 1.9], principal)
    gyroscope = lgvi.Gyroscope(1.6e-4)
    wheels = Wheels(AXES, SPIN, SPEED, ACCELERATION, start=0.0, knots=7)

    def draw(random):
        speeds, step = np.zeros((1, 7, 4)), ACCELERATION * 10.0
        for knot in range(1, 7):
            lower, upper = (np.clip(speeds[0, knot - 1] + s * step, -SPEED, SPEED) for s in (-1, 1))
            speeds[0, knot] = random.uniform(lower, upper)
        return np.zeros((1, 3)), speeds

    return Case(
        Model(body, lgvi.Gyroscope(1.6e-4, bias=np.array([1e-3, -2e-3, 1.5e-3]))),
        Model(gyroscope),
        np.arange(601) * 0.1,
        Limits(rate=0.2, commands=wheels),
        moments,
        {"free": body_and_bias},
        draw,
        0.0,
        "rotor_momentum",
    )


def quadrotor() -> Case:
    """Four motors about hovering, tilted by 0.6 rad at most."""
    arms = ARM * np.array([[1, -1, 0], [-1, 1, 0], [1, 1, 0], [-1, -1, 0]])
    rotors = lgvi.Multirotor(
        arms, np.array([0, 0, 1.0]), 2.5e-6, 4e-8, lag=None, spin=[1, 1, -1, -1], inertia=1e-5
    )
    gyroscope = lgvi.Gyroscope(0.01, bias=np.zeros(3))
    body = lgvi.PhysicalRigidBody.from_principal_moments([2.5e-3, 2.1e-3, 4.3e-3])
    motors = Motors(LOWEST, HIGHEST, acceleration=8000.0, start=HOVER, knots=9)

    def draw(random):
        speeds = random.uniform(LOWEST, HIGHEST, (1, 9, 4))
        speeds[:, 0] = HOVER
        return np.zeros((1, 3)), speeds

    return Case(
        Model(body, gyroscope, rotors=rotors),
        Model(
            lgvi.PhysicalRigidBody.from_principal_moments([3e-3, 3e-3, 3e-3]),
            gyroscope,
            rotors=rotors,
        ),
        np.arange(401) * 0.005,
        Limits(rate=6.0, turn=0.6, saturation=8.0, commands=motors),
        moments,
        {"free": body_and_bias},
        draw,
        HOVER,
        "rotor_speed",
    )


def carried_out(case: Case, omega: np.ndarray, commands: np.ndarray) -> Any:
    """The layout and the initial states of an experiment; None if it is not within the limits."""
    t, states, trajectories = case.times, InitialStates.from_rates(omega), []
    sensors = [*case.model.sensors, *({"attitude", "angular_velocity"} - {*case.model.sensors})]
    nothing = {"attitude": np.tile(np.eye(3), (len(t), 1, 1)), "angular_velocity": 0 * t[:, None]}
    nothing["angular_velocity"] = np.zeros((len(t), 3))
    layouts = []
    for channels in (sensors, [*case.model.sensors]):
        trajectories = []
        for k, values in enumerate(commands):
            arrays: dict[str, Any] = {channel: (t, nothing[channel]) for channel in channels}
            if case.channel:
                knots = np.linspace(t[0], t[-1], len(values))
                recorded = SPIN * values @ AXES if case.channel == "rotor_momentum" else values
                arrays[case.channel] = knots, recorded
            trajectories.append(Recordings.from_arrays(**arrays, name=str(k)))
        layouts.append(Recordings.concatenate(trajectories))
    exact = [lgvi.AttitudeSensor(1e-3), lgvi.Gyroscope(1e-3)]
    motion = simulate_recordings(
        Model(case.model.body, exact, rotors=case.model.rotors), layouts[0], states
    )
    rates = np.stack([value for _, value in motion.channels["angular_velocity"]])
    R = np.stack([value for _, value in motion.channels["attitude"]])
    turn = np.arccos(np.clip((np.sum(R * R[:, :1], axis=(2, 3)) - 1) / 2, -1, 1))
    limits = case.limits
    within = np.max(np.linalg.norm(rates, axis=2)) <= limits.rate
    within &= limits.turn is None or np.max(turn) <= limits.turn
    within &= limits.saturation is None or np.max(abs(rates)) <= limits.saturation
    return (layouts[1], states) if within else None


def random_errors(case: Case) -> np.ndarray:
    """The largest standard errors of random experiments within the limits, in order."""
    random, errors = rng(173), []
    for _ in range(RANDOM):
        omega, commands = case.draw(random)
        while (experiment := carried_out(case, omega, commands)) is None:
            omega, commands = 0.9 * omega, case.calm + 0.9 * (commands - case.calm)
        told = identifiability(case.model, *experiment, **case.options)
        errors.append(np.max(told.standard_error(case.quantity)))
    return np.sort(errors)


CASES = {
    "3 throws": lambda: throws(3, [2.1e-3, 3.0e-3, 4.2e-3]),
    "12 throws of a flat body": lambda: throws(12, [0.3e-3, 1.0e-3, 1.25e-3]),
    "four wheels": spacecraft,
    "quadrotor": quadrotor,
}


@pytest.mark.parametrize("name", CASES)
def test_planned_experiments(name, line):
    case = CASES[name]()
    begin = process_time()
    best = plan(
        case.model,
        case.times,
        case.limits,
        criterion="E",
        quantity=case.quantity,
        **case.options,
    )
    seconds = process_time() - begin
    promised = np.asarray(best.standard_error(case.quantity))
    errors = random_errors(case)
    line(
        f"{name}: worst moment {np.max(promised):.3g}; the best of {RANDOM} random experiments "
        f"{errors[0] / np.max(promised):.2f} times that, the middle one "
        f"{errors[RANDOM // 2] / np.max(promised):.2f} times; {seconds:.1f} s"
    )
    truth, squares = np.asarray(case.quantity(case.model)), []
    for repetition in range(REPETITIONS):
        recordings = simulate_recordings(
            case.model, best.recordings, best.states, key=jax.random.key(repetition)
        )
        estimate = identify(case.start, recordings, noise="given", **case.options)
        assert estimate.converged
        squares.append((np.asarray(case.quantity(estimate.model)) - truth) ** 2)
    reached = np.sqrt(np.mean(squares, axis=0)) / promised
    together = np.sqrt(np.mean(np.mean(squares, axis=0) / promised**2))
    worst = reached[np.argmax(promised)]
    line(
        f"{name}: {REPETITIONS} repetitions reach {worst:.3f} of the promised error of the worst "
        f"moment, {together:.3f} of all three"
    )
    assert abs(together - 1) < 0.1
