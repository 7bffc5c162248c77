"""Trajectories that were not fitted, beside those of a fit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import (
    InitialStates,
    Model,
    Recordings,
    identify,
    identify_jointly,
    simulate_recordings,
)

from ...systems import euler_equations, rng
from ..recorded import ISOTROPIC, MODEL, SIGMA_R, J, trajectories

T = np.arange(40) * 0.03
OTHER = J @ np.diag([1.0, 1.0, 1.02])


def simulated(count, key, inertia=J, sigma=SIGMA_R, samples=40, speed=(2, 5)):
    omega = rng(300, key).normal(size=(count, 3))
    size = rng(301, key).uniform(*speed, size=(count, 1))
    states = InitialStates.from_rates(omega * size / np.linalg.norm(omega, axis=1, keepdims=True))
    model = Model(lgvi.RigidBody(inertia), lgvi.AttitudeSensor(sigma))
    return simulate_recordings(model, T[:samples], states, key=jax.random.key(key))


@pytest.fixture(scope="module")
def fitted():
    return identify(MODEL, simulated(6, 0))


def test_initial_states_alone_are_fitted(fitted):
    """The chi-square is the least that SciPy reaches with the estimated body."""
    unseen = trajectories(1, key=30, samples=20)
    validation = fitted.validate(unseen)
    part = validation.parts[""]
    t, attitudes = unseen[0]["attitude"]
    body = np.asarray(fitted.body.inertia)

    def residuals(x):
        start = np.asarray(part.states.R[0]) @ Rotation.from_rotvec(x[:3]).as_matrix()
        R, _ = euler_equations(start, body @ x[3:], body, np.asarray(t))
        error = Rotation.from_matrix(R).inv() * Rotation.from_matrix(np.asarray(attitudes))
        return error.as_rotvec().ravel() / SIGMA_R

    start = np.append([0.0, 0.0, 0.0], np.asarray(part.states.omega[0]))
    least = 2 * least_squares(residuals, start * (1 + 1e-6), x_scale=1e-3).cost
    assert validation.converged
    np.testing.assert_allclose(part.trajectory_chi_square, [least], rtol=1e-4)
    np.testing.assert_array_equal(part.model.body.inertia, fitted.body.inertia)


def test_more_noise_and_another_body_disagree(fitted):
    recorded = simulated(4, 1), simulated(4, 1, sigma=2 * SIGMA_R), simulated(4, 1, OTHER)
    same, noisy, other = map(fitted.validate, recorded)
    assert same.agrees
    assert same.ratio == pytest.approx(1, abs=0.25)
    assert not noisy.agrees
    assert noisy.ratio == pytest.approx(4, rel=0.25)
    assert not other.agrees
    assert other.probability < 1e-3
    text = str(noisy)
    assert text.startswith("4 trajectories that were not fitted DISAGREE with the 6 of the fit")
    assert "attitude: residual 0.00" in text
    assert max(map(len, text.splitlines())) <= 100
    summary = noisy.summary()
    assert summary["name"].tolist() == ["0", "1", "2", "3"]
    assert np.exp(np.mean(np.log(summary["ratio"]))) == pytest.approx(noisy.ratio)
    assert np.all(summary["probability"] < 0.01)


def test_one_that_differs_is_named(fitted):
    unseen = simulated(3, 2)
    wrong = simulated(1, 3, OTHER, speed=(5, 5.001)).select(["0"])
    validation = fitted.validate(Recordings.concatenate([unseen, wrong]))
    (line,) = [line for line in str(validation).splitlines() if "large, by chance" in line]
    assert line.startswith(f"{validation.summary()['name'][3]}: ")
    assert not validation.agrees


@pytest.mark.slow
@pytest.mark.parametrize(("samples", "speed"), [(40, (2, 5)), (12, (5, 8))])
def test_probabilities_are_as_often_small_as_they_say(samples, speed):
    """No more often where errors of the parameters matter, whose squares are skewed."""
    probabilities = []
    for key in range(60):
        estimate = identify(MODEL, simulated(4, 10 + key, samples=samples))
        unseen = simulated(3, 110 + key, speed=speed)
        probabilities.append(estimate.validate(unseen).probability)
    levels = np.array([0.05, 0.2, 0.5])
    below = np.mean(np.greater.outer(levels, probabilities), axis=1)
    chance = 3 * np.sqrt(levels * (1 - levels) / 60)
    assert np.all(below < levels + chance)
    if speed == (2, 5):
        assert np.all(below > levels - chance)


def test_configurations_are_validated_by_name():
    def heavier(body):
        inertia = 2 * body.inertia
        return Model(lgvi.RigidBody(inertia), lgvi.AttitudeSensor(SIGMA_R))

    def bare(body):
        return Model(body, lgvi.AttitudeSensor(SIGMA_R))

    parts = {"bare": (bare, simulated(3, 4)), "heavier": (heavier, simulated(3, 5))}
    estimate = identify_jointly(ISOTROPIC, parts)
    both = estimate.validate({"bare": simulated(2, 6), "heavier": simulated(2, 7)})
    assert both.agrees
    assert both.summary()["name"].tolist() == ["bare: 0", "bare: 1", "heavier: 0", "heavier: 1"]
    one = estimate.validate({"heavier": simulated(2, 7, OTHER)})
    assert list(one.parts) == ["heavier"]
    assert not one.agrees
    with pytest.raises(ValueError, match="names of parts, bare, heavier, but has"):
        estimate.validate({"lighter": simulated(1, 8)})
    with pytest.raises(TypeError, match="`recordings` must be a mapping of names of parts"):
        estimate.validate(simulated(1, 8))  # pyright: ignore[reportArgumentType]


def test_other_channels_are_refused(fitted):
    with pytest.raises(ValueError, match="`angular_velocity`"):
        fitted.validate(trajectories(1, key=31, rates=True))
    with pytest.raises(TypeError, match="`recordings`"):
        fitted.validate(jnp.zeros(3))
