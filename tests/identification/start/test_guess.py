"""Directions alone, from which attitudes and rates follow in part, or not at a time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import InitialStates, Model, Recordings, identify, simulate_recordings
from lgvi.identification.segments.segment import Window, whole_trajectories
from lgvi.identification.start import guess
from lgvi.identification.start.guess import guess_with_trials
from lgvi.identification.start.measured import Vectors, find_attitudes, largest_rates
from lgvi.identification.uncertainty.observability import describe_unseen_turns

from ...systems import rng, rotation
from ..recorded import ISOTROPIC, J, errors_of, ratios

FIELD, SUN = np.array([2e-5, 5e-6, -4e-5]), np.array([0.0, 0.6, 0.8])
T = np.arange(60) * 0.02
OMEGA = np.array([[2.0, -3.0, 1.0], [-3.0, 1.0, 2.0], [1.0, 2.0, 4.0]])
MAGNETOMETER = lgvi.Magnetometer(FIELD, 1e-7)


def tosses(sensors, key, t=T):
    """Recordings with noise, and the model that made them."""
    true = Model(lgvi.PhysicalRigidBody.from_inertia(J), sensors)
    R = np.stack([rotation(i, 140) for i in range(3)])
    states = InitialStates(jnp.asarray(R), jnp.asarray(OMEGA))
    return simulate_recordings(true, t, states, key=jax.random.key(key)), true


def assert_found(estimate, true):
    assert estimate.converged
    assert estimate.verdict == "the model holds"
    assert np.all(abs(errors_of(estimate, ratios, ratios(true))) < 4)
    assert np.max(estimate.standard_error(ratios)) < 3e-3
    np.testing.assert_allclose(estimate.states.omega, OMEGA, atol=0.1)


@pytest.mark.slow
def test_a_magnetometer_alone_shows_the_ratios_of_the_moments_and_the_rates():
    """And not how far the body is turned about the field, which is no degree of freedom."""
    recordings, true = tosses(MAGNETOMETER, 15)
    estimate = identify(Model(ISOTROPIC, MAGNETOMETER), recordings)
    assert_found(estimate, true)
    assert estimate.degrees_of_freedom == 3 * (60 * 3 - 5) - 5
    words = (
        "turn of the initial attitude about (-0.44, -0.11, 0.89) of space: a sensor of attitudes"
    )
    assert any(each.startswith(words) for each in estimate.unobservable)
    R = np.stack([rotation(i, 140) for i in range(3)])
    seen, expected = (np.swapaxes(each, 1, 2) @ FIELD for each in (estimate.states.R, R))
    np.testing.assert_allclose(seen, expected, atol=2e-7)


@pytest.mark.slow
def test_two_directions_show_attitudes_too():
    sun = lgvi.DirectionSensor(SUN, 5e-3)
    recordings, true = tosses([MAGNETOMETER, sun], 16)
    estimate = identify(Model(ISOTROPIC, [MAGNETOMETER, sun]), recordings)
    assert_found(estimate, true)
    assert len(estimate.unobservable) == 1  # the size
    R = Rotation.from_matrix(np.stack([rotation(i, 140) for i in range(3)]))
    error = (R.inv() * Rotation.from_matrix(np.array(estimate.states.R))).magnitude()
    assert np.max(error) < 0.01


@pytest.mark.slow
def test_a_field_that_turns_shows_how_far_the_body_is_turned():
    """Another start, from what was found, is needed for the turn about the field."""

    def field(t):
        return jnp.array([2e-5 * jnp.cos(0.3 * t), 2e-5 * jnp.sin(0.3 * t), -3e-5])

    turning = lgvi.Magnetometer(field, 3e-7)
    recordings, true = tosses(turning, 17, np.arange(200) * 0.03)
    estimate = identify(Model(ISOTROPIC, turning), recordings)
    assert_found(estimate, true)
    assert estimate.degrees_of_freedom == 3 * (200 * 3 - 6) - 5


def test_attitudes_follow_from_vectors_as_scipy_finds_them():
    random, t = rng(141), np.arange(20.0)
    R = Rotation.from_matrix(rotation(145)) * Rotation.from_rotvec(np.outer(t, [0.1, 0.2, 0.1]))
    known = np.repeat(random.normal(size=(3, 1, 3)), 20, axis=1)
    seen = [R.inv().apply(each) + 0.01 * random.normal(size=(20, 3)) for each in known]
    found = find_attitudes([Vectors.of(t, *pair) for pair in zip(seen, known, strict=True)])
    assert found is not None
    np.testing.assert_array_equal(found[0], t)
    for i in range(20):
        a, b = (np.stack([each[i] / np.linalg.norm(each[i]) for each in x]) for x in (known, seen))
        expected = Rotation.align_vectors(a, b)[0]
        np.testing.assert_allclose(found[1][i], expected.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("angle", [3.0, 15.0, 60.0, 90.0])
def test_the_speed_of_a_vector_is_that_across_it(angle, noise):
    """Also on a small circle about the axis of rotation, where it turns by no large angle."""
    t, across = np.arange(400) * 0.01, 4 * np.sin(np.radians(angle))
    start = [np.sin(np.radians(angle)), 0, np.cos(np.radians(angle))]
    seen = Rotation.from_rotvec(np.outer(t, [0, 0, 4.0])).apply(start)
    seen += noise * rng(144).normal(size=(400, 3))
    speed = Vectors.of(t, seen, np.tile(start, (400, 1))).speed()
    assert 0.6 * across < speed < 1.2 * across + 30 * noise


def test_a_slow_second_direction_gives_no_attitudes():
    """Of another sensor, between whose readings the body turns far."""
    t, omega = np.arange(300) * 0.01, np.array([3.0, -5.0, 6.0])
    R = Rotation.from_rotvec(np.outer(t, omega))
    fast = Vectors.of(t, R.inv().apply(FIELD), np.tile(FIELD, (300, 1)))
    slow = Vectors.of(t[::100], R.inv().apply(SUN)[::100], np.tile(SUN, (3, 1)))
    assert find_attitudes([fast, slow]) is None
    part = np.r_[0:100, 250:300]  # with a gap
    gap = Vectors.of(t[part], R.inv().apply(SUN)[part], np.tile(SUN, (150, 1)))
    found = find_attitudes([fast, gap])
    assert found is not None
    expected = R.as_matrix()[np.round(100 * found[0]).astype(int)]
    np.testing.assert_allclose(found[1], expected, atol=1e-12)


def test_vectors_that_are_parallel_or_apart_in_time_give_no_attitude():
    t, one = np.arange(5.0), np.tile([0.0, 0.0, 1.0], (5, 1))
    other, zero = np.tile([1.0, 0.0, 0.0], (5, 1)), np.zeros((5, 3))
    assert find_attitudes([Vectors.of(t, one, other)]) is None
    assert find_attitudes([Vectors.of(t, one, other), Vectors.of(t, -one, -other)]) is None
    assert find_attitudes([Vectors.of(t, one, other), Vectors.of(t + 9, other, one)]) is None
    assert len(Vectors.of(t, one, zero).t) == 0


@pytest.mark.parametrize("frame", ["space", "body"])
def test_of_one_direction_the_state_is_known_but_for_a_turn_and_a_rate_about_it(frame):
    """For a direction that moves in space and in the body: seen from one, known in the other."""
    R0, omega, spin = rotation(142), np.array([0.3, -1.0, 0.5]), np.array([0.2, 0.1, -0.3])
    t, u = np.arange(40) * 0.01, np.array([0.6, 0.0, 0.8])
    R = Rotation.from_matrix(R0) * Rotation.from_rotvec(np.outer(t, omega))
    known = Rotation.from_rotvec(np.outer(t, spin)).apply(u)
    seen = (R.inv() if frame == "space" else R).apply(known)

    def direction(t):
        return lgvi.so3.exp(t * jnp.asarray(spin)) @ jnp.asarray(u)

    sensor = lgvi.DirectionSensor(direction, 1e-3, frame)
    model = Model(ISOTROPIC, sensor)
    recordings = Recordings.from_arrays(t, direction=seen)
    speeds = largest_rates(model, recordings)
    states, trials = guess_with_trials(model, recordings, whole_trajectories(recordings), speeds)
    of_body = R0.T @ u if frame == "space" else u
    np.testing.assert_allclose(trials.axis[0], of_body, atol=1e-4)
    np.testing.assert_allclose(states.R[0] @ of_body, R0 @ of_body, atol=1e-4)
    # The turn about the direction that is missing, and the rate.
    missing = Rotation.from_matrix(states.R[0].T @ R0)
    np.testing.assert_allclose(np.cross(missing.as_rotvec(), of_body), 0, atol=1e-3)
    turned = missing.inv().apply(trials.turning[0])
    across = states.omega[0] - trials.turning[0] + turned
    np.testing.assert_allclose(np.cross(of_body, across), np.cross(of_body, omega), atol=2e-3)
    assert 0.5 < speeds[0] < 1.8
    assert trials.turns[0]
    # Not slower than states that are given.
    fast = InitialStates.from_rates([0.0, 30.0, 40.0])
    assert largest_rates(model, recordings, fast) == pytest.approx(50)


def test_states_of_windows_do_not_depend_on_how_many_are_guessed_at_once(monkeypatch):
    """And are rotations, also where a sensor's attitudes are so only about."""
    t = np.arange(20) * 0.05
    rates = np.array([[i, 1.0, 0.5] for i in range(5)])
    R = [Rotation.from_rotvec(np.outer(t, rate)).as_matrix() for rate in rates]
    recordings = Recordings.concatenate([Recordings.from_arrays(t, attitude=each) for each in R])
    model, windows = Model(ISOTROPIC, lgvi.AttitudeSensor(0.01)), whole_trajectories(recordings)
    scaled = lgvi.AttitudeSensor.guess_state
    monkeypatch.setattr(
        lgvi.AttitudeSensor, "guess_state", lambda *given: (1.0005 * scaled(*given)[0], None)
    )
    together, _ = guess_with_trials(model, recordings, windows, np.ones(5))
    monkeypatch.setattr(guess, "AT_ONCE", 2)
    apart, _ = guess_with_trials(model, recordings, windows, np.ones(5))
    np.testing.assert_allclose(together.omega, rates, atol=1e-2)
    for some, others in zip(jax.tree.leaves(together), jax.tree.leaves(apart), strict=True):
        np.testing.assert_allclose(some, others, atol=1e-12)
    np.testing.assert_allclose(np.swapaxes(apart.R, 1, 2) @ apart.R, [np.eye(3)] * 5, atol=1e-12)


def test_what_is_tried_is_all_turns_and_rates_about_the_vector():
    recordings, _ = tosses(MAGNETOMETER, 18)
    windows = [Window(i, -np.inf, np.inf) for i in range(3)]
    states, trials = guess_with_trials(
        Model(ISOTROPIC, MAGNETOMETER), recordings, windows, np.full(3, 4.0)
    )
    assert not np.any(trials.unknown)
    assert np.all(trials.rate)
    assert not np.any(trials.turns)  # of a constant field alone
    trials = trials._replace(turns=np.ones(3, bool))
    wanted = Rotation.from_matrix(states.R) * Rotation.from_rotvec(0.75 * np.pi * trials.axis)
    fast = states.omega + 6.0 * trials.axis

    def costs(tried):
        turned = np.sum((tried.R - wanted.as_matrix()) ** 2, axis=(1, 2))
        return turned + np.sum((tried.omega - fast) ** 2, axis=1)

    chosen = trials.choose(costs, states)
    np.testing.assert_allclose(costs(chosen), 0, atol=1e-20)


def test_a_plan_says_of_which_trajectories_a_turn_is_not_seen():
    turns, R = np.zeros((4, 3)), np.stack([rotation(i, 143) for i in range(4)])
    assert not list(describe_unseen_turns(turns, R))
    turns[1:3] = R[1:3].transpose(0, 2, 1) @ [0.0, 0.6, 0.8] * np.array([[1], [-1]])
    (words,) = describe_unseen_turns(turns, R)
    assert words.startswith(
        "turn of the initial attitude about (0.00, 0.60, 0.80) of space in 2 of 4"
    )
    turns[0] = [1.0, 0.0, 0.0]
    (words,) = describe_unseen_turns(turns, R)
    assert words.startswith("turn of the initial attitude about an axis of its own in 3 of 4")
