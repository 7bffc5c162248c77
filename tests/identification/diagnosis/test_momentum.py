"""The balance of the angular momentum on the recordings: inputs that are misread, unknown torques.

The motions are solutions of Euler's equations by SciPy.
"""

import re
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import Model, Recordings, identify
from lgvi.identification.diagnosis.log_mistakes import find_mistake, find_other_input
from lgvi.identification.diagnosis.momentum import describe_residual_torque, why_no_body_moves_so
from lgvi.modules.torques.law import as_law, call

from ...systems import euler_equations, inertia, rng, rotation
from ..recorded import SIGMA_R, SIGMA_W, J, trajectory

SAMPLES, DT = 400, 0.01
T = np.arange(SAMPLES) * DT
SENSORS = lgvi.AttitudeSensor(SIGMA_R), lgvi.Gyroscope(SIGMA_W)
READ = {"both": (True, True), "attitudes": (True, False), "rates": (False, True)}
SIZE = np.trace(J)  # of torques, N m


def waves(random, size):
    """A smooth function of time, with three numbers."""
    frequency, phase = random.uniform(1, 8, (6, 3)), random.uniform(0, 6, (6, 3))
    amplitude = size * random.normal(size=(6, 3)) / 3
    return lambda t: np.sum(amplitude * np.sin(np.multiply.outer(t, frequency) + phase), axis=-2)


def moving(key, read, **acting):
    attitudes, rates = READ[read]
    return trajectory(key, SAMPLES, DT, attitudes, rates, speed=(1, 4), **acting)


def model(read, body: Any = None):
    attitudes, rates = READ[read]
    return Model(body, SENSORS[not attitudes : 1 + rates])


AXES = {
    None: np.eye(3),
    "(-x, y, z)": np.diag([-1, 1, 1]),
    "(-x, -y, -z)": -np.eye(3),
    "(z, x, y)": np.eye(3)[[1, 2, 0]],
}


@pytest.mark.parametrize("read", READ)
@pytest.mark.parametrize("name", ["body_torque", "rotor_momentum"])
def test_other_axes_of_a_recorded_input_are_named(name, read):
    for key in range(2):
        values = waves(rng(230, key), SIZE)
        acting = {"rotor": values}
        if name == "body_torque":
            acting = {"torque": lambda t, R, omega, values=values: values(t)}
        (read_right,) = moving(key, read, **acting)
        channels = {channel: samples for channel, (_, samples) in read_right.items()}
        for axes, S in AXES.items():
            recordings = Recordings.from_arrays(T, **channels, **{name: values(T) @ S.T})
            mistake = find_other_input(model(read), recordings)
            assert (mistake and mistake.reading) == (axes and f"the axes of `{name}` as {axes}")


def test_a_slender_body_in_any_direction_is_not_accused():
    """Its inertia is made of mass in one direction alone."""
    for key in range(3):
        random = rng(234, key)
        values, slender = waves(random, SIZE / 9), inertia([1e-4, 1e-3, 1e-3], rotation(235 + key))

        def torque(t, R, omega, values=values):
            return values(t)

        _, pi = euler_equations(np.eye(3), slender @ random.normal(size=3), slender, T, torque)
        rates = np.linalg.solve(slender, pi.T).T + SIGMA_W * random.normal(size=(SAMPLES, 3))
        for axes, S in AXES.items():
            acting = {"body_torque": values(T) @ S.T}
            recordings = Recordings.from_arrays(T, angular_velocity=rates, **acting)
            mistake = find_other_input(model("rates"), recordings)
            assert (mistake and mistake.reading) == (
                axes and f"the axes of `body_torque` as {axes}"
            )


def test_what_acts_is_tried_only_where_it_can_be():
    """Not with a torque law; and a log may have less samples than columns."""
    (read,) = moving(0, "rates", torque=lambda t, R, omega: -20 * SIZE * omega)
    t, rates = read["angular_velocity"]
    turned = Recordings.from_arrays(t, angular_velocity=rates, body_torque=waves(rng(236), SIZE)(t))
    damped = Model(SENSORS[1], torque=lgvi.LinearDamping(20 * SIZE * np.eye(3)))
    assert find_other_input(damped, turned) is None
    steady = Recordings.from_arrays(t, angular_velocity=rates, body_torque=np.ones((SAMPLES, 3)))
    assert find_other_input(model("rates"), steady) is None
    random = rng(237)
    arms, up = random.normal(size=(16, 3)), np.array([0.0, 0.0, 1.0])
    rotors = lgvi.Multirotor(arms, up, 1e-6, 1e-8, None, (1, -1) * 8)
    speeds = random.uniform(500, 600, (9, 16))
    short = Recordings.from_arrays(t[:9], angular_velocity=rates[:9], rotor_speed=speeds)
    assert find_other_input(Model(SENSORS[1], rotors=rotors), short) is None
    # A lag may be below zero after a fit.
    speeds = random.uniform(500, 600, (SAMPLES, 16))
    late = lgvi.Multirotor(arms, up, 1e-6, 1e-8, 0.1, (1, -1) * 8)
    late = Model(SENSORS[1], rotors=eqx.tree_at(lambda r: r.lag, late, jnp.asarray(-1e-3)))
    flown = Recordings.from_arrays(t, angular_velocity=rates, rotor_speed=speeds)
    assert find_other_input(late, flown) is None


def hand(key, read):
    """A body that is turned by hand: its rates are any function of time."""
    random, fine = rng(231, key), 10
    rates = waves(random, 3.0)
    middles = (np.arange(fine * SAMPLES) + 0.5) * DT / fine
    R, attitudes = Rotation.identity(), []
    for k, turn in enumerate(Rotation.from_rotvec(rates(middles) * DT / fine)):
        if k % fine == 0:
            attitudes.append(R)
        R = R * turn
    noise = random.normal(size=(2, SAMPLES, 3))
    values = {
        "attitude": Rotation.concatenate(attitudes) * Rotation.from_rotvec(SIGMA_R * noise[0]),
        "angular_velocity": rates(T) + SIGMA_W * noise[1],
    }
    channels = model(read).sensors
    return Recordings.from_arrays(T, **{name: values[name] for name in channels})


@pytest.mark.parametrize("read", READ)
def test_what_no_rigid_body_does_is_told_before_a_fit(read):
    for key in range(2):
        assert re.fullmatch(
            "no rigid body moves so unless an unknown torque acts, such as that of a hand: while "
            r"it turns by 1\.5 rad, \d\d% of its angular momentum changes without a recorded "
            "cause, for any inertia",
            why_no_body_moves_so(model(read), hand(key, read)),
        )
        free = moving(key, read)
        assert why_no_body_moves_so(model(read), free) == ""
        at_rest = moving(key, read, torque=lambda t, R, omega: -5 * SIZE * omega)
        assert why_no_body_moves_so(model(read), at_rest.crop(3.0)) == ""


DIRECTION = SIZE * np.array([0.3, -0.2, 0.4])
LAWS = {
    "a constant torque in the body": lambda t, R, omega: DIRECTION,
    "one in space": lambda t, R, omega: R.T @ DIRECTION,
    "the rates": lambda t, R, omega: -0.2 * SIZE * omega,
    "time": lambda t, R, omega: DIRECTION * (t - T.mean()),
}


@pytest.mark.parametrize("cause", LAWS)
@pytest.mark.parametrize("read", ["attitudes", "rates"])
def test_what_a_residual_torque_goes_with_is_told(read, cause):
    fitted = model(read, lgvi.RigidBody(J))
    recordings = moving(0, read, torque=LAWS[cause], noise=0.1)
    words = describe_residual_torque(fitted, recordings)
    parts = {name: int(part) for part, name in re.findall(r"(\d+)% with ([a-z ]+)", words)}
    assert parts.keys() == LAWS.keys()
    assert parts[cause] > 95
    assert parts[cause] == max(parts.values())
    assert describe_residual_torque(fitted, moving(0, read, noise=0.1)) == ""


MODELS = {
    "linear damping": lgvi.LinearDamping(0.2 * SIZE * np.eye(3)),
    "quadratic damping": lgvi.QuadraticDamping(0.1 * SIZE * np.eye(3)),
    "gravity gradient": lgvi.GravityGradient(1.0, np.array([1.0, 0.0, 0.0])),
    "of the attitude": lambda t, R: R.T @ DIRECTION,
    "of the rate": lambda t, R, omega: jnp.cross(omega, DIRECTION),
}


@pytest.mark.parametrize("law", MODELS)
def test_a_torque_that_the_model_knows_is_no_residual_torque(law):
    body = lgvi.RigidBody(J)
    acting = as_law("torque", MODELS[law]).of_body(body)
    recordings = moving(
        0, "attitudes", torque=lambda t, R, omega: np.asarray(call(acting, t, R, omega)), noise=0.1
    )
    knowing = Model(body, SENSORS[0], torque=MODELS[law])
    assert describe_residual_torque(knowing, recordings) == ""
    assert describe_residual_torque(model("attitudes", body), recordings) != ""


def test_a_mistake_that_the_time_scale_mends_is_none():
    (read,) = moving(0, "both")
    (t, R), (_, rates) = read["attitude"], read["angular_velocity"]
    in_ms = Recordings.from_arrays(1e3 * t, attitude=R, angular_velocity=rates)
    assert find_mistake(model("both"), in_ms) is not None
    assert find_mistake(Model(SENSORS, time_scale=1e-3), in_ms) is None


@pytest.mark.slow
def test_a_sign_of_a_rotor_that_is_fitted_is_no_mistake():
    """Before the fit it looks like one."""
    values = waves(rng(238), SIZE)
    recordings = moving(0, "both", rotor=values, rotor_momentum=values)
    start = Model(SENSORS, rotor_inertia=-0.5)
    with pytest.warns(UserWarning, match="`rotor_momentum`"):
        estimate = identify(
            start, recordings, free=lambda m: (m.body, m.rotor_inertia), check=False
        )
    assert estimate.mistakes == ()


@pytest.mark.slow
def test_a_fit_that_is_in_vain_is_stopped_early():
    estimate = identify(model("both"), hand(0, "both"))
    assert estimate.iterations <= 30
    assert not estimate.converged
    assert estimate.verdict.startswith("the model does not hold: no rigid body moves so unless")
    assert "times the gyroscopic torque" in " ".join(str(estimate).split())
    assert any("as no fit can be good before" in words for words in estimate.messages)
