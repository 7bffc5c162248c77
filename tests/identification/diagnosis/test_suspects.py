"""What an estimate says of itself where recordings, model or start leave doubts."""

import re
import threading
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import (
    InitialStates,
    Model,
    Recordings,
    identifiability,
    identify,
    initial_states,
)
from lgvi.identification.running.progress import Progress
from lgvi.identification.uncertainty.observability import ENTRIES, rotation_that_shows

from ...systems import euler_equations, rng
from ..recorded import ISOTROPIC, MODEL, MOMENTS, SIGMA_R, J, ratios, trajectories, trajectory

T = np.arange(50) * 0.04


def steady(axis, key, gyroscope=False):
    """A recording of a body that spins about one of its principal axes, with noise."""
    omega = 3 * np.linalg.eigh(J)[1][:, axis]
    R, _ = euler_equations(np.eye(3), J @ omega, J, T)
    noise = rng(170, key).normal(size=(50, 3)) * SIGMA_R
    if gyroscope:
        return Recordings.from_arrays(T, angular_velocity=omega + noise)
    return Recordings.from_arrays(T, attitude=Rotation.from_matrix(R) * Rotation.from_rotvec(noise))


@pytest.mark.parametrize(
    ("axis", "gyroscope"),
    [
        (2, False),
        pytest.param(0, False, marks=pytest.mark.slow),
        pytest.param(2, True, marks=pytest.mark.slow),
    ],
)
def test_of_a_steady_spin_all_is_named_that_it_does_not_show(axis, gyroscope):
    sensor = lgvi.Gyroscope(SIGMA_R) if gyroscope else lgvi.AttitudeSensor(SIGMA_R)
    estimate = identify(Model(ISOTROPIC, sensor), steady(axis, axis, gyroscope))
    scale, *others = estimate.unobservable
    # Five ratios, of which the spin shows that two products about its axis vanish.
    assert scale.startswith("overall scale of the inertia")
    assert len(others) == 3
    assert all("a rotation about the body axis (" in words for words in others)
    assert any("start fits as well" in message for message in estimate.messages)
    # The table has no interval for what is noise, whichever number that is in.
    table = estimate.summary()
    shown = dict(zip(table["name"], np.isfinite(table["standard_error"]), strict=True))
    named = {name for name in shown for words in others if f"{name} " in f"{words.split(':')[0]} "}
    assert len(named) > 2
    assert not any(shown[name] for name in named)
    assert not any(known for name, known in shown.items() if "moment" in name)


def test_of_three_samples_more_is_unknown_than_the_scale():
    estimate = identify(MODEL, trajectory(3, samples=3, interval=0.05))
    assert estimate.degrees_of_freedom == 0
    assert len(estimate.unobservable) >= 3  # nine numbers, six of which are the initial state
    assert all("a rotation about" in words for words in estimate.unobservable[1:])


def test_where_the_inertia_is_known_nothing_more_is_named(estimate):
    (words,) = estimate.unobservable
    assert words.startswith("overall scale of the inertia")


@pytest.mark.slow
def test_an_experiment_says_before_what_it_would_show_only_roughly():
    body = lgvi.PhysicalRigidBody.from_inertia(J)
    omega = 3 * np.linalg.eigh(J)[1]
    for turned, count in ((omega[:, 2], 3), (omega @ np.array([0.6, 0.5, 0.6]), 0)):
        states = InitialStates.from_rates(turned)
        plan = identifiability(Model(body, lgvi.AttitudeSensor(SIGMA_R)), T, states)
        assert len(plan.unobservable) == 1 + count


@pytest.mark.parametrize("seed", range(5))
def test_the_rotation_that_is_named_shows_a_change_of_the_inertia_best(seed):
    random = rng(171, seed)
    entries = random.normal(size=6)
    change = np.zeros((3, 3))
    for (i, j), entry in zip(ENTRIES.values(), entries, strict=True):
        change[i, j] = change[j, i] = entry
    words = rotation_that_shows(entries)
    axis = np.array([float(x) for x in words[words.index("(") + 1 : -1].split(",")])
    axes = random.normal(size=(1000, 3))

    def torque(axis):
        axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
        return np.linalg.norm(np.cross(axis, axis @ change), axis=-1)

    assert torque(axis) > 0.99 * np.max(torque(axes))


@pytest.mark.slow
def test_fits_from_other_starts_tell_that_the_model_leaves_something_out():
    pushed = trajectories(3, samples=100, torque=lambda *_: np.array([2e-4, 0, -1e-4]))
    estimate = identify(MODEL, pushed)
    worse = next(words for words in estimate.messages if "times worse than windows" in words)
    assert "fits from 3 different starts end in this minimum" in worse
    assert "the model leaves something out" in worse


def test_a_wrong_minimum_is_left_for_that_of_another_start():
    recordings = trajectories(3, samples=100)
    states = initial_states(MODEL, recordings)
    states = InitialStates(states.R, states.omega + jnp.array([[0, 0, 30.0]]))
    estimate = identify(MODEL, recordings, start=states)
    assert estimate.messages == (
        "Of 3 starts 2 ended in this minimum, and 1 in a minimum with a larger chi-square.",
    )
    np.testing.assert_allclose(ratios(estimate.model), MOMENTS / MOMENTS.sum(), atol=1e-4)


def test_a_fit_that_is_stopped_says_what_it_had_reached_and_leaves_nothing_behind(
    tosses, monkeypatch
):
    iteration: Any = Progress.iteration
    reached = []

    def stopped(self, cost, theta):
        iteration(self, cost, theta)
        reached.append(theta)
        if len(reached) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(Progress, "iteration", stopped)
    with pytest.raises(
        KeyboardInterrupt, match="stopped after 3 iterations, at chi_square"
    ) as told:
        identify(MODEL, tosses, progress=True)
    inertia = np.asarray(lgvi.PhysicalRigidBody(jnp.asarray(reached[-1])).inertia)
    listed = re.findall(r"-?\d\.\d+", str(told.value).split("inertia = ")[1])
    np.testing.assert_allclose(
        np.array(listed, float), inertia.ravel() / np.trace(inertia), rtol=1e-12
    )
    assert str(told.value).endswith("]] of the trace.")
    assert not [thread for thread in threading.enumerate() if "watch" in thread.name]
