"""Sensors against NumPy and SciPy: what they read, residuals in units of noise, losses."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.modules.sensors.sensor import InvalidReadingError

from ..systems import euler_equations, rng, rotation

ANY: Any = lgvi


def test_residual_of_an_attitude_is_the_noise_in_units_of_sigma():
    random = rng(60)
    R, noise, alignment = rotation(61), random.normal(size=3), random.normal(size=3)
    sigma = np.array([1e-3, 2e-3, 5e-3])
    exp = Rotation.from_rotvec
    measured = jnp.asarray(R @ (exp(alignment) * exp(sigma * noise)).as_matrix())
    sensor = lgvi.AttitudeSensor(sigma, alignment)

    @jax.jit
    def read(R, measured):
        predicted = sensor.predict(lgvi.MotionState(0.0, R, np.zeros(3)))
        return sensor.compute_residual(predicted, measured), predicted

    residual, predicted = read(R, measured)
    np.testing.assert_allclose(residual, noise, rtol=1e-10)
    np.testing.assert_allclose(predicted, R @ exp(alignment).as_matrix(), rtol=1e-14)
    np.testing.assert_allclose(
        sensor.add_noise(predicted, jnp.asarray(noise)), measured, rtol=1e-13
    )
    guessed, rates = sensor.guess_state(np.asarray(measured)[None])
    assert rates is None
    np.testing.assert_allclose(guessed[0], measured @ exp(-alignment).as_matrix(), rtol=1e-13)


def test_residual_of_a_rate_is_the_noise_in_units_of_sigma():
    random = rng(62)
    omega, noise, alignment, bias = random.normal(size=(4, 3))
    scale, sigma = 1 + 0.1 * random.normal(size=3), 2e-3
    seen = Rotation.from_rotvec(alignment).as_matrix().T @ omega
    measured = jnp.asarray(scale * seen + bias + sigma * noise)
    sensor = lgvi.Gyroscope(sigma, bias, scale, alignment)
    predicted = sensor.predict(lgvi.MotionState(0.0, np.eye(3), omega))
    np.testing.assert_allclose(sensor.compute_residual(predicted, measured), noise, rtol=1e-10)
    np.testing.assert_allclose(
        sensor.add_noise(predicted, jnp.asarray(noise)), measured, rtol=1e-13
    )
    attitudes, guessed = sensor.guess_state(np.asarray(predicted)[None])
    assert attitudes is None
    np.testing.assert_allclose(guessed[0], omega, rtol=1e-13)


def test_a_gyroscope_can_have_a_matrix_of_scales():
    """With sensitivities across the axes; the diagonal one is that of a vector."""
    random = rng(64)
    S = np.eye(3) + 0.1 * random.normal(size=(3, 3))
    b, omega = random.normal(size=3), random.normal(size=3)
    state = lgvi.MotionState(0.0, np.eye(3), omega)
    sensor = lgvi.Gyroscope(1e-3, scale=S, bias=b)
    np.testing.assert_allclose(sensor.predict(state), S @ omega + b, rtol=1e-13)
    _, guessed = sensor.guess_state((S @ omega + b)[None])
    np.testing.assert_allclose(guessed[0], omega, rtol=1e-12)
    s, a = random.normal(size=3), random.normal(size=3)
    first, second = (lgvi.Gyroscope(1.0, scale=x, alignment=a) for x in (s, np.diag(s)))
    np.testing.assert_allclose(first.predict(state), second.predict(state), rtol=1e-12)
    with pytest.raises(ValueError, match=r"`scale` must have shape \(3,\) or \(3, 3\)"):
        lgvi.Gyroscope(1.0, scale=np.ones((3, 2)))


def test_a_sensor_without_errors_reads_the_truth(dtype):
    R = jnp.asarray(rotation(63), dtype)
    omega = jnp.arange(3, dtype=dtype)
    attitude, gyroscope = (
        lgvi.AttitudeSensor(jnp.ones((), dtype)),
        lgvi.Gyroscope(jnp.ones((), dtype)),
    )
    state = lgvi.MotionState(0.0, R, omega)
    for value, expected in ((attitude.predict(state), R), (gyroscope.predict(state), omega)):
        assert value.dtype == dtype
        np.testing.assert_array_equal(value, expected)


@pytest.mark.parametrize("loss", [lgvi.Huber(1.5), lgvi.Cauchy(1.5)])
def test_a_loss_is_the_square_of_small_residuals_and_its_weight_the_derivative(loss):
    s = jnp.array([1e-8, 0.5, 2.0, 2.3, 9.0, 1e6])
    value_and_slope = jax.jit(jax.vmap(jax.value_and_grad(loss)))
    weight, (values, slopes) = np.asarray(jax.jit(loss.weight)(s)), value_and_slope(s)
    np.testing.assert_allclose(weight, slopes, rtol=1e-12)
    assert values[0] == pytest.approx(1e-8, rel=1e-7)
    assert np.all(np.diff(weight) <= 0)
    assert weight[-1] < 2e-3
    assert np.isfinite(value_and_slope(0 * s)[1][0])


def test_huber_is_linear_in_the_length_of_large_residuals():
    length = jnp.array([3.0, 4.0, 10.0])
    np.testing.assert_allclose(lgvi.Huber(2.0)(length**2), 4 * length - 4, rtol=1e-14)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: ANY.AttitudeSensor([1, 2]), ValueError, r"`sigma` must have shape \(\) or \(3,\)"),
        (lambda: ANY.AttitudeSensor("fine"), TypeError, "`sigma`"),
        (lambda: lgvi.AttitudeSensor(-1.0), ValueError, "`sigma` must be at least 0, but is -1"),
        (
            lambda: lgvi.Gyroscope(np.array([1.0, np.nan, 1.0])),
            ValueError,
            "`sigma` must be at least 0",
        ),
        (lambda: ANY.AttitudeSensor(1e-3, [0, 1]), ValueError, r"`alignment` .* \(3,\).* \(2,\)"),
        (lambda: ANY.Gyroscope(1e-3, bias=0.1), ValueError, r"`bias` must have shape \(3,\)"),
        (lambda: ANY.Gyroscope(1e-3, time_offset=[1]), ValueError, r"`time_offset` .* \(\)"),
        (lambda: ANY.Gyroscope(1e-3, loss="huber"), TypeError, "`loss` .* 'huber'"),
        (lambda: ANY.Huber(-1), ValueError, "`threshold` must be positive, but is -1"),
        (lambda: ANY.Cauchy(float("nan")), ValueError, "`threshold` must be positive"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_bad_input_is_named(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_a_magnetometer_reads_a_field_that_may_depend_on_time():
    random = rng(65)
    R, (bias, alignment, field, noise) = rotation(66), random.normal(size=(4, 3))
    soft_iron, sigma = np.eye(3) + 0.1 * random.normal(size=(3, 3)), np.array([1.0, 2.0, 3.0])
    turn = Rotation.from_rotvec(alignment).as_matrix()
    sensor = lgvi.Magnetometer(field, sigma, bias, soft_iron, alignment)
    predicted = sensor.predict(lgvi.MotionState(0.5, R, np.ones(3)))
    np.testing.assert_allclose(predicted, soft_iron @ turn.T @ R.T @ field + bias, rtol=1e-12)
    measured = sensor.add_noise(predicted, jnp.asarray(noise))
    np.testing.assert_allclose(sensor.compute_residual(predicted, measured), noise, rtol=1e-10)
    later = lgvi.Magnetometer(lambda t: field * t, 1.0)
    found = later.predict(lgvi.MotionState(0.5, R, np.ones(3)))
    np.testing.assert_allclose(found, R.T @ field / 2, rtol=1e-12)
    wrong = lgvi.Magnetometer(lambda t: t, 1.0)
    with pytest.raises(ValueError, match=r"`field\(t\)` must have shape \(3,\)"):
        wrong.predict(lgvi.MotionState(0.5, R, np.ones(3)))


def test_an_accelerometer_reads_the_acceleration_of_its_place_less_gravity():
    t, g = np.linspace(-2e-3, 2e-3, 5), np.array([0.5, -1.0, -9.81])
    r, omega, torque = np.array([0.1, -0.2, 0.3]), np.array([2.0, -1.0, 3.0]), np.array([1.0, 2, 3])
    J, R = np.diag([1.0, 2.0, 2.5]), rotation(67)
    attitudes, momenta = [], []
    for times in (t[2::-1], t[2:]):  # backwards and forwards from zero
        each, pi = euler_equations(R, J @ omega, J, times, lambda t, R, omega: torque)
        attitudes.append(each)
        momenta.append(pi)
    places = np.concatenate([attitudes[0][::-1], attitudes[1][1:]]) @ r
    weights = np.array([-1, 16, -30, 16, -1]) / 12
    acceleration = weights @ places / (t[1] - t[0]) ** 2
    rate = np.linalg.solve(J, np.cross(J @ omega, omega) + torque)
    state = lgvi.MotionState(0.0, R, omega, lambda: jnp.asarray(rate))
    in_flight, about_pivot = (lgvi.Accelerometer(r, 0.1, gravity) for gravity in (None, g))
    np.testing.assert_allclose(in_flight.predict(state), R.T @ acceleration, rtol=1e-6)
    np.testing.assert_allclose(about_pivot.predict(state), R.T @ (acceleration - g), rtol=1e-6)
    assert (in_flight.depends_on_attitude, about_pivot.depends_on_attitude) == (False, True)


@pytest.mark.parametrize("drag", [None, 1e-4, 0.24, 0.26, 3.0])
def test_a_tracked_point_flies_as_the_differential_equation_says(drag, dtype):
    k, g = drag or 0.0, 0.9 * np.array([0.5, -1.0, -9.81])
    c, x, v, R = *rng(70).normal(size=(3, 3)), rotation(71)
    numbers = {"offset": c, "sigma": 1e-3, "gravity": g / 0.9, "position": x, "velocity": v}
    numbers |= {"gravity_scale": 0.9, "length_scale": 1.02}
    numbers |= {} if drag is None else {"drag": drag}
    arrays: Any = {name: jnp.asarray(of, dtype) for name, of in numbers.items()}
    sensor = lgvi.PositionSensor(**arrays)

    def flight(t, y):
        return np.concatenate([y[3:], g - k * y[3:]])

    times = np.linspace(0, 2, 5)
    y = solve_ivp(flight, (0, 2), np.concatenate([x, v]), "DOP853", times, rtol=1e-12, atol=1e-13).y

    def read(sensor, elapsed):
        state = lgvi.MotionState(
            jnp.asarray(100.0, dtype),
            jnp.asarray(R, dtype),
            jnp.zeros(3, dtype),
            elapsed=jnp.asarray(elapsed, dtype),
        )
        return sensor.predict(state)

    rtol = 1e-5 if dtype == jnp.float32 else 1e-11
    for elapsed, expected in zip(times, y.T[:, :3], strict=True):
        expected = 1.02 * (expected + R @ c)
        for begin in (0.0, 0.5):  # the sensor goes on from where it is
            later = sensor.advance(jnp.asarray(begin, dtype))
            np.testing.assert_allclose(read(later, elapsed - begin), expected, rtol, atol=rtol)
    at_rest = lgvi.MotionState(jnp.asarray(0.0, dtype), jnp.asarray(R, dtype), jnp.zeros(3, dtype))
    np.testing.assert_array_equal(sensor.predict(at_rest), read(sensor, 0.0))


@pytest.mark.parametrize("frame", ["space", "body"])
def test_a_direction_is_turned_by_its_noise(frame, dtype):
    random, R = rng(68), rotation(69)
    alignment = random.normal(size=3)
    turn = Rotation.from_rotvec(alignment).as_matrix()
    rtol = 1e-4 if dtype == jnp.float32 else 1e-9
    for direction in (*np.eye(3), *-np.eye(3), *random.normal(size=(5, 3))):
        u = jnp.asarray(direction, dtype)
        sensor = lgvi.DirectionSensor(
            u, jnp.asarray(0.01, dtype), frame, jnp.asarray(alignment, dtype)
        )
        state = lgvi.MotionState(0.0, jnp.asarray(R, dtype), jnp.ones(3, dtype))
        predicted = sensor.predict(state)
        seen = turn.T @ (R.T if frame == "space" else R) @ direction
        np.testing.assert_allclose(predicted, seen / np.linalg.norm(seen), atol=rtol)
        for size in (0.0, 1e-3, 1.0, 100.0):
            noise = size * random.normal(size=2)
            measured = sensor.add_noise(predicted, jnp.asarray(noise, dtype))
            np.testing.assert_allclose(np.linalg.norm(measured), 1, rtol=rtol)
            angle = np.arctan2(
                np.linalg.norm(np.cross(predicted, measured)), np.dot(predicted, measured)
            )
            turned = 0.01 * np.linalg.norm(noise)
            assert abs(np.cos(angle) - np.cos(turned)) < rtol
            if turned < 3:
                found = sensor.compute_residual(predicted, measured)
                np.testing.assert_allclose(found, noise, rtol=rtol, atol=1e3 * rtol)
        opposite = sensor.compute_residual(predicted, -predicted)
        np.testing.assert_allclose(np.linalg.norm(opposite), np.pi / 0.01, rtol=1e-3)


def test_the_residual_of_a_direction_has_the_derivative_of_a_turn():
    sensor = lgvi.DirectionSensor(np.array([0.0, 0.0, 1.0]), 1.0)
    predicted = jnp.array([0.6, 0.0, 0.8])
    noise = jnp.array([1e-3, -2e-3])
    for n in (jnp.zeros(2), noise):
        slope = jax.jacfwd(
            lambda n: sensor.compute_residual(predicted, sensor.add_noise(predicted, n))
        )(n)
        np.testing.assert_allclose(slope, np.eye(2), atol=1e-6)


def test_directions_are_kept_as_unit_vectors(unchecked):
    read = lgvi.DirectionSensor.from_columns(np.array([[0.0, 3.0, 4.0], [2.0, 0.0, 0.0]]))
    np.testing.assert_allclose(read, [[0, 0.6, 0.8], [1, 0, 0]], rtol=1e-15)
    with pytest.raises(InvalidReadingError, match="must have a direction, but is zero"):
        lgvi.DirectionSensor.from_columns(np.zeros((2, 3)))
    with pytest.raises(ValueError, match="`direction` must be finite and not zero"):
        lgvi.DirectionSensor(np.zeros(3), 0.1)
    with pytest.raises(ValueError, match=r"`sigma` must have shape \(\)"):
        lgvi.DirectionSensor(np.ones(3), np.ones(3))
