"""Intervals of 95 % from sensors of positions, forces and directions contain the truth.

True motions are those of Euler's equations, from SciPy. It takes half an hour:
python -m pytest -n 0 -q -o python_files="proof_sensors.py" tests/benchmarks
"""

from time import perf_counter

import numpy as np
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import Model, Recordings, identify

from ..identification.recorded import ratios
from ..systems import inertia, rng, rotation
from .tosses import directions, motions, text

REPETITIONS, TOSSES = 200, 30
MOMENTS = np.array([1.0, 1.6, 2.2]) / 4.8
J = inertia(MOMENTS, rotation(221))
BODY = lgvi.PhysicalRigidBody.from_inertia(J)
T = np.arange(50) * 0.01
RANDOM = rng(222)
R, OMEGA = motions(J, RANDOM.uniform(4, 8, (TOSSES, 1)) * directions(RANDOM, TOSSES), T)
OF_RATE, OF_FORCE = 3e-3, 0.05  # rad/s and m/s²: a phone's, at 100 Hz
PLACE, GRAVITY = np.array([0.02, -0.03, 0.01]), np.array([0.0, 0.0, -9.81])
FIELD, SUN = np.array([2e-5, 5e-6, -4e-5]), np.array([0.0, 0.6, 0.8])
GYROSCOPE = lgvi.Gyroscope(OF_RATE)


def coverage(line, words, model, truths, free, readings_of):
    """The part of the intervals that contain the truth, of the numbers of some functions."""
    found, start = [], perf_counter()
    for repetition in range(REPETITIONS):
        each = readings_of(rng(223, repetition))
        recordings = Recordings.concatenate(
            Recordings.from_arrays(
                T, sensors=model.sensors, **{name: values[i] for name, values in each.items()}
            )
            for i in range(TOSSES)
        )
        estimate = identify(model, recordings, free=free)
        assert estimate.converged
        hit = []
        for quantity, truth in truths:
            lower, upper = estimate.interval(quantity)
            hit.append((np.atleast_1d(lower) < truth) & (truth < np.atleast_1d(upper)))
        found.append(hit)
    seconds = (perf_counter() - start) / REPETITIONS
    shares = [np.mean(of_quantity, axis=0) for of_quantity in zip(*found, strict=True)]
    each = "; ".join(text(100 * share, ".1f") for share in shares)
    line(f"{words:40}: {each} %; {seconds:.1f} s each")
    # Of 200 intervals that hold the truth in 95 %, by chance 93.5 to 96.5 % do, of one number.
    assert np.all([0.92 <= np.mean(share) <= 0.98 for share in shares])


def leaf(channel, name):
    return lambda model: getattr(model.sensors[channel], name)


def forces(late=0.0):
    """Specific forces at a place (tosses, samples, 3), read some time later."""
    omega = motions(J, OMEGA[:, 0], np.unique(np.append(0, T + late)))[1][:, -len(T) :]
    rate = np.linalg.solve(J, np.cross(omega @ J, omega)[..., None])[..., 0]
    return np.cross(rate, PLACE) + np.cross(omega, np.cross(omega, PLACE))


def test_of_the_centre_of_mass_by_positions(line):
    model = Model(
        BODY, [lgvi.AttitudeSensor(1e-3), lgvi.PositionSensor(np.zeros(3), 1e-4, GRAVITY)]
    )
    begin = RANDOM.normal(size=(2, TOSSES, 1, 3))
    flight = begin[0] + begin[1] * T[:, None] + 0.98 * GRAVITY * T[:, None] ** 2 / 2
    turned = Rotation.from_matrix(R.reshape(-1, 3, 3))

    def read(random):
        noise = Rotation.from_rotvec(1e-3 * random.normal(size=(TOSSES * len(T), 3)))
        position = flight + R @ PLACE + 1e-4 * random.normal(size=OMEGA.shape)
        return {"attitude": (turned * noise).as_matrix().reshape(R.shape), "position": position}

    offset, size = leaf("position", "offset"), leaf("position", "gravity_scale")
    truths = [(offset, PLACE), (size, [0.98])]
    free = lambda model: (model.body, offset(model), size(model))  # noqa: E731
    coverage(line, "centre of mass and gravity by positions", model, truths, free, read)


def test_of_the_centre_of_mass_by_an_accelerometer(line):
    model = Model(BODY, [GYROSCOPE, lgvi.Accelerometer(np.zeros(3), OF_FORCE)])
    force, drift, bias = forces(), np.array([0.3, -0.2, 0.1]), np.array([0.02, -0.01, 0.03])

    def read(random):
        return {
            "angular_velocity": OMEGA + bias + OF_RATE * random.normal(size=OMEGA.shape),
            "specific_force": force + drift + OF_FORCE * random.normal(size=OMEGA.shape),
        }

    place, of_force = leaf("specific_force", "position"), leaf("specific_force", "bias")
    of_rate = leaf("angular_velocity", "bias")
    truths = [(place, PLACE), (of_force, drift), (of_rate, bias)]
    free = lambda model: (model.body, place(model), of_force(model), of_rate(model))  # noqa: E731
    coverage(line, "centre of mass and biases by forces", model, truths, free, read)


def test_of_two_clocks(line):
    sensor, late = lgvi.Accelerometer(np.zeros(3), OF_FORCE, time_offset=0.0), 4e-3
    model, force = Model(BODY, [GYROSCOPE, sensor]), forces(late)

    def read(random):
        return {
            "angular_velocity": OMEGA + OF_RATE * random.normal(size=OMEGA.shape),
            "specific_force": force + OF_FORCE * random.normal(size=OMEGA.shape),
        }

    place, offset = leaf("specific_force", "position"), leaf("specific_force", "time_offset")
    truths = [(place, PLACE), (offset, [late]), (ratios, MOMENTS)]
    free = lambda model: (model.body, place(model), offset(model))  # noqa: E731
    coverage(line, "centre of mass, clock, ratios by forces", model, truths, free, read)


def test_of_the_inertia_by_a_magnetometer_alone(line):
    model, seen = Model(BODY, lgvi.Magnetometer(FIELD, 3e-7)), np.swapaxes(R, -1, -2) @ FIELD

    def read(random):
        return {"magnetic_field": seen + 3e-7 * random.normal(size=OMEGA.shape)}

    free = lambda model: model.body  # noqa: E731
    coverage(line, "ratios by a magnetometer", model, [(ratios, MOMENTS)], free, read)


def test_of_the_inertia_by_two_directions(line):
    sensors = {
        "sun": lgvi.DirectionSensor(SUN, 5e-3),
        "mark": lgvi.DirectionSensor(SUN, 2e-3, frame="body"),
    }
    model = Model(BODY, sensors)

    def turned(directions, sigma, random):
        """Directions turned about random axes across them."""
        axes = np.cross(directions, random.normal(size=directions.shape))
        axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
        turn = sigma * np.linalg.norm(random.normal(size=(*axes.shape[:-1], 2)), axis=-1)
        turns = Rotation.from_rotvec((turn[..., None] * axes).reshape(-1, 3))
        return turns.apply(directions.reshape(-1, 3)).reshape(directions.shape)

    def read(random):
        sun, mark = np.swapaxes(R, -1, -2) @ SUN, R @ SUN
        return {"sun": turned(sun, 5e-3, random), "mark": turned(mark, 2e-3, random)}

    free = lambda model: model.body  # noqa: E731
    coverage(line, "ratios by two directions", model, [(ratios, MOMENTS)], free, read)
