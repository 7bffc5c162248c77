"""Torques, momenta and lagging speeds of rotors, against NumPy and SciPy."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lgvi

from ..systems import rng

ANY: Any = lgvi.Multirotor
SPIN = (1, -1, 1, -1)


def numbers():
    random = rng(151)
    return random.normal(size=(4, 3)), random.normal(size=(4, 3)), random.uniform(1, 2, (3, 4))


def turning(lag, behind):
    return lgvi.Multirotor(np.ones((4, 3)), np.eye(3)[2], 1.0, 0.0, lag, SPIN, behind=behind)


def test_torque_and_momentum_are_the_sums_over_rotors(dtype):
    arms, axes, (thrust, drag, inertia) = numbers()
    speeds, torque, momentum = rng(152).normal(size=4), np.zeros(3), np.zeros(3)
    for r, a, k, d, i, s, speed in zip(
        arms, axes, thrust, drag, inertia, SPIN, speeds, strict=True
    ):
        unit = a / np.linalg.norm(a)
        torque += speed**2 * (k * np.cross(r, unit) - s * d * unit)
        momentum += s * i * speed * unit
    given = [jnp.asarray(x, dtype) for x in (arms, axes, thrust, drag, inertia)]
    rotors = lgvi.Multirotor(*given[:4], lag=None, spin=SPIN, inertia=given[4])
    speeds, rtol = jnp.asarray(speeds, dtype), 1e-5 if dtype == jnp.float32 else 1e-12
    assert rotors.torque(speeds).dtype == rotors.momentum(speeds).dtype == dtype
    np.testing.assert_allclose(rotors.torque(speeds), torque, rtol)
    np.testing.assert_allclose(rotors.momentum(speeds), momentum, rtol)
    arms, axes = jnp.asarray(arms, dtype), jnp.asarray(axes, dtype)
    plain = lgvi.Multirotor(arms, axes, 2.0, 0.1, 0.5, SPIN)  # numbers take the precision of arrays
    assert plain.torque(speeds).dtype == plain.momentum(speeds).dtype == dtype
    assert plain.follow(speeds[None], jnp.zeros(0, dtype)).dtype == dtype


def test_one_axis_and_one_coefficient_are_those_of_all_rotors():
    arms, axes, _ = numbers()
    short = lgvi.Multirotor(arms, axes[0], 2.0, 0.3, None, SPIN, 0.1)
    coefficients = np.full(4, 2.0), np.full(4, 0.3), None, SPIN, np.full(4, 0.1)
    whole = lgvi.Multirotor(arms, np.tile(axes[0], (4, 1)), *coefficients)
    speeds = jnp.array([1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(short.torque(speeds), whole.torque(speeds), rtol=1e-14)
    np.testing.assert_allclose(short.momentum(speeds), whole.momentum(speeds), rtol=1e-14)


@pytest.mark.parametrize("lag", [1e-3, 0.05, 10.0])
def test_speeds_follow_commands_as_the_differential_equation_says(lag):
    """With steps from none at all to many lags long, and a speed that is behind at the start."""
    random = rng(153)
    dt = np.array([0.0, 0.01, 0.2, 0.0, 0.03, 1.0, 1e-4])
    t = np.append(0, np.cumsum(dt))
    commands = random.normal(size=(8, 4))
    commands[[1, 4]] = commands[[0, 3]]  # where no time passes
    behind = random.normal(size=4)
    rotors = turning(lag, behind)
    speeds = rotors.follow(commands, dt)
    expected = [commands[0] - behind]
    for k in range(len(dt)):
        if dt[k] == 0:
            expected.append(expected[-1])
            continue

        def rate(time, y, k=k):
            u = commands[k] + (commands[k + 1] - commands[k]) * (time - t[k]) / dt[k]
            return (u - y) / lag

        given = rate, (t[k], t[k + 1]), expected[-1], "Radau"
        expected.append(solve_ivp(*given, rtol=1e-9, atol=1e-11).y[:, -1])
    np.testing.assert_allclose(speeds, expected, rtol=0, atol=2e-8)
    slopes = jax.jacfwd(lambda lag: turning(lag, behind).follow(commands, dt))(jnp.asarray(lag))
    assert np.all(np.isfinite(slopes))
    wrong = jax.jit(lambda lag: turning(lag, behind).follow(commands, dt))(-lag)
    assert np.all(np.isnan(wrong[1:]))  # a fit that goes there is told


def test_without_a_lag_speeds_are_the_commands():
    rotors, commands = turning(None, None), jnp.arange(12.0).reshape(3, 4)
    np.testing.assert_array_equal(rotors.follow(commands, jnp.ones(2)), commands)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"arms": np.ones((0, 3))}, r"`arms` must have shape \(rotors, 3\), with a rotor at least"),
        ({"axes": np.ones((2, 3))}, r"`axes` must have shape \(3,\) or \(4, 3\), .* is \(2, 3\)"),
        ({"thrust": np.ones(3)}, r"`thrust` must have shape \(\) or \(4,\), .* is \(3,\)"),
        ({"spin": (1, -1)}, "`spin` must be 1 or -1 for each of 4 rotors, but is"),
        ({"spin": (1, -1, 1, 0)}, "`spin` must be 1 or -1 for each of 4 rotors, but is"),
        ({"spin": None}, "`spin` must be 1 or -1 for each of 4 rotors, but is None"),
        ({"behind": np.zeros(4), "lag": None}, "`behind` must be None where `lag` is None"),
        ({"axes": np.zeros(3)}, "`axes` must have a direction for each rotor"),
        ({"lag": 0.0}, "`lag` must be above 0"),
    ],
)
def test_bad_rotors_are_told(given, words, unchecked):
    good = {"arms": np.ones((4, 3)), "axes": np.eye(3)[2], "thrust": 1.0}
    good |= {"drag": 0.1, "lag": 0.1, "spin": SPIN}
    with pytest.raises(ValueError, match=words):
        ANY(**{**good, **given})
