"""Whether reports name what a model leaves out, and the usual mistakes of logs.

On request: `python -m pytest -n 0 -q -s -o python_files="proof_diagnosis.py" tests/benchmarks`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import InitialStates, Model, Recordings, identify, simulate_recordings
from lgvi.identification.diagnosis.log_mistakes import find_mistake, find_other_input
from lgvi.identification.diagnosis.momentum import why_no_body_moves_so

from ..systems import inertia, rng, rotation
from .tosses import directions

SIGMA_R, SIGMA_W = 1e-3, 3e-3
COUNT, TIMES = 12, np.arange(50) * 0.03
START = lgvi.PhysicalRigidBody.from_principal_moments([1.0, 1.0, 1.0])
SENSORS = lgvi.AttitudeSensor(SIGMA_R), lgvi.Gyroscope(SIGMA_W)
CAUSES = "bias", "scale", "alignment", "time_offset", "quadratic drag"


def body_of(random, key):
    second = random.uniform(0.2, 1, 3)  # of mass about each axis
    return inertia((np.sum(second) - second) * 1e-3, rotation(400 + key))


def cause_of(random, J, cause):
    """A model with one thing that the fit does not know of; sizes within a factor of ten."""
    size, direction = 10 ** random.uniform(-0.5, 0.5), directions(random, 1)[0]
    leaves: dict[str, Any] = {
        "bias": {"bias": 0.01 * size * direction},
        "scale": {"scale": 1 + 0.01 * size * direction},
        "alignment": {"alignment": 0.01 * size * direction},
        "time_offset": {"time_offset": random.choice([-1, 1]) * 0.002 * size},
        "quadratic drag": {},
    }
    gyroscope = lgvi.Gyroscope(SIGMA_W, **leaves[cause])
    drag = lgvi.QuadraticDamping(3e-3 * size * np.trace(J) / 3 * np.eye(3))
    torque = drag if cause == "quadratic drag" else None
    return Model(lgvi.RigidBody(J), (SENSORS[0], gyroscope), torque=torque)


def simulated(random, model, key):
    R = Rotation.random(COUNT, rng=random).as_matrix()
    omega = directions(random, COUNT) * random.uniform(2, 5, (COUNT, 1))
    states = InitialStates(jnp.asarray(R), jnp.asarray(omega))
    return simulate_recordings(model, TIMES, states, key=jax.random.key(key))


def test_the_true_cause_is_the_first_suspect():
    logs = 100
    first = certain = 0
    for key in range(logs):
        random, cause = rng(300, key), CAUSES[key % len(CAUSES)]
        J = body_of(random, key)
        recordings = simulated(random, cause_of(random, J, cause), key)
        suspects = identify(Model(START, SENSORS), recordings).suspects
        names = [name.split(".")[-1] for name in suspects[0].names]
        first += cause in names
        certain += suspects[0].is_certain
        if cause not in names:
            print(f"log {key}: {cause} taken for {names}, {suspects[0].probability:.2g}")
    print(f"true cause first: {first} of {logs}; the first suspect is certain: {certain}")
    assert first >= 0.9 * logs


def read_wrongly(recordings, mistake="", exchange=None, alone=False):
    found = []
    for each in recordings:
        t, R = each["attitude"]
        omega = each["angular_velocity"][1]
        if mistake == "scalar-last":
            R = Rotation.from_quat(Rotation.from_matrix(R).as_quat(), scalar_first=True).as_matrix()
        elif mistake == "space to body":
            R = np.swapaxes(R, 1, 2)
        elif mistake == "degrees":
            omega = np.degrees(omega)
        elif mistake == "milliseconds":
            t = 1000 * t
        elif exchange is not None:
            omega = omega @ exchange
        values = {"attitude": R} | ({} if alone else {"angular_velocity": omega})
        found.append(Recordings.from_arrays(t, **values, name=str(len(found))))
    return Recordings.concatenate(found)


def test_mistakes_are_named_and_right_logs_are_not_accused():
    logs, right = 40, 100
    named = accused = 0
    for key in range(logs):
        random = rng(301, key)
        kind = ["scalar-last", "space to body", "degrees", "milliseconds", "flipped", "exchanged"]
        kind = kind[key % len(kind)]
        words, exchange = kind, None
        if kind == "flipped":
            signs = np.ones(3)
            signs[random.integers(3)] = -1
            exchange, words = np.diag(signs), "axes of the rates"
        elif kind == "exchanged":
            a = random.permutation(3)[:2]
            exchange, words = np.eye(3), "axes of the rates"
            exchange[a] = exchange[a[::-1]]
        alone = kind in ("scalar-last", "space to body") and key % 4 < 2
        model = Model(lgvi.RigidBody(body_of(random, key)), SENSORS)
        recordings = read_wrongly(simulated(random, model, key), kind, exchange, alone)
        found = find_mistake(Model(START, SENSORS[:1] if alone else SENSORS), recordings)
        as_it_is = found is not None and words in found.reading
        named += as_it_is
        if not as_it_is:
            print(f"log {key}: {kind} taken for {found}")
    for key in range(right):
        random = rng(302, key)
        model = cause_of(random, body_of(random, key), CAUSES[key % len(CAUSES)])
        recordings = simulated(random, model, key)
        found = find_mistake(Model(START, SENSORS), recordings)
        alone = read_wrongly(recordings, alone=True)
        found = found or find_mistake(Model(START, SENSORS[:1]), alone)
        found = found or why_no_body_moves_so(Model(START, SENSORS), recordings) or None
        accused += found is not None
        if found is not None:
            print(f"right log {key}: {found}")
    print(f"mistakes named: {named} of {logs}; right logs accused: {accused} of {right}")
    assert named >= 38
    assert accused == 0


UNITS = {  # how many times as large as in rad/s and s
    "degrees per second": (180 / np.pi, 1),
    "revolutions per minute": (30 / np.pi, 1),
    "revolutions per second": (0.5 / np.pi, 1),
    "counts of 16.4 for each degree per second": (16.4 * 180 / np.pi, 1),
    "counts of 131 for each degree per second": (131 * 180 / np.pi, 1),
    "milliseconds": (1, 1e3),
    "microseconds": (1, 1e6),
    "nanoseconds": (1, 1e9),
    "minutes": (1, 1 / 60),
}


def test_units_are_named():
    logs, named = 100, 0
    for key in range(logs):
        random = rng(303, key)
        unit = list(UNITS)[key % len(UNITS)]
        of_rates, of_times = UNITS[unit]
        # Whatever else the model leaves out.
        model = cause_of(random, body_of(random, key), CAUSES[key % len(CAUSES)])
        log = Recordings.concatenate(
            Recordings.from_arrays(
                of_times * each["attitude"][0],
                attitude=each["attitude"][1],
                angular_velocity=of_rates * each["angular_velocity"][1],
                name=str(i),
            )
            for i, each in enumerate(simulated(random, model, key))
        )
        found = find_mistake(Model(START, SENSORS), log)
        named += found is not None and found.reading.endswith(f"as {unit}")
        if found is None or not found.reading.endswith(f"as {unit}"):
            print(f"log {key}: {unit} taken for {found}")
    print(f"units named: {named} of {logs}")
    assert named >= 95


T, UP = np.arange(600) * 0.004, np.array([0.0, 0.0, 1.0])


def drone(random, key):
    """Two flights with commands in the open, and a model that knows the rotors roughly."""
    count = int(random.choice([4, 4, 6]))
    angle = 2 * np.pi * (np.arange(count) + 0.5) / count
    arms = random.uniform(0.08, 0.3) * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    spin = tuple((-1) ** i for i in range(count))
    gyroscope = lgvi.Gyroscope(0.01, bias=0.03 * random.normal(size=3))
    thrust = 3e-6 * (1 + 0.05 * random.normal(size=count))
    shift = [*(3e-3 * random.normal(size=2)), 0.0]  # m, of the centre of mass
    true = lgvi.Multirotor(
        arms + shift, UP, thrust, 4.5e-8, random.uniform(0.02, 0.06), spin, inertia=2e-5
    )
    model = Model(lgvi.RigidBody(3 * body_of(random, key)), gyroscope, rotors=true)
    known = lgvi.Multirotor(arms, UP, 3e-6, 1e-8, 0.03, spin, inertia=1e-6)
    flights = []
    for name in ("a", "b"):
        phases = np.outer(T, random.uniform(8, 30, 12)) + random.uniform(0, 6, 12)
        commands = 640 + 15 * np.sin(phases) @ random.normal(size=(12, count))
        values = {"angular_velocity": np.zeros((len(T), 3)), "rotor_speed": commands}
        flights.append(Recordings.from_arrays(T, **values, name=name))
    still = InitialStates.from_attitudes(jnp.tile(jnp.eye(3), (2, 1, 1)))
    flown = Recordings.concatenate(flights)
    flown = simulate_recordings(model, flown, still, key=jax.random.key(key))
    return Model(START, lgvi.Gyroscope(0.01), rotors=known), flown, count


def exchanged(recordings, order: Any = slice(None), signs=(1, 1, 1)):
    return Recordings.concatenate(
        Recordings.from_arrays(
            T,
            angular_velocity=each["angular_velocity"][1] * signs,
            rotor_speed=each["rotor_speed"][1][:, order],
            name=name,
        )
        for name, each in zip(recordings.names, recordings, strict=True)
    )


def test_rotors_in_another_order_and_mirrored_axes_are_named():
    logs = 100
    in_order = on_axes = accused = 0
    for key in range(logs):
        random = rng(304, key)
        model, log, count = drone(random, key)
        right = find_other_input(model, log)
        accused += right is not None or bool(why_no_body_moves_so(model, log))
        order = np.roll(random.permutation(count), key)
        order = order[::-1] if np.array_equal(order, np.arange(count)) else order
        words = f"`rotor_speed[:, {np.argsort(order).tolist()}]`"
        found = find_other_input(model, exchanged(log, order))
        in_order += found is not None and words in found.reading
        if found is None or words not in found.reading:
            print(f"log {key}: {words} taken for {found}")
        signs = [(1, -1, 1), (-1, 1, 1), (-1, -1, 1), (1, -1, -1)][key % 4]
        axes = ", ".join("-" * (sign < 0) + name for sign, name in zip(signs, "xyz", strict=True))
        found = find_other_input(model, exchanged(log, signs=signs))
        on_axes += found is not None and f"as ({axes})" in found.reading
        if found is None or f"as ({axes})" not in found.reading:
            print(f"log {key}: ({axes}) taken for {found}")
    print(f"orders named: {in_order}, axes: {on_axes} of {logs}; right logs accused: {accused}")
    assert min(in_order, on_axes) >= 95
    assert accused == 0
