"""A drone under a rate controller, from logged speeds of rotors or commands."""

import re
from typing import Any, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

import lgvi
from lgvi.identification import (
    InitialStates,
    Model,
    Recordings,
    identify,
    negative_log_likelihood,
    simulate_recordings,
)
from lgvi.identification.diagnosis.log_mistakes import find_other_input

from ..systems import rng
from .recorded import errors_of

J = np.array([[3.1, 0.1, -0.05], [0.1, 3.6, 0.08], [-0.05, 0.08, 5.9]]) * 1e-3
ARMS = 0.12 * np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]], float)
AXIS, SPIN = np.array([0.0, 0.0, 1.0]), (1, -1, 1, -1)
THRUST, DRAG, SPUN, LAG = 3e-6, 4.5e-8, 2e-5, 0.035  # N s², N m s², kg m², s
SIGMA, DT, SAMPLES, PARTS = 0.01, 0.004, 400, 4
NOTHING_KNOWN = lgvi.PhysicalRigidBody.from_principal_moments(np.full(3, 4e-3))
ALLOCATION = np.vstack(
    [THRUST * np.cross(ARMS, AXIS)[:, :2].T, -np.array(SPIN) * DRAG, np.full(4, THRUST)]
)  # torques and thrust of the squares of the speeds


def flight(key, held=False):
    """Rates, commands and speeds in flight, by Runge and Kutta's method.

    From sample to sample commands are linear, or held.
    """
    random, weight = rng(161, key), 5.0  # N
    speed = np.full(4, np.sqrt(weight / 4 / THRUST))
    y, command, found = np.append(np.zeros(3), speed), speed, []
    targets = random.normal(size=(SAMPLES // 60 + 1, 3)) * [4, 4, 2]  # rad/s

    def derivative(y, command):
        omega, speed = y[:3], y[3:]
        rate = (command - speed) / LAG
        torque = ALLOCATION[:3] @ speed**2 - SPUN * np.dot(SPIN, rate) * AXIS
        pi = J @ omega + SPUN * np.dot(SPIN, speed) * AXIS
        return np.append(np.linalg.solve(J, np.cross(pi, omega) + torque), rate)

    for k in range(SAMPLES):
        found.append((y[:3], command, y[3:]))
        squares = np.linalg.solve(
            ALLOCATION, np.append(J @ (25 * (targets[k // 60] - y[:3])), weight)
        )
        following = np.sqrt(np.clip(squares, 2e5, 4e6))
        change = 0 if held else following - command
        for part in range(PARTS):
            h, (u, v, w) = (
                DT / PARTS,
                (command + change * (part + x) / PARTS for x in (0, 0.5, 1)),
            )
            a = derivative(y, u)
            b = derivative(y + h / 2 * a, v)
            c = derivative(y + h / 2 * b, v)
            y = y + h / 6 * (a + 2 * b + 2 * c + derivative(y + h * c, w))
        command = following
    rates, commands, speeds = map(np.array, zip(*found, strict=True))
    return rates + SIGMA * random.normal(size=rates.shape), commands, speeds


@pytest.fixture(scope="module")
def flights():
    return [flight(key) for key in range(3)]


def recorded(flights, which, factor=1.0):
    return Recordings.concatenate(
        Recordings.from_arrays(
            np.arange(SAMPLES) * DT, angular_velocity=each[0], rotor_speed=factor * each[which]
        )
        for each in flights
    )


def model(body=NOTHING_KNOWN, thrust=THRUST, drag=1e-8, lag: Any = None, inertia=1e-6):
    rotors = lgvi.Multirotor(ARMS, AXIS, thrust, drag, lag, SPIN, inertia)
    return Model(body, lgvi.Gyroscope(SIGMA), rotors=rotors)


def entries(model):
    return model.body.inertia[np.triu_indices(3)]


def coefficients(model):
    return jnp.stack([model.rotors.drag, model.rotors.inertia])


@pytest.mark.slow
def test_commands_show_the_inertia_the_drag_and_the_lag(flights):
    """With a known thrust; each flight begins with speeds that are behind, or not."""
    start = model(lag=0.02)

    def free(model):
        return model.body, model.rotors.drag, model.rotors.inertia, model.rotors.lag

    estimate = identify(start, recorded(flights, 1), free=free)
    assert estimate.converged
    assert estimate.verdict == "the model holds"
    assert np.all(abs(errors_of(estimate, entries, J[np.triu_indices(3)])) < 4)
    assert np.all(abs(errors_of(estimate, coefficients, [DRAG, SPUN])) < 4)
    assert abs(errors_of(estimate, lambda model: model.rotors.lag, LAG)) < 4
    assert np.max(estimate.standard_error(entries)) < 1e-3 * J[0, 0]
    behind = np.asarray(estimate.states.own)  # (flights, rotors), rad/s, of 650
    # No torque shows whether all rotors together are faster.
    assert np.max(abs(behind - behind.mean(axis=1, keepdims=True))) < 5


@pytest.mark.slow
def test_commands_that_are_held_show_them_too():
    """As lines they are half an interval early."""
    recordings = recorded([flight(key, held=True) for key in range(3)], 1)

    def free(model):
        return model.body, model.rotors.drag, model.rotors.inertia, model.rotors.lag

    def lag(model):
        return model.rotors.lag

    as_lines = identify(model(lag=0.02), recordings, free=free)
    held = identify(model(lag=0.02), recordings.hold("rotor_speed"), free=free)
    assert errors_of(as_lines, lag, LAG) > 10
    assert held.verdict == "the model holds"
    assert np.all(abs(errors_of(held, entries, J[np.triu_indices(3)])) < 4)
    assert np.all(abs(errors_of(held, coefficients, [DRAG, SPUN])) < 4)
    assert abs(errors_of(held, lag, LAG)) < 4


@pytest.mark.slow
def test_speeds_show_ratios_alone_where_no_thrust_is_known(flights):
    """All that is a force or a mass has one scale, in commands from 0 to 1 too."""
    unit = 700.0  # rad/s at a command of one
    start = model(thrust=2 * THRUST * unit**2, drag=1e-8 * unit**2, inertia=1e-6 * unit)

    def free(model):
        return model.body, model.rotors.thrust, model.rotors.drag, model.rotors.inertia

    estimate = identify(start, recorded(flights, 2, 1 / unit), free=free)
    assert estimate.converged
    (words,) = estimate.unobservable
    assert words.startswith("overall scale of the inertia, together with `rotors.thrust`")

    def ratio(model):
        return model.rotors.thrust / jnp.trace(model.body.inertia)

    assert abs(errors_of(estimate, ratio, THRUST * unit**2 / np.trace(J))) < 4

    def shape(model):
        return entries(model) / jnp.trace(model.body.inertia)

    error = shape(estimate.model) - J[np.triu_indices(3)] / np.trace(J)
    assert np.max(abs(error)) < 2e-4  # speeds are not linear between samples


def test_the_momentum_of_rotors_and_body_is_kept_without_air():
    """A rotor that speeds up turns the body the other way."""
    t = np.arange(50) * 0.01
    rotors = lgvi.Multirotor(ARMS, AXIS, 0.0, 0.0, None, SPIN, inertia=0.01)
    body = lgvi.PhysicalRigidBody.from_inertia(J)
    rising = np.outer(np.sin(5 * t), np.array([3.0, 1.0, 0.5, 0.2]))
    layout = Recordings.from_arrays(t, angular_velocity=np.zeros((50, 3)), rotor_speed=rising)
    states = InitialStates.from_attitudes(jnp.eye(3))
    made = simulate_recordings(Model(body, lgvi.Gyroscope(1.0), rotors=rotors), layout, states)
    omega = made.channels["angular_velocity"].values
    momentum = 0.01 * np.outer(rising @ SPIN, AXIS)
    np.testing.assert_allclose(omega @ J, -momentum, atol=1e-12)


def test_rotors_go_with_what_is_recorded(flights):
    rates, _, speeds = flights[0]
    with_speeds = recorded(flights[:1], 2)
    without = Recordings.from_arrays(np.arange(SAMPLES) * DT, angular_velocity=rates)
    value = negative_log_likelihood(with_speeds, lgvi.MoserVeselovIntegrator(0.1))
    states = InitialStates.from_attitudes(jnp.eye(3))
    three = Recordings.from_arrays(
        np.arange(SAMPLES) * DT, angular_velocity=rates, rotor_speed=speeds[:, :3]
    )
    no_rotors, rotors = Model(NOTHING_KNOWN, lgvi.Gyroscope(SIGMA)), cast(Any, model().rotors)
    with pytest.raises(ValueError, match=r"`rotors` .* it is None, and `rotor_speed` is rec"):
        value(no_rotors, states)
    with pytest.raises(ValueError, match=r"`rotors` .* it is None, and `rotor_speed` is rec"):
        identify(no_rotors, with_speeds)
    with pytest.raises(ValueError, match=r"`rotors` .* a `Multirotor`, and `rotor_speed` is not"):
        identify(model(), without)
    with pytest.raises(ValueError, match="has 4 rotors, but `rotor_speed` has 3 columns"):
        identify(model(), three)
    with pytest.raises(ValueError, match=r"`rotor_speed`.* must not be negative.* `spin`"):
        Recordings.from_arrays(np.arange(5.0), angular_velocity=rates[:5], rotor_speed=-speeds[:5])
    with pytest.raises(TypeError, match="is a `Multirotor`: give it as argument `rotors`"):
        Model(NOTHING_KNOWN, lgvi.Gyroscope(SIGMA), rotors)
    with pytest.raises(ValueError, match=r"`rotor_speed` must have shape \(5, n\), with n from 1"):
        Recordings.from_arrays(np.arange(5.0), angular_velocity=rates[:5], rotor_speed=rates[:4])


def test_columns_of_a_file_are_those_of_the_rotors(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text("t,wx,wy,wz,m1,m2\n0,1,2,3,4,5\n1,1,2,3,6,7\n", encoding="utf-8")
    rates = ("wx", "wy", "wz")
    read = Recordings.from_csv(file, angular_velocity=rates, rotor_speed=("m1", "m2"))
    assert read.rotor_speed is not None
    np.testing.assert_array_equal(read.rotor_speed.values, [[4, 5], [6, 7]])
    with pytest.raises(ValueError, match="`rotor_speed` must name 1 to 16 different columns"):
        Recordings.from_csv(file, angular_velocity=rates, rotor_speed=())


def test_speeds_are_kept_in_parts_of_recordings_and_in_files(tmp_path):
    t, rates = np.array([0.0, 1, 2, 7, 8, 9]), np.arange(18.0).reshape(6, 3)
    speeds = np.arange(12.0).reshape(6, 2)
    log = Recordings.from_arrays(t, angular_velocity=rates, rotor_speed=speeds)
    first, second = log.crop(1, 8).split(2).quantities["rotor_speed"]
    np.testing.assert_array_equal(first[1], speeds[1:3])
    np.testing.assert_array_equal(second[1], speeds[3:5])
    names = ("wx", "wy", "wz", "m1", "m2")
    columns = dict(zip(names, np.hstack([rates, speeds]).T, strict=True))
    parquet.write_table(pyarrow.table({"t": t, **columns}), tmp_path / "0.parquet")
    stored = Recordings.open(tmp_path, angular_velocity=names[:3], rotor_speed=names[3:])
    ((found_t, found),) = stored.quantities["rotor_speed"]
    np.testing.assert_array_equal(found_t, t)
    np.testing.assert_array_equal(found, speeds)


EXCHANGED = {
    "`rotor_speed` as `rotor_speed[:, [1, 0, 2, 3]]`": ([1, 0, 2, 3], [1, 1, 1]),
    "`rotor_speed` as `rotor_speed[:, [1, 3, 0, 2]]`": ([2, 0, 3, 1], [1, 1, 1]),
    "the axes of the sensors as (x, -y, z)": (range(4), [1, -1, 1]),
    "the axes of the sensors as (-x, -y, z)": (range(4), [-1, -1, 1]),
    "the axes of the sensors as (x, y, -z)": (range(4), [1, 1, -1]),
}


@pytest.mark.parametrize("lag", [None, 0.02])
def test_rotors_in_another_order_and_mirrored_axes_are_named(flights, lag):
    which = 2 if lag is None else 1  # speeds, or commands
    start = model(lag=lag)
    assert find_other_input(start, recorded(flights, which)) is None
    for words, (order, signs) in EXCHANGED.items():
        misread = [
            (rates * signs, *(each[:, list(order)] for each in speeds))
            for rates, *speeds in flights
        ]
        mistake = find_other_input(start, recorded(misread, which))
        assert mistake is not None
        assert words in mistake.reading.split(" or ")
    in_degrees = [(np.degrees(rates), *speeds) for rates, *speeds in flights]
    mistake = find_other_input(start, recorded(in_degrees, which))
    assert mistake is not None
    assert mistake.reading.split(" or ")[0] == "the rates as degrees per second"


def test_rotors_in_another_order_are_refused(flights):
    misread = [(rates, *(each[:, [1, 0, 2, 3]] for each in speeds)) for rates, *speeds in flights]
    words = r"reading `rotor_speed` as `rotor_speed\[:, \[1, 0, 2, 3\]\]` fits"

    def free(model):
        return model.body, model.rotors.drag, model.rotors.inertia

    with pytest.raises(ValueError, match=f"The log has a usual mistake: {words}"):
        identify(model(), recorded(misread, 2), free=free)


@pytest.mark.slow
def test_a_spin_that_is_reversed_is_named(flights):
    def free(model):
        return model.body, model.rotors.drag, model.rotors.inertia

    start = model()
    reversed_spin = eqx.tree_at(
        lambda m: m.rotors,
        start,
        lgvi.Multirotor(ARMS, AXIS, THRUST, 1e-8, None, tuple(-s for s in SPIN), 1e-6),
    )
    with pytest.warns(UserWarning, match="reading the `spin` reversed"):
        estimate = identify(reversed_spin, recorded(flights, 2), free=free, check=False)
    for name in ("drag", "inertia"):
        words = f"`rotors.{name}` is below zero by .* errors: the `spin` may be reversed"
        assert re.search(words, estimate.verdict)
