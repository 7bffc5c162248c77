"""Sensors of specific force, of a magnetic field and of directions, from a file to an estimate."""

import csv
from dataclasses import replace
from itertools import chain
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.identification import InitialStates, Model, Recordings, identify, simulate_recordings
from lgvi.identification.segments.levels import choose_method, whole_level

from ..systems import rotation
from .recorded import ISOTROPIC, J, errors_of, problem_of, ratios

FIELD, SUN = np.array([2e-5, 5e-6, -4e-5]), np.array([0.0, 0.6, 0.8])
DOWN = np.array([0.0, 0.0, -9.8])
PLACE, DRIFT = np.array([0.05, -0.1, 0.02]), np.array([0.3, -0.2, 0.1])  # m, m/s²
HARD_IRON, TILT, LATE = np.array([3e-6, -2e-6, 1e-6]), np.array([0.02, -0.01, 0.03]), 2e-3
COLUMNS: dict[str, Any] = {
    "angular_velocity": ["wx", "wy", "wz"],
    "specific_force": ["fx", "fy", "fz"],
    "magnetic_field": ["bx", "by", "bz"],
    "direction": ["sx", "sy", "sz"],
}


def model(body, place, drift, late, hard_iron, tilt):
    """A gyroscope and an accelerometer with a clock of its own, a magnetometer, a sun sensor."""
    sensors = [
        lgvi.Gyroscope(2e-3),
        lgvi.Accelerometer(place, 0.05, bias=drift, time_offset=late),
        lgvi.Magnetometer(FIELD, 3e-7, bias=hard_iron),
        lgvi.DirectionSensor(SUN, 2e-3, alignment=tilt),
    ]
    return Model(body, sensors)


def errors_of_sensors(model):
    """What is not known of the sensors."""
    sensors = model.sensors
    return (
        sensors["specific_force"].position,
        sensors["specific_force"].bias,
        sensors["specific_force"].time_offset,
        sensors["magnetic_field"].bias,
        sensors["direction"].alignment,
    )


def test_an_accelerometer_in_flight_shows_where_the_centre_of_mass_is():
    gyroscope, body = lgvi.Gyroscope(2e-3), lgvi.PhysicalRigidBody.from_inertia(J)
    true = Model(body, [gyroscope, lgvi.Accelerometer(PLACE, 0.05)])
    omega = jnp.array([[4.0, -6.0, 2.0], [-6.0, 2.0, 4.0], [2.0, 4.0, 7.0]])
    states = InitialStates.from_rates(omega)
    made = simulate_recordings(true, np.arange(60) * 0.01, states, key=jax.random.key(12))
    start = Model(ISOTROPIC, [gyroscope, lgvi.Accelerometer(np.zeros(3), 0.05)])

    def place(model):
        return model.sensors["specific_force"].position

    estimate = identify(start, made, free=lambda model: (model.body, place(model)))
    assert estimate.converged
    assert np.all(abs(errors_of(estimate, place, PLACE)) < 4)
    assert np.all(abs(errors_of(estimate, ratios, ratios(true))) < 4)
    assert estimate.standard_error(place).max() < 1e-3  # m


def test_the_derivative_by_the_clock_of_an_accelerometer_is_that_of_the_cost():
    body = lgvi.PhysicalRigidBody.from_inertia(J)
    sensors = [lgvi.Gyroscope(2e-3), lgvi.Accelerometer(PLACE, 0.05, time_offset=LATE)]
    late, states = Model(body, sensors), InitialStates.from_rates(jnp.array([[4.0, -6.0, 2.0]]))
    made = simulate_recordings(late, np.arange(60) * 0.01, states, key=jax.random.key(12))
    problem = problem_of(late, made, free=lambda m: m.sensors["specific_force"].time_offset)
    problem = replace(problem, methods=[choose_method(late, made, None)])
    level, states = (
        whole_level(problem.configurations, [np.full(1, 0.03)]),
        jax.tree.map(np.asarray, states),
    )
    theta = problem.free.theta + 1e-3
    slope = problem.linearise(level, theta, states).system.gradient()
    ahead, behind = (problem.cost(level, theta + d, states) for d in (1e-6, -1e-6))
    assert slope[0] == pytest.approx((ahead - behind) / 4e-6, rel=1e-5)


@pytest.mark.slow
def test_what_each_sensor_adds_is_found_with_its_error(tmp_path):
    truth = PLACE, DRIFT, LATE, HARD_IRON, TILT
    true = model(lgvi.PhysicalRigidBody.from_inertia(J), *truth)
    R = np.stack([rotation(i, 130) for i in range(3)])
    omega = np.array([[4.0, -6.0, 2.0], [-6.0, 2.0, 4.0], [2.0, 4.0, 7.0]])
    states = InitialStates(jnp.asarray(R), jnp.asarray(omega))
    made = simulate_recordings(true, np.arange(100) * 0.01, states, key=jax.random.key(11))
    with open(tmp_path / "log.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["trajectory", "t", *chain(*COLUMNS.values())])
        for name, samples in zip(made.names, made, strict=True):
            rows = np.column_stack([samples["direction"][0], *(samples[c][1] for c in COLUMNS)])
            writer.writerows([name, *row] for row in rows.tolist())
    read = Recordings.from_csv(tmp_path / "log.csv", **COLUMNS)

    zeros = np.zeros(3)
    start = model(ISOTROPIC, zeros, zeros, 0.0, zeros, zeros)
    estimate = identify(start, read, free=lambda m: (m.body, *errors_of_sensors(m)))
    assert estimate.converged
    assert estimate.verdict == "the model holds"
    assert estimate.chi_square / estimate.degrees_of_freedom == pytest.approx(1, abs=0.1)
    assert np.all(abs(errors_of(estimate, ratios, ratios(true))) < 4)
    for which, expected in enumerate(truth):

        def found(model, which=which):
            return errors_of_sensors(model)[which]

        assert np.all(abs(errors_of(estimate, found, expected)) < 4)
    assert estimate.standard_error(lambda m: errors_of_sensors(m)[0]).max() < 1e-3  # m
    report = str(estimate)
    assert "specific_force.position[0]" in report
    assert "direction: residual 0.00" in report


@pytest.mark.slow
def test_a_clock_that_is_late_reads_what_the_others_read_later():
    """A field that changes is later too; where a position begins is not."""
    omega, late, body = jnp.array([[2.0, -3.0, 1.0]]), 0.01, lgvi.PhysicalRigidBody.from_inertia(J)
    states = InitialStates(jnp.asarray(rotation(0, 130))[None], omega)

    def seen(time_offset):
        sensors = [
            lgvi.Magnetometer(lambda t: jnp.stack([t, 1 - t, 2 * t]), 0.1, time_offset=time_offset),
            lgvi.DirectionSensor(SUN, 1e-3, time_offset=time_offset),
            lgvi.PositionSensor(PLACE, 1e-3, DOWN, drag=0.3, time_offset=time_offset),
        ]
        return simulate_recordings(Model(body, sensors), np.arange(20) * 0.005, states).channels

    on_time, shifted = seen(0.0), seen(late)
    for channel, samples in shifted.items():
        expected = on_time[channel].values[2:]
        np.testing.assert_allclose(samples.values[:-2], expected, atol=1e-9, err_msg=channel)
        assert np.max(abs(expected - on_time[channel].values[:-2])) > 1e-3


@pytest.mark.slow
def test_residuals_of_one_channel_that_are_far_too_large_speak_against_a_model():
    """They are few of all, so that chi-square as a whole is not so large."""
    gyroscope, body = lgvi.Gyroscope(2e-3), lgvi.PhysicalRigidBody.from_inertia(J)
    true = Model(body, [gyroscope, lgvi.Magnetometer(FIELD, 3e-7, bias=10 * HARD_IRON)])
    states = InitialStates.from_rates([4.0, -6.0, 2.0])
    made = simulate_recordings(true, np.arange(60) * 0.01, states, key=jax.random.key(13))
    estimate = identify(Model(ISOTROPIC, [gyroscope, lgvi.Magnetometer(FIELD, 3e-7)]), made)
    assert estimate.verdict.startswith("the model does not hold")
    assert "residuals of magnetic_field are" in estimate.verdict


def test_what_tells_no_motion_alone_is_refused():
    states = InitialStates.from_rates([4.0, -6.0, 2.0])
    alone = Model(ISOTROPIC, lgvi.Accelerometer(PLACE, 0.05))
    made = simulate_recordings(alone, np.arange(20) * 0.01, states)
    with pytest.raises(ValueError, match="a sensor that tells how the body turns, such as of"):
        identify(alone, made)


def test_an_accelerometer_about_a_pivot_must_feel_gravity():
    body = lgvi.PhysicalRigidBody.from_inertia(J)
    weight = lgvi.UniformGravity(1.0, PLACE)
    states = InitialStates.from_attitudes(jnp.eye(3))
    damping = lgvi.LinearDamping(0.1 * np.eye(3))
    for torque in (weight, weight + damping, 2 * (weight + damping) + damping):
        model = Model(body, lgvi.Accelerometer(PLACE, 0.05), torque)
        with pytest.raises(ValueError, match="`gravity` of the `Accelerometer` must be given"):
            simulate_recordings(model, np.arange(3.0), states)


def test_a_leaf_that_is_nan_is_named():
    model = Model(ISOTROPIC, lgvi.Accelerometer(np.nan * PLACE, 0.05))
    states = InitialStates.from_attitudes(jnp.eye(3))
    with pytest.raises(
        ValueError, match=r"no NaN, but its `sensors\['specific_force'\]\.position`"
    ):
        simulate_recordings(model, np.arange(3.0), states)


def test_a_function_of_numpy_is_told_from_one_of_jax():
    def turning(t) -> Any:
        return np.array([np.cos(t), np.sin(t), 0])

    model = Model(ISOTROPIC, lgvi.DirectionSensor(turning, 1e-3))
    states = InitialStates.from_attitudes(jnp.eye(3))
    with pytest.raises(TypeError, match=r"`direction` must be made of functions of `jax\.numpy`"):
        simulate_recordings(model, np.arange(3.0), states)
