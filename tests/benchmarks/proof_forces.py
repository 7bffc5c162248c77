"""Intervals of 95 % of a flight under thrust contain the truth: mass, place of the IMU, thrust.

True flights are by Runge and Kutta's method in NumPy. It takes half an hour:
python -m pytest -n 0 -q -o python_files="proof_forces.py" tests/benchmarks
"""

from time import perf_counter

import numpy as np

import lgvi
from lgvi.identification import Model, Recordings, identify

from ..flights import (
    ARMS,
    CENTRE,
    DRAG,
    FRAME,
    GRAVITY,
    MARKER,
    MASS,
    PLACE,
    SPIN,
    SPUN,
    THRUST,
    UP,
    J,
    fly,
)
from ..systems import rng
from .tosses import text

REPETITIONS = 200
OF_RATE, OF_FORCE, OF_POSITION = 0.01, 0.1, 0.005  # rad/s, m/s², m
MOMENTS = np.linalg.eigvalsh(J)


def model_of(sensors, mass=0.6, thrust=THRUST, **of_model):
    """A model whose numbers are wrong but for those that are known."""
    rotors = lgvi.Multirotor(
        ARMS, UP, thrust, DRAG, None, [*map(int, SPIN)], SPUN, centre=CENTRE, in_plane_drag=0.0
    )
    body = lgvi.PhysicalRigidBody.from_principal_moments([4e-3] * 3)
    return Model(body, sensors, rotors=rotors, mass=mass, **of_model)


def coverage(line, words, model, truths, free, flights, channels):
    """The part of the intervals that contain the truth, of the numbers of some functions."""
    sigmas = {"angular_velocity": OF_RATE, "specific_force": OF_FORCE, "position": OF_POSITION}
    exact = dict(
        zip(sigmas, (flights.omega, flights.specific_force, flights.position), strict=True)
    )
    hits, start = [], perf_counter()
    for repetition in range(REPETITIONS):
        random = rng(172, repetition)
        readings = {
            name: exact[name] + sigmas[name] * random.normal(size=exact[name].shape)
            for name in channels
        }
        recordings = Recordings.concatenate(
            Recordings.from_arrays(
                flights.t,
                rotor_speed=(flights.t_speeds, speeds),
                **{name: values[i] for name, values in readings.items()},
            )
            for i, speeds in enumerate(flights.speeds)
        )
        estimate = identify(model, recordings, free=free)
        assert estimate.converged
        hit = []
        for quantity, truth in truths:
            lower, upper = estimate.interval(quantity)
            hit.append((np.atleast_1d(lower) < truth) & (truth < np.atleast_1d(upper)))
        hits.append(hit)
    seconds = (perf_counter() - start) / REPETITIONS
    shares = [np.mean(of_quantity, axis=0) for of_quantity in zip(*hits, strict=True)]
    listed = "; ".join(text(100 * share, ".1f") for share in shares)
    line(f"{words:40}: {listed} %; {seconds:.1f} s each")
    # Of 200 intervals that hold the truth in 95 %, by chance 93.5 to 96.5 % do, of one number.
    assert np.all([0.92 <= np.mean(share) <= 0.98 for share in shares])


def place(model):
    return model.sensors["specific_force"].position


def mass(model):
    return model.mass


def moments(model):
    return np.linalg.eigvalsh(model.body.inertia)


def test_with_tracked_positions(line):
    model = model_of(
        [
            lgvi.Gyroscope(OF_RATE),
            lgvi.Accelerometer(np.zeros(3), OF_FORCE),
            lgvi.PositionSensor(MARKER, OF_POSITION),
        ],
        force=lgvi.AirDrag(np.zeros(3)),
        gravity=GRAVITY,
    )

    def free(model):
        drag = model.force.linear, model.rotors.in_plane_drag
        return model.body, model.mass, place(model), *drag

    def drag(model):
        return model.force.linear

    truths = [(mass, MASS), (place, PLACE), (drag, FRAME)]
    channels = "angular_velocity", "specific_force", "position"
    coverage(line, "mass, place, drag", model, truths, free, fly(1), channels)


def test_without_positions(line):
    """The thrust over the mass, where neither is known, by an IMU alone."""
    model = model_of(
        [lgvi.Gyroscope(OF_RATE), lgvi.Accelerometer(np.zeros(3), OF_FORCE)], thrust=2e-6
    )

    def free(model):
        return model.body, model.mass, place(model), model.rotors.thrust

    def ratio(model):
        return model.rotors.thrust / model.mass

    flights = fly(2, drag=False)
    channels = "angular_velocity", "specific_force"
    truths = [(ratio, THRUST / MASS), (place, PLACE)]
    coverage(line, "thrust over mass, place", model, truths, free, flights, channels)
