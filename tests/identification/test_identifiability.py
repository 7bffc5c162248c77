"""What an experiment would tell, and recordings that are simulated."""

from typing import Any

import jax
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
    simulate_recordings,
)

from ..systems import euler_equations, rng, rotation
from .recorded import MOMENTS, SIGMA_R, SIGMA_W, J, errors_of, moments, ratios

BODY = lgvi.PhysicalRigidBody.from_inertia(J)
SENSORS = lgvi.AttitudeSensor(SIGMA_R), lgvi.Gyroscope(SIGMA_W)
MODEL = Model(BODY, SENSORS[0])
T = np.arange(60) * 0.03
ANY: Any = simulate_recordings
STATES = InitialStates(
    jnp.asarray(np.stack([rotation(110, i) for i in range(3)])),
    jnp.asarray(rng(111).normal(size=(3, 3)) * 2),
)


def nothing(samples):
    """Attitudes that are there for their times."""
    return np.tile(np.eye(3), (samples, 1, 1))


def test_simulated_recordings_are_the_motion_of_the_body():
    found = simulate_recordings(Model(BODY, SENSORS), T, STATES)
    assert found.names == ("0", "1", "2")
    for i in range(3):
        omega = np.array(STATES.omega[i])
        R, pi = euler_equations(np.array(STATES.R[i]), J @ omega, J, T)
        np.testing.assert_allclose(found.channels["attitude"].value[i], R, atol=1e-9)
        rates = np.linalg.solve(J, pi.T).T
        np.testing.assert_allclose(found.channels["angular_velocity"].value[i], rates, atol=1e-8)


def test_states_of_rates_or_of_attitudes_alone(unchecked):
    several = InitialStates.from_rates(STATES.omega)
    np.testing.assert_array_equal(several.R, np.tile(np.eye(3), (3, 1, 1)))
    np.testing.assert_array_equal(several.omega, STATES.omega)
    at_rest = InitialStates.from_attitudes(STATES.R)
    np.testing.assert_array_equal(at_rest.R, STATES.R)
    np.testing.assert_array_equal(at_rest.omega, np.zeros((3, 3)))
    one = InitialStates.from_rates([1, 2, 3])
    assert one.omega.dtype == float
    assert one.R.shape == InitialStates.from_attitudes(np.eye(3)).R.shape == (1, 3, 3)
    wrong: Any = ("from_rates", np.ones((3, 2))), ("from_attitudes", np.ones((1, 1, 3, 3)))
    for make, value in wrong:
        with pytest.raises(ValueError, match=r"must have shape \(trajectories, 3"):
            getattr(InitialStates, make)(value)


def test_a_model_of_sensors_alone_knows_nothing_of_its_body(unchecked):
    for sensors in (SENSORS[0], SENSORS, {"camera": SENSORS[0]}):
        model = Model(sensors, time_scale=2.0)
        assert list(model.sensors) == list(Model(BODY, sensors).sensors)
        np.testing.assert_allclose(model.body.inertia, np.eye(3), atol=1e-15)
        assert isinstance(model.body, lgvi.PhysicalRigidBody)
        assert model.time_scale == 2.0
    without: Any = Model
    with pytest.raises(TypeError, match=r"`sensors` must be a sensor .* has None"):
        without(BODY)


def test_the_noise_of_a_sensor_does_not_depend_on_the_other_sensors():
    made = [
        simulate_recordings(model, T, STATES, key=jax.random.key(1)).channels["attitude"].values
        for model in (MODEL, Model(BODY, SENSORS), Model(BODY, SENSORS[::-1]))
    ]
    np.testing.assert_allclose(made[1], made[0], atol=1e-12)
    np.testing.assert_allclose(made[2], made[0], atol=1e-12)


def test_noise_is_that_of_the_sensors_and_the_layout_is_kept():
    irregular = np.cumsum(rng(112).uniform(0.01, 0.05, 60))
    long = Recordings.from_arrays(
        irregular, attitude=nothing(60), angular_velocity=np.ones((60, 3))
    )
    short = Recordings.from_arrays(irregular[:40], attitude=nothing(40), name="short")
    layout = Recordings.concatenate([long, short])
    states = InitialStates(STATES.R[:2], STATES.omega[:2])
    clean = simulate_recordings(Model(BODY, SENSORS), layout, states)
    noisy = simulate_recordings(Model(BODY, SENSORS), layout, states, key=jax.random.key(0))
    assert noisy.names == layout.names
    np.testing.assert_array_equal(noisy.channels["attitude"].t, layout.channels["attitude"].t)
    np.testing.assert_array_equal(noisy.channels["attitude"].mask, layout.channels["attitude"].mask)
    between = (
        np.swapaxes(clean.channels["attitude"].value, -1, -2) @ noisy.channels["attitude"].value
    )
    error = Rotation.from_matrix(between[noisy.channels["attitude"].mask]).as_rotvec()
    np.testing.assert_allclose(np.std(error, axis=0), SIGMA_R, rtol=0.25)
    error = noisy.channels["angular_velocity"].value - clean.channels["angular_velocity"].value
    np.testing.assert_allclose(np.std(error[0], axis=0), SIGMA_W, rtol=0.25)


def test_an_experiment_keeps_what_was_promised_of_it():
    promise = identifiability(MODEL, T, STATES)
    recorded = simulate_recordings(MODEL, T, STATES, key=jax.random.key(1))
    kept = identify(MODEL, recorded, noise="given")
    np.testing.assert_allclose(
        promise.standard_error(ratios), kept.standard_error(ratios), rtol=0.05
    )
    assert promise.unobservable == kept.unobservable
    assert promise.unobservable[0].startswith("overall scale of the inertia")
    assert np.all(np.isinf(promise.standard_error(moments)))
    values = promise.singular_values
    assert len(values) == 6
    assert values[5] < 1e-10 * values[4]
    assert "singular values of the whitened Jacobian" in str(promise)


def test_times_in_milliseconds_are_told_by_their_scale():
    true = Model(BODY, SENSORS[0], time_scale=1e-3)
    recorded = simulate_recordings(true, 1e3 * T, STATES, key=jax.random.key(123))
    isotropic = lgvi.PhysicalRigidBody.from_principal_moments(np.full(3, 1e-3))
    estimate = identify(Model(isotropic, SENSORS[0], time_scale=1e-3), recorded)
    assert estimate.converged
    assert estimate.messages == ()
    assert np.all(abs(errors_of(estimate, ratios, MOMENTS / MOMENTS.sum())) < 4)
    assert np.max(abs(estimate.states.omega - STATES.omega)) < 0.1


def test_what_would_show_the_scale_is_seen_to_show_it():
    torque = np.outer(np.sin(2 * T), [1e-3, 0, 2e-3])
    one = Recordings.from_arrays(T, attitude=nothing(60), body_torque=torque)
    pushed = Recordings.concatenate([one] * 3)
    promise = identifiability(MODEL, pushed, STATES)
    assert promise.unobservable == ()
    assert np.all(promise.standard_error(moments) < 0.1 * MOMENTS)
    variances = np.linalg.eigvalsh(promise.covariance())
    np.testing.assert_allclose(promise.singular_values, variances**-0.5, rtol=1e-6)


def test_a_spin_about_one_axis_says_what_else_it_does_not_show():
    spin = InitialStates.from_rates([0.0, 0.0, 3.0])
    body = lgvi.PhysicalRigidBody.from_principal_moments(MOMENTS)
    promise = identifiability(
        Model(body, lgvi.Gyroscope(1e-3)),
        T,
        spin,
        free=lambda model: (model.body, model.sensors["angular_velocity"].bias),
    )
    # The rate stays as it is for any of these, as long as z is a principal axis.
    scale, *alone, first, second = promise.unobservable
    assert scale.startswith("overall scale of the inertia: ")
    remedies = {
        "inertia xx": "a rotation about the body axis (0.71, 0.71, 0)",
        "inertia yy": "a rotation about the body axis (0.71, 0.71, 0)",
        "inertia xy": "a rotation about the body axis (1, 0, 0)",
        "angular_velocity.bias[2]": "another motion",
    }
    ending = "would make it observable; otherwise fix it"
    assert alone == [f"{name}: {remedy} {ending}" for name, remedy in remedies.items()]
    # A bias b across the axis looks like a tilt of it: 3 J_xz = (J_xx - J_zz) b.
    ratios_of_b = (MOMENTS[:2] - MOMENTS[2]) / MOMENTS.sum() / 3
    assert first.startswith(
        f"{ratios_of_b[0]:+.2g} inertia xz +1 angular_velocity.bias[0]: a rotation"
    )
    assert second.startswith(
        f"{ratios_of_b[1]:+.2g} inertia yz +1 angular_velocity.bias[1]: a rotation"
    )
    assert np.isinf(promise.standard_error(ratios)).any()


@pytest.mark.slow
def test_what_another_sensor_would_show_is_said():
    plan = identifiability(MODEL, T, STATES, free=lambda model: model.time_scale)
    (words,) = plan.unobservable
    assert words.startswith("time_scale: a gyroscope, or a known torque, would make it observable")


@pytest.mark.usefixtures("unchecked")
def test_bad_input_is_named():
    layout = Recordings.from_arrays(T, attitude=nothing(60))
    with pytest.raises(ValueError, match="`states` must have the states of 1 trajectories"):
        simulate_recordings(MODEL, layout, STATES)
    with pytest.raises(TypeError, match="`states` must be `InitialStates`"):
        ANY(MODEL, T, np.ones((1, 3)))
    with pytest.raises(ValueError, match=r"`states` must have shapes .* \(3, 3\) and \(3,\)"):
        simulate_recordings(MODEL, T, InitialStates(jnp.eye(3), jnp.ones(3)))
    with pytest.raises(ValueError, match="with a trajectory at least"):
        simulate_recordings(MODEL, T, InitialStates(jnp.zeros((0, 3, 3)), jnp.zeros((0, 3))))
    with pytest.raises(ValueError, match="`states` must have rotation matrices"):
        simulate_recordings(MODEL, T, InitialStates(2 * STATES.R, STATES.omega))
    with pytest.raises(ValueError, match="`states` must have finite `omega`"):
        simulate_recordings(MODEL, T, InitialStates(STATES.R, np.nan * STATES.omega))
    with pytest.raises(ValueError, match="`time_scale` must be above 0, but is -1"):
        simulate_recordings(Model(BODY, SENSORS[0], time_scale=-1.0), T, STATES)
    fast = InitialStates(STATES.R, 200 * STATES.omega)
    with pytest.raises(RuntimeError, match="did not converge"):
        simulate_recordings(MODEL, T, fast, lgvi.MoserVeselovIntegrator(0.006, order=6))


@pytest.mark.slow
def test_a_simulation_is_exact_where_a_rotor_makes_the_body_nutate():
    t = np.arange(30) * 0.01
    layout = Recordings.from_arrays(
        t, angular_velocity=np.zeros((30, 3)), rotor_momentum=np.outer(200 * np.exp(-t), [0, 0, 1])
    )
    body = lgvi.PhysicalRigidBody.from_principal_moments([2.1e-4, 3.0e-4, 3.6e-4])
    model = Model(body, lgvi.Gyroscope(1e-3), rotor_inertia=2e-5)
    states = InitialStates.from_rates([1.0, -2.0, 1.0])
    found, exact = (
        simulate_recordings(model, layout, states, integrator).channels["angular_velocity"].values
        for integrator in (None, lgvi.MoserVeselovIntegrator(1e-4))
    )
    np.testing.assert_allclose(found, exact, rtol=0, atol=2e-4)
