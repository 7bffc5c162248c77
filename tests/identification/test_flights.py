"""Flights under thrust and drag: mass, place of the accelerometer, thrust over mass, bad input."""

import re
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.identification import (
    InitialStates,
    Model,
    Recordings,
    identify,
    negative_log_likelihood,
    simulate_recordings,
)
from lgvi.identification.diagnosis.log_mistakes import find_other_force

from ..flights import (
    ARMS,
    CENTRE,
    DRAG,
    FRAME,
    GRAVITY,
    IN_PLANE,
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
from .recorded import errors_of

SIGMAS = {"angular_velocity": 0.01, "specific_force": 0.1, "position": 0.005, "velocity": 0.05}
NOTHING_KNOWN = lgvi.PhysicalRigidBody.from_principal_moments([4e-3] * 3)
ZERO = np.zeros(3)
INTEGRATOR = lgvi.MoserVeselovIntegrator(2.5e-3)
SIXTH_ORDER = lgvi.MoserVeselovIntegrator(0.01, order=6)
FLIGHTS, SAMPLES, LATE = 4, 60, ("specific_force", "position")


def rotors(
    thrust: Any = THRUST, centre: Any = CENTRE, in_plane_drag: Any = 0.0, inertia: Any = SPUN
):
    spin = [int(sense) for sense in SPIN]
    return lgvi.Multirotor(
        ARMS, UP, thrust, DRAG, None, spin, inertia, centre=centre, in_plane_drag=in_plane_drag
    )


def sensors(place=ZERO, **of_accelerometer):
    return [
        lgvi.Gyroscope(SIGMAS["angular_velocity"]),
        lgvi.Accelerometer(place, SIGMAS["specific_force"], **of_accelerometer),
        lgvi.PositionSensor(MARKER, SIGMAS["position"]),
        lgvi.VelocitySensor(SIGMAS["velocity"]),
    ]


def model_of(body=NOTHING_KNOWN, all_sensors=None, mass: Any = 0.7, drag=ZERO, **of_rotors):
    return Model(
        body,
        sensors() if all_sensors is None else all_sensors,
        rotors=rotors(**of_rotors),
        mass=mass,
        force=lgvi.AirDrag(drag),
        gravity=GRAVITY,
    )


TRUE = model_of(
    lgvi.PhysicalRigidBody.from_inertia(J), sensors(PLACE), MASS, FRAME, in_plane_drag=IN_PLANE
)


def recorded(flights, noise=1.0, late=0.0):
    """All readings; stamps of forces and positions are `late` seconds early."""
    random, stamps = rng(173), flights.t[1:] - late
    exact = flights.omega, flights.specific_force, flights.position, flights.velocity
    readings = {
        name: values + noise * sigma * random.normal(size=values.shape)
        for (name, sigma), values in zip(SIGMAS.items(), exact, strict=True)
    }

    def samples(name, values):
        return (stamps, values[1:]) if late and name in LATE else values

    return Recordings.concatenate(
        Recordings.from_arrays(
            flights.t,
            rotor_speed=(flights.t_speeds, speeds),
            **{name: samples(name, values[i]) for name, values in readings.items()},
            name=f"flight {i}",
        )
        for i, speeds in enumerate(flights.speeds)
    )


@pytest.fixture(scope="module")
def flights():
    return fly(3, FLIGHTS, SAMPLES)


@pytest.fixture(scope="module")
def log(flights):
    return recorded(flights)


def place(model):
    return model.sensors["specific_force"].position


def mass(model):
    return model.mass


def drag(model):
    return model.force.linear


def free(model):
    of_drag = model.force.linear, model.rotors.in_plane_drag
    return model.body, model.mass, place(model), model.rotors.thrust, *of_drag


def free_but_thrust(model):
    return model.body, model.mass, place(model), model.force.linear, model.rotors.in_plane_drag


def test_sensors_read_what_runge_and_kutta_say(flights):
    start = fly_states(flights)
    layout = recorded(flights, noise=0.0)
    simulated = simulate_recordings(TRUE, layout, start, INTEGRATOR)
    for channel, samples in layout.channels.items():
        scale = np.max(abs(samples.values))
        error = simulated.channels[channel].values - samples.values
        assert np.max(abs(error)) < 1e-4 * scale, channel


def fly_states(flights):
    """The states at the start: those of sensors without noise."""
    R = flights.R[:, 0]
    position = flights.position[:, 0] - R @ MARKER
    own = np.hstack([position, flights.velocity[:, 0]])
    return InitialStates(jnp.asarray(R), jnp.asarray(flights.omega[:, 0]), jnp.asarray(own))


@pytest.fixture(scope="module")
def estimate(log):
    return identify(model_of(), log, INTEGRATOR, free=free_but_thrust)


def test_a_flight_shows_mass_place_inertia_and_drag(estimate):
    assert estimate.converged
    assert estimate.verdict == "the model holds"
    for quantity, truth in ((mass, MASS), (place, PLACE), (drag, FRAME)):
        assert np.all(abs(errors_of(estimate, quantity, truth)) < 4)
    entries = lambda model: model.body.inertia[np.triu_indices(3)]  # noqa: E731
    assert np.all(abs(errors_of(estimate, entries, J[np.triu_indices(3)])) < 4)
    assert estimate.standard_error(mass) < 1e-3 * MASS
    assert np.all(estimate.standard_error(place) < 1e-3)


def excess_of_likelihood(estimate, log):
    """The negative log-likelihood at an estimate, less half the chi-square of the fit."""
    value = jax.jit(negative_log_likelihood(log, INTEGRATOR))(estimate.model, estimate.states)
    of_noise = sum(
        log.channels[channel].values.size * np.log(sigma) for channel, sigma in SIGMAS.items()
    )
    return float(value) - of_noise - estimate.chi_square / 2


def test_the_likelihood_is_that_of_the_fit(estimate, log):
    assert abs(excess_of_likelihood(estimate, log)) < 1e-6 * estimate.chi_square


@pytest.mark.slow
def test_the_likelihood_is_flat_at_the_estimate(estimate, log):
    """Its gradient, by reverse mode through the simulation, is that of the fit."""
    value = negative_log_likelihood(log, INTEGRATOR)

    @jax.jit
    def gradient(model):
        return jax.grad(lambda m: value(m, estimate.states))(model)

    at = gradient(estimate.model)
    for quantity in (mass, place, drag):
        gain = np.asarray(quantity(at)) * estimate.standard_error(quantity)
        assert np.all(abs(gain) < 0.02)
    error = float(estimate.standard_error(mass))
    beside = gradient(eqx.tree_at(mass, estimate.model, estimate.model.mass + 3 * error))
    assert beside.mass * error > 2


@pytest.mark.slow
def test_where_nothing_absolute_is_known_a_flight_shows_ratios(log):
    estimate = identify(
        model_of(thrust=2e-6), log, free=lambda m: (*free(m), m.rotors.drag, m.rotors.inertia)
    )
    assert estimate.converged
    (words,) = estimate.unobservable
    assert words.startswith("overall scale of the inertia, together with")
    assert words.endswith(
        "a known mass, a known torque or a rotor of known momentum would make it observable"
    )
    for name in ("`mass`", "`rotors.thrust`", "`force.linear`", "`rotors.in_plane_drag`"):
        assert name in words

    def ratio(model):
        return model.rotors.thrust / model.mass

    assert abs(errors_of(estimate, ratio, THRUST / MASS)) < 4
    assert estimate.standard_error(ratio) < 1e-3 * THRUST / MASS


def test_late_sensors_and_the_centre_between_the_rotors_show():
    """The centre of mass but along the axes of the rotors.

    Rotors without spin inertia: with it angular accelerations leap where speeds have kinks.
    """
    late, flights = 0.003, fly(3, FLIGHTS, SAMPLES, spun=0.0)
    all_sensors = sensors(time_offset=0.0)
    all_sensors[2] = lgvi.PositionSensor(MARKER, SIGMAS["position"], time_offset=0.0)

    def clocks(model):
        return tuple(model.sensors[name].time_offset for name in LATE)

    def also_clocks(model):
        return *free_but_thrust(model), model.rotors.centre, *clocks(model)

    start = model_of(all_sensors=all_sensors, centre=ZERO, inertia=0.0)
    log = recorded(flights, late=late)
    estimate = identify(start, log, INTEGRATOR, free=also_clocks)
    assert estimate.verdict == "the model holds"
    offsets = lambda model: jnp.stack(clocks(model))  # noqa: E731
    across = lambda model: model.rotors.centre[:2]  # noqa: E731
    truths = (offsets, [late, late]), (place, PLACE), (across, CENTRE[:2])
    for quantity, truth in truths:
        assert np.all(abs(errors_of(estimate, quantity, truth)) < 4)
    assert np.all(estimate.standard_error(offsets) < 1e-3)
    assert np.all(estimate.standard_error(across) < 1e-5)
    (words,) = estimate.unobservable
    assert words.startswith("rotors.centre[2]: rotors that are not parallel would make it")
    # Its steps are those without late clocks.
    assert abs(excess_of_likelihood(estimate, log)) < 0.2


@pytest.mark.slow
def test_segments_of_a_flight_join_to_the_whole(estimate, log):
    """Multiple shooting: the position and the velocity go on from segment to segment."""
    joined = identify(model_of(), log, INTEGRATOR, free=free_but_thrust, segment=0.3)
    assert joined.converged
    for quantity in (mass, place, drag):
        shift = np.asarray(quantity(joined.model)) - np.asarray(quantity(estimate.model))
        assert np.all(abs(shift) < 0.05 * estimate.standard_error(quantity))


def test_a_thrown_body_falls_as_for_a_sensor_of_its_own(flights):
    """In free flight the motion of the model is the parabola of a `PositionSensor`."""
    t, none = flights.t, np.zeros((len(flights.t), 3))
    level = np.tile(np.eye(3), (len(t), 1, 1))
    layout = Recordings.from_arrays(t, attitude=level, position=none)
    attitude, body = lgvi.AttitudeSensor(1e-3), lgvi.PhysicalRigidBody.from_inertia(J)
    models = [
        Model(body, [attitude, lgvi.PositionSensor(MARKER, 1e-3)], gravity=GRAVITY),
        Model(body, [attitude, lgvi.PositionSensor(MARKER, 1e-3, GRAVITY)]),
    ]
    x0, v0 = np.array([1.0, 2.0, 3.0]), np.array([0.5, -1.0, 4.0])
    start = InitialStates(flights.R[:1, 0], np.array([[4.0, 5.0, -3.0]]), np.append(x0, v0)[None])
    logs = [simulate_recordings(model, layout, start, key=jax.random.key(1)) for model in models]
    of_model, of_sensor = (log.channels["position"].values for log in logs)
    np.testing.assert_allclose(of_model, of_sensor, atol=1e-12)
    t = (t - t[0])[:, None]
    expected = x0 + t * v0 + t**2 / 2 * GRAVITY
    assert np.max(abs(of_model - expected)) < np.linalg.norm(MARKER) + 0.01

    def offset(model):
        return model.sensors["position"].offset

    estimates = [
        identify(model, log, SIXTH_ORDER, free=lambda m: (m.body, offset(m)))
        for model, log in zip(models, logs, strict=True)
    ]
    assert all(estimate.converged for estimate in estimates)
    of_model, of_sensor = (np.asarray(offset(estimate.model)) for estimate in estimates)
    np.testing.assert_allclose(of_model, of_sensor, atol=1e-9)
    first, second = (np.asarray(estimate.states.own) for estimate in estimates)
    np.testing.assert_allclose(first, second, atol=1e-9)


@pytest.mark.parametrize(
    ("factor", "mass", "words"),
    [
        (1 / 9.80665, 0.7, "the specific forces in g"),
        (-1.0, 0.4, "the specific forces with opposite signs"),
        (1.0, 600.0, "the mass in grams"),
        (1.0, 0.9, None),
    ],
)
def test_units_of_forces_are_named(flights, factor, mass, words):
    changed = flights._replace(specific_force=factor * flights.specific_force)
    mistake = find_other_force(model_of(mass=mass), recorded(changed, noise=0.1))
    if words is None:
        assert mistake is None
    else:
        assert cast(Any, mistake).reading == words
        assert cast(Any, mistake).better > 5


def test_mass_properties_have_the_mass():
    properties = lgvi.MassProperties(1.5, ZERO, J)
    model = Model(NOTHING_KNOWN, lgvi.Gyroscope(0.1), mass=properties)
    assert float(cast(Any, model.mass)) == 1.5


def test_a_model_has_what_its_sensors_feel(log):
    t, none = np.arange(3.0), np.zeros((3, 3))
    log_of_imu = Recordings.from_arrays(
        t, angular_velocity=none, specific_force=none, rotor_speed=np.ones((3, 4))
    )

    def simulate(*arguments, **options):
        model = Model(NOTHING_KNOWN, *arguments, **options)
        simulate_recordings(model, np.arange(3.0), InitialStates.from_rates(np.ones(3)))

    def refused(words, *arguments, **options):
        with pytest.raises(ValueError, match=re.escape(words)):
            simulate(*arguments, **options)

    gyroscope, force = lgvi.Gyroscope(0.1), lgvi.AirDrag(0.1)
    refused("`mass` must be given where there is a `force`", gyroscope, force=force)
    refused("`gravity` of the model must be given", gyroscope, force=force, mass=1.0)
    refused("`mass` must be above 0 kg and finite, but is -1", gyroscope, mass=-1.0)
    refused("`mass` must be above 0 kg and finite, but is nan", gyroscope, mass=np.nan)
    refused("`gravity` must have shape (3,)", gyroscope, gravity=[9.81])
    refused("no NaN, but its `gravity`", gyroscope, gravity=[0, 0, np.nan])
    needs = "of the centre of mass needs a model with a `gravity`"
    refused(f"position {needs}", lgvi.PositionSensor(ZERO, 0.1))
    refused(f"velocity {needs}", lgvi.VelocitySensor(0.1))
    falling = lgvi.PositionSensor(ZERO, 0.1, GRAVITY)
    refused("`PositionSensor` of `position` must be None", falling, gravity=GRAVITY)
    pivoted = lgvi.Accelerometer(ZERO, 0.1, GRAVITY)
    refused("`Accelerometer` of `specific_force` must be None", pivoted, mass=1.0)
    with pytest.raises(ValueError, match="`drag` must be None where `gravity` is None"):
        lgvi.PositionSensor(ZERO, 0.1, drag=0.1)
    of_imu = sensors()[:2], None, log_of_imu
    for some_sensors, gravity, some in ((sensors(), GRAVITY, log), of_imu):
        without_mass = Model(NOTHING_KNOWN, some_sensors, rotors=rotors(), gravity=gravity)
        with pytest.raises(ValueError, match="`mass` of the model must be given where it has `ro"):
            identify(without_mass, some)
    push = lgvi.Thruster(PLACE, UP)
    words = "`mass` of the model must be given where it has a `torque` with a force"
    refused(words, lgvi.Accelerometer(ZERO, 0.1), torque=push)
    refused(words, lgvi.VelocitySensor(0.1), torque=push, gravity=GRAVITY)
    sampled = lgvi.AppliedForce(lgvi.SampledVector(np.array([0.5, 3.0]), np.ones((2, 3))))
    with pytest.raises(RuntimeError, match="`t` of a `SampledVector` must cover"):
        simulate(gyroscope, force=sampled, mass=1.0, gravity=GRAVITY)
    in_plane = Model(NOTHING_KNOWN, sensors()[:2], rotors=rotors(in_plane_drag=1e-5), mass=1.0)
    with pytest.raises(ValueError, match="`gravity` of the model must be given"):
        simulate_recordings(in_plane, log_of_imu, InitialStates.from_rates(np.ones(3)))
