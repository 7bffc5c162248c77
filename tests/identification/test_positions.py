"""Positions of a tracked point, which show where the centre of mass is."""

import re
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import (
    InitialStates,
    Model,
    Recordings,
    identifiability,
    identify,
    identify_jointly,
    negative_log_likelihood,
    simulate_recordings,
)
from lgvi.identification.segments.levels import cut_into_levels
from lgvi.identification.start.guess import guess_states
from lgvi.identification.start.measured import largest_rates

from ..systems import euler_equations, rng
from .recorded import ISOTROPIC, SIGMA_R, J, errors_of, ratios

OFFSET, GRAVITY, SIGMA = np.array([3e-3, -2e-3, 8e-3]), np.array([0.0, 0.0, -9.81]), 2e-4
TOSSES = 6


def sensor_of(model):
    return model.sensors["position"]


def offset(model):
    return sensor_of(model).offset


def free(model):
    return model.body, offset(model), sensor_of(model).gravity_scale


def start(**options):
    """What is known before: of the body nothing."""
    position = lgvi.PositionSensor(np.zeros(3), SIGMA, GRAVITY, **options)
    return Model(ISOTROPIC, [lgvi.AttitudeSensor(SIGMA_R), position])


@pytest.fixture(scope="module")
def flights():
    """Tosses by SciPy, which begin at different places and hours; gravity is 2 % weaker."""
    random, t, tosses, states = rng(120), np.arange(50) * 0.02, [], []
    for i in range(TOSSES):
        omega, (x, v) = 3 * random.normal(size=3), random.normal(size=(2, 3))
        R, _ = euler_equations(Rotation.random(rng=random).as_matrix(), J @ omega, J, t)
        seen = Rotation.from_matrix(R) * Rotation.from_rotvec(SIGMA_R * random.normal(size=(50, 3)))
        place = x + np.outer(t, v) + np.outer(t**2 / 2, 0.98 * GRAVITY) + R @ OFFSET
        place += SIGMA * random.normal(size=(50, 3))
        hour = 3600.0 * i
        tosses.append(Recordings.from_arrays(hour + t, attitude=seen, position=place, name=str(i)))
        states.append(np.concatenate([x, v]))
    return Recordings.concatenate(tosses), np.stack(states)


@pytest.fixture(scope="module")
def estimate(flights):
    return identify(start(), flights[0], free=free)


def test_the_centre_of_mass_and_gravity_are_found_with_their_errors(flights, estimate):
    assert estimate.converged
    assert np.all(abs(errors_of(estimate, offset, OFFSET)) < 4)
    assert abs(errors_of(estimate, lambda model: sensor_of(model).gravity_scale, 0.98)) < 4
    assert np.all(abs(errors_of(estimate, ratios, np.linalg.eigvalsh(J) / np.trace(J))) < 4)
    assert estimate.standard_error(offset).max() < 1e-4  # m
    assert estimate.chi_square / estimate.degrees_of_freedom == pytest.approx(1, abs=0.1)
    # Beside the inertia, the offset and gravity: 12 numbers of each toss.
    assert estimate.degrees_of_freedom == TOSSES * (50 * 6 - 12) - 5 - 4
    own, true = np.asarray(estimate.states.own), flights[1]
    assert np.max(abs(own - true)[:, :3]) < 4e-4  # m
    assert np.max(abs(own - true)[:, 3:]) < 4e-3  # m/s
    np.testing.assert_array_equal(sensor_of(estimate.own).velocity, own[:, 3:])
    assert "position.offset[0]" in str(estimate)


def test_what_was_estimated_simulates_the_same_again(flights, estimate):
    made = simulate_recordings(estimate.model, flights[0], estimate.states)
    for (_, simulated), part in zip(
        made.channels["position"],
        np.split(estimate.predicted["position"], TOSSES),
        strict=True,
    ):
        np.testing.assert_allclose(simulated, part, atol=1e-7)


@pytest.mark.slow
def test_the_likelihood_is_largest_at_the_estimate(flights, estimate):
    value = negative_log_likelihood(flights[0], lgvi.MoserVeselovIntegrator(0.02, order=6))

    @jax.jit
    @partial(jax.value_and_grad, argnums=(0, 1))
    def at(place, phi):
        model = eqx.tree_at(offset, estimate.model, place)
        return value(model, estimate.states.moved(phi))

    place, still = offset(estimate.model), jnp.zeros((TOSSES, 12))
    least, slopes = at(place, still)
    assert np.max(abs(slopes[0])) < 1e-3 / SIGMA
    assert np.max(abs(slopes[1][:, 6:9])) < 1e-3 / SIGMA
    assert at(place, still.at[:, 6].set(SIGMA))[0] > least + 1
    assert estimate.states.moved(still[:, :6]).own is estimate.states.own


@pytest.mark.slow
def test_segments_and_configurations_give_the_same(flights, estimate):
    recordings, _ = flights
    parts = {
        name: (lambda model: model, recordings.select(names))
        for name, names in {"first": ["0", "1"], "second": ["2", "3", "4", "5"]}.items()
    }
    for other, found in (
        (identify(start(), recordings, free=free, segment=0.3), lambda each: each.model),
        (identify_jointly(start(), parts, free=free), lambda each: each.parameters),
    ):
        assert other.converged
        error = np.asarray(estimate.standard_error(offset))
        assert np.all(abs(offset(found(other)) - offset(estimate.model)) < 0.02 * error)
        np.testing.assert_allclose(other.chi_square, estimate.chi_square, rtol=1e-4)


@pytest.mark.slow
def test_the_verdict_names_what_could_be_why_gravity_does_not_fit(flights):
    found = identify(start(), flights[0], free=lambda model: (model.body, offset(model)))
    for suspect in ("position.gravity_scale", "position.length_scale", "time_scale"):
        assert f"`{suspect}`" in found.verdict
    assert "position.drag" in str(found)


@pytest.mark.slow
def test_a_plan_counts_what_each_trajectory_begins_with():
    """What is along the axis of a steady rotation is no more than a place of the body."""
    t, body = np.arange(60) * 0.02, lgvi.PhysicalRigidBody.from_principal_moments([1, 2, 2.5])
    model = Model(body, list(start().sensors.values()))
    states = InitialStates.from_rates([0.0, 0.0, 5.0])
    planned = identifiability(model, t, states, free=offset)
    assert any("position.offset[2]" in words for words in planned.unobservable)
    tumbling = InitialStates.from_rates([4.0, 3.0, 5.0])
    planned = identifiability(model, t, tumbling, free=offset)
    assert not planned.unobservable
    # With places and velocities known the error would be SIGMA / sqrt(60).
    assert np.all(planned.standard_error(offset) > 1.1 * SIGMA / np.sqrt(60))


@pytest.mark.slow
def test_of_two_configurations_one_may_have_positions(flights):
    """The other has states without numbers of their own."""
    recordings, _ = flights
    later = recordings.select(["3", "4", "5"])
    attitudes = replace(later, channels=type(later.channels)(attitude=later.channels["attitude"]))

    def alone(model):
        return Model(model.body, model.sensors["attitude"])

    parts = {
        "with": (lambda model: model, recordings.select(["0", "1", "2"])),
        "without": (alone, attitudes),
    }
    found = identify_jointly(start(), parts, free=free)
    assert found.converged
    assert found.parts["without"].states.own is None
    assert np.all(abs((offset(found.parameters) - OFFSET) / found.standard_error(offset)) < 4)


def test_what_each_trajectory_begins_with_cannot_be_free(flights):
    with pytest.raises(ValueError, match=r"`position\.velocity` must not be free, .* its own"):
        identify(start(), flights[0], free=lambda model: sensor_of(model).velocity)


def test_states_must_have_the_numbers_of_the_sensors(flights):
    states = InitialStates(np.tile(np.eye(3), (6, 1, 1)), np.ones((6, 3)), np.zeros((6, 3)))
    with pytest.raises(
        ValueError, match=r"`states` must have `own` of shape \(6, 6\), .* \(6, 3\)"
    ):
        simulate_recordings(start(), flights[0], states)
    states = replace(states, own=np.full((6, 6), np.nan))
    with pytest.raises(ValueError, match="`states` must have finite `own`"):
        simulate_recordings(start(), flights[0], states)
    with pytest.raises(ValueError, match=r"must have None as `own`, as nothing in the model has"):
        simulate_recordings(Model(ISOTROPIC, lgvi.Gyroscope(1.0)), np.arange(3.0), states)


class Drifting(lgvi.AbstractSensor):
    """A place that moves; but after some time its velocity has another shape, and its guess too."""

    channel, unit, axes = "position", "m", ("x", "y", "z")
    shapes, depends_on_attitude = ((3,),), False
    state_fields = ("position", "velocity")

    sigma: Array
    loss: lgvi.AbstractLoss | None
    position: Array
    velocity: Array

    def predict(self, state):
        return self.position + state.elapsed * self.velocity

    def compute_residual(self, predicted, measured):
        return (measured - predicted) / self.sigma

    def add_noise(self, predicted, noise):
        return predicted + self.sigma * noise

    def guess_state(self, readings):
        return None, None

    def guess_fields(self, t, readings):
        return {"position": np.zeros(3), "speed": np.zeros(3)}

    def advance(self, duration):
        return eqx.tree_at(lambda sensor: sensor.velocity, self, jnp.zeros(2))

    @staticmethod
    def from_columns(columns):
        return columns

    @staticmethod
    def as_curves(readings):
        return "place (m)", {}


def test_a_state_keeps_its_shape_and_has_the_names_of_fields(flights):
    sensor = Drifting(jnp.asarray(SIGMA), None, jnp.zeros(3), jnp.zeros(3))
    model = Model(ISOTROPIC, [lgvi.AttitudeSensor(SIGMA_R), sensor])
    states = InitialStates(np.tile(np.eye(3), (6, 1, 1)), np.ones((6, 3)), np.zeros((6, 6)))
    words = r"`advance` of `Drifting` must keep the shape \(3,\) of `velocity`, but gives \(2,\)"
    with pytest.raises(ValueError, match=words):
        simulate_recordings(model, flights[0], states)
    with pytest.raises(ValueError, match="`guess_fields` of `Drifting` must give the shapes"):
        identify(model, flights[0])


@pytest.mark.parametrize("names", ["position", ("place",), ("sigma",), ("loss",), (3,)])
def test_names_of_states_that_are_none_are_told(names):
    class Named(Drifting):
        state_fields = names

    with pytest.raises(TypeError, match="The class attribute `state_fields` of `Named` must"):
        Model(ISOTROPIC, Named(jnp.ones(()), None, jnp.zeros(3), jnp.zeros(3)))


OF_SPACE = r"`gravity` as \(0, 0, -9.81\)"


@pytest.mark.parametrize(
    ("factor", "times", "gravity", "words"),
    [
        (1e3, 1.0, GRAVITY, "the positions as millimetres"),
        (100.0, 1.0, GRAVITY, "the positions as centimetres"),
        (1 / 0.0254, 1.0, GRAVITY, "the positions as inches"),
        (1.0, 1e3, GRAVITY, "the times as milliseconds"),
        (1.0, 1e6, GRAVITY, "the times as microseconds"),
        (1.0, 1 / 60, GRAVITY, "the times as minutes"),
        (
            7.0,
            1.0,
            GRAVITY,
            "the positions 6.8.* times too large, or the times 0.3.* times too large",
        ),
        (1.0, 1.0, -GRAVITY, OF_SPACE),
        (1.0, 1.0, np.array([0.0, -9.81, 0.0]), OF_SPACE),
        (1.0, 1.0, 0.9 * GRAVITY, None),
        (1.0, 1.0, np.zeros(3), None),
    ],
)
def test_a_wrong_unit_or_a_wrong_gravity_is_named(flights, factor, times, gravity, words):
    sensor = lgvi.PositionSensor(np.zeros(3), SIGMA, gravity)
    found = sensor.find_mistake((times * t, factor * p) for t, p in flights[0].channels["position"])
    if words is None:
        assert found is None
    else:
        assert found is not None
        assert re.fullmatch(words, found[0])
        assert found[1] > 100


def test_positions_at_rest_tell_no_unit():
    sensor = lgvi.PositionSensor(np.zeros(3), SIGMA, GRAVITY)
    for key in range(50):
        noise = SIGMA * rng(151, key).normal(size=(40, 3)) * [0.1, 0.1, 1.0]
        assert sensor.find_mistake(iter([(np.arange(40) * 0.01, noise)])) is None


def test_a_usual_mistake_is_told_before_the_fit(flights):
    recordings = flights[0].select(["0", "1"])
    position = recordings.channels["position"]
    wrong = eqx.tree_at(
        lambda made: made.channels["position"].values, recordings, 1e3 * position.values
    )
    with pytest.warns(UserWarning, match="usual mistake, it seems: reading the positions as milli"):
        identify(start(), wrong, free=offset, iterations=1, check=False)


def test_each_trajectory_is_read_once_for_a_guess(flights, monkeypatch):
    """It may be in a file."""
    recordings, read = flights[0], []

    def reader(self):
        trajectories = list(self)

        def of(number):
            read.append(number)
            return trajectories[number]

        return of

    monkeypatch.setattr(Recordings, "reader", reader)
    model, speeds = start(), largest_rates(start(), recordings)
    cut = cut_into_levels(recordings, speeds)[0]
    assert len(cut) > len(recordings)
    guess_states(model, recordings, cut, speeds)
    assert read == list(range(len(recordings)))
