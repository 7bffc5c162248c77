"""Known bodies are found within their standard errors, and what cannot be known is said."""

import re
from collections import OrderedDict
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import (
    InitialStates,
    Model,
    Recordings,
    Samples,
    identify,
    initial_states,
    negative_log_likelihood,
)
from lgvi.identification.fit.part import summarise

from ..systems import rng
from . import recorded
from .recorded import (
    MOMENTS,
    SIGMA_R,
    SIGMA_W,
    errors_of,
    moments,
    ratios,
    trajectories,
    trajectory,
)

ANY: Any = identify
ISOTROPIC = lgvi.PhysicalRigidBody.from_principal_moments(np.full(3, 1e-3))
ATTITUDE = lgvi.AttitudeSensor(SIGMA_R)
GYROSCOPE = lgvi.Gyroscope(SIGMA_W)


def of(*sensors):
    return Model(ISOTROPIC, sensors)


def test_attitudes_give_the_ratios_without_any_guess_and_not_the_scale(tosses, estimate):
    assert estimate.converged
    assert estimate.messages == ()
    assert np.all(abs(errors_of(estimate, ratios, MOMENTS / MOMENTS.sum())) < 4)
    assert np.all(estimate.standard_error(ratios) < 1e-3)
    assert np.trace(estimate.body.inertia) == pytest.approx(1, abs=1e-12)
    (words,) = estimate.unobservable
    assert words.startswith("overall scale of the inertia: a known torque or a rotor")
    assert np.all(np.isinf(estimate.standard_error(moments)))
    assert np.isinf(np.diag(estimate.covariance(lambda model: model.body.inertia))).all()
    assert estimate.degrees_of_freedom == 3 * 180 - 3 * 6 - 5
    assert estimate.chi_square / estimate.degrees_of_freedom == pytest.approx(1, abs=0.2)
    assert estimate.outliers == ()
    assert 0 < estimate.step_bias < 0.1
    assert str(tosses) == "3 trajectories; samples: 180 of attitude"


def test_the_report_says_what_is_known(estimate, capsys):
    estimate.report()
    text = capsys.readouterr().out
    assert text == f"{estimate}\n"
    assert "trace of the inertia" in text
    assert text.count("not observable") == 2
    assert "principal moment, smallest" in text
    assert "converged after" in text


def test_a_wrong_start_ends_in_the_same_minimum(tosses, estimate):
    start = initial_states(Model(ISOTROPIC, ATTITUDE), tosses)
    wrong = InitialStates(start.R, start.omega[:, ::-1] * jnp.array([[1.0, -1.0, 0.5]]))
    again = identify(Model(ISOTROPIC, ATTITUDE), tosses, start=wrong)
    assert again.converged
    difference = ratios(again.model) - ratios(estimate.model)
    assert np.all(abs(difference) < 0.01 * estimate.standard_error(ratios))


def test_segments_whose_gaps_close_give_the_same_as_whole_trajectories(tosses, estimate):
    again = identify(Model(ISOTROPIC, ATTITUDE), tosses, segment=0.6)
    assert again.converged
    difference = ratios(again.model) - ratios(estimate.model)
    assert np.all(abs(difference) < 0.01 * estimate.standard_error(ratios))
    errors = again.standard_error(ratios, "independent")
    np.testing.assert_allclose(errors, estimate.standard_error(ratios, "independent"), rtol=1e-3)
    # Blocks of time, whose own states are those of their segments, are not quite the same.
    errors = again.standard_error(ratios)
    np.testing.assert_allclose(errors, estimate.standard_error(ratios), rtol=0.3)
    assert again.chi_square == pytest.approx(estimate.chi_square, abs=1e-3)
    assert again.degrees_of_freedom == estimate.degrees_of_freedom
    assert again.unobservable == estimate.unobservable
    np.testing.assert_allclose(again.states.omega, estimate.states.omega, rtol=1e-4)
    found, expected = (np.asarray(e.residuals["attitude"]) for e in (again, estimate))
    np.testing.assert_allclose(found, expected, atol=0.02)


def test_the_likelihood_is_flat_at_the_estimate_and_knows_the_noise(tosses, estimate):
    value = negative_log_likelihood(tosses, lgvi.MoserVeselovIntegrator(0.01, order=6))

    @jax.jit
    @jax.value_and_grad
    def loss(free):
        theta, phi, log_sigma = free
        model = estimate.free.put(estimate.model, theta)
        model = eqx.tree_at(lambda m: m.sensors["attitude"].sigma, model, jnp.exp(log_sigma))
        return value(model, estimate.states.moved(phi))

    theta = jnp.asarray(estimate.free.theta)
    count = 3 * 180
    sigma = SIGMA_R * np.sqrt(estimate.chi_square / count)
    found, (of_theta, of_phi, of_sigma) = loss((theta, jnp.zeros((3, 6)), jnp.log(sigma)))
    # In standard errors: much less than what a change by one of them makes.
    step = np.sqrt(estimate.variance) / estimate.information.scale
    assert np.all(abs(of_theta * step) < 1e-3)
    assert np.all(abs(of_phi) * 1e-4 < 1e-3)
    assert abs(of_sigma) < 1e-6 * count  # the most likely noise
    assert found == pytest.approx(count * (np.log(sigma) + 0.5), rel=1e-6)


def test_noise_that_is_not_independent_is_told(tosses, estimate):
    white = SIGMA_R * rng(103).normal(size=(3, 60, 3))
    colored = lfilter([1], [1, -0.7], white, axis=1)
    noisy = Recordings.concatenate(
        Recordings.from_arrays(t, attitude=Rotation.from_matrix(R) * Rotation.from_rotvec(e))
        for t, R, e in zip(
            tosses.channels["attitude"].t, tosses.channels["attitude"].value, colored, strict=True
        )
    )
    for options, words in (
        ({"errors": "independent"}, "too small, by a factor of"),
        ({}, "allow for"),
    ):
        (message,) = ANY(Model(ISOTROPIC, ATTITUDE), noisy, **options).messages
        assert message.startswith("Successive residuals of `attitude` are correlated by 0.")
        assert words in message
    # That a fit takes a smooth part off white noise is no correlation.
    for count in (4, 40):
        smooth, _ = np.linalg.qr(np.vander(np.linspace(-1, 1, count), 2))  # attitude and rate
        r = rng(104).normal(size=(4000, count, 3))
        r -= np.einsum("tk,sk,nsx->ntx", smooth, smooth, r)
        sampled = Samples.stack([(np.arange(count) * 0.1, each) for each in r])
        names = tuple(map(str, range(4000)))
        recordings = Recordings(OrderedDict(attitude=sampled), None, None, None, names)
        parts = [(recordings, {"attitude": r.reshape(-1, 3)})]
        summary = summarise(Model(ISOTROPIC, ATTITUDE), recordings, parts)["attitude"]
        found = summary.correlation
        assert found is not None
        assert abs(found.value) < 4 * found.error < 0.05


def test_a_robust_loss_ignores_what_does_not_fit(tosses):
    R = np.array(tosses.channels["attitude"].value)
    R[0, 7], R[1, 20], R[2, 0] = R[0, 27], R[1, 50], R[2, 41]
    spoiled = Recordings.concatenate(
        Recordings.from_arrays(tosses.channels["attitude"].t[i], attitude=R[i], name=str(i))
        for i in range(3)
    )
    sensor = lgvi.AttitudeSensor(SIGMA_R, loss=lgvi.Huber(2.0))
    robust = identify(Model(ISOTROPIC, sensor), spoiled)
    assert robust.converged
    assert np.all(abs(errors_of(robust, ratios, MOMENTS / MOMENTS.sum())) < 4)
    assert np.all(robust.standard_error(ratios) < 1e-3)
    assert abs(robust.residuals["attitude"][7]).max() > 100


@pytest.mark.slow
def test_a_known_rotor_shows_the_scale_and_a_gyroscope_its_bias():
    axis, bias = np.array([0.6, 0.0, 0.8]), np.array([0.02, -0.03, 0.01])
    speed = lambda t: (600 + 80 * np.sin(9 * t)) * axis  # noqa: E731
    thrown = trajectories(
        4,
        key=1,
        samples=150,
        interval=0.002,
        attitudes=False,
        rates=True,
        bias=bias,
        speed=(5, 12),
        rotor=lambda t: 1.5e-5 * speed(t),
        rotor_momentum=speed,
    )
    known = identify(
        Model(ISOTROPIC, GYROSCOPE, rotor_inertia=1.5e-5),
        thrown,
        lgvi.MoserVeselovIntegrator(0.002 / 6),
        free=lambda model: (model.body, model.sensors["angular_velocity"].bias),
        noise="given",
    )
    assert known.converged
    assert known.step_bias < 0.1
    assert known.unobservable == ()
    assert np.all(abs(errors_of(known, moments, MOMENTS)) < 4)
    assert np.all(known.standard_error(moments) < 0.01 * MOMENTS)
    assert np.all(
        abs(errors_of(known, lambda model: model.sensors["angular_velocity"].bias, bias)) < 4
    )
    assert known.variance == 1
    # The spin inertia of the rotor is not to be had at the same time.
    unknown = identify(
        Model(ISOTROPIC, GYROSCOPE, rotor_inertia=1.0e-5),
        thrown,
        lgvi.MoserVeselovIntegrator(0.001),
        free=lambda model: (
            model.body,
            model.sensors["angular_velocity"].bias,
            model.rotor_inertia,
        ),
    )
    (words,) = unknown.unobservable
    assert words.startswith("overall scale of the inertia, together with `rotor_inertia`:")
    assert np.isinf(unknown.standard_error(lambda model: model.rotor_inertia))
    of_trace = lambda model: model.rotor_inertia / jnp.trace(model.body.inertia)  # noqa: E731
    assert abs(errors_of(unknown, of_trace, 1.5e-5 / MOMENTS.sum())) < 4
    assert "rotor_inertia / trace" in str(unknown)


@pytest.mark.slow
def test_alignment_and_time_offset_are_found_and_bounds_hold():
    alignment, late = np.array([0.02, -0.03, 0.01]), 0.007
    both = trajectories(3, key=2, rates=True, alignment=alignment, late=late, bias=[0.02, 0, 0])
    sensors = ATTITUDE, lgvi.Gyroscope(SIGMA_W, time_offset=0.0)

    def free(model):
        return (
            model.body,
            model.sensors["attitude"].alignment,
            model.sensors["angular_velocity"].time_offset,
            model.sensors["angular_velocity"].bias,
        )

    def gyroscope(model):
        return model.sensors["angular_velocity"]

    def aligned(model):
        return model.sensors["attitude"].alignment

    found = identify(Model(ISOTROPIC, sensors), both, free=free)
    assert found.converged
    assert abs(errors_of(found, lambda model: gyroscope(model).time_offset, late)) < 4
    assert found.standard_error(lambda model: gyroscope(model).time_offset) < 1e-3
    assert np.all(abs(errors_of(found, aligned, alignment)) < 4)
    assert np.all(abs(errors_of(found, ratios, MOMENTS / MOMENTS.sum())) < 4)

    bounds = [(lambda model: gyroscope(model).bias, -0.01, 0.01)]
    bounded = identify(Model(ISOTROPIC, sensors), both, free=free, bounds=bounds)
    assert bounded.converged
    assert gyroscope(bounded.model).bias[0] == 0.01
    assert "`angular_velocity.bias[0]` is at its bound, and treated as known." in bounded.messages
    assert "at its bound" in str(bounded)
    assert np.all(abs(gyroscope(bounded.model).bias) <= 0.01)


@pytest.mark.slow
def test_recorded_torques_show_the_scale_and_a_law_is_found_beside_them():
    damping = np.diag([1e-3, 2e-3, 3e-3])

    def pushed(t):
        return 2e-3 * np.array([np.sin(3 * t), 0.5, -np.cos(2 * t)])

    noise = 4  # with less the step is refined, which compiles another program
    forced = trajectories(
        12,
        key=3,
        interval=0.015,
        rates=True,
        noise=noise,
        speed=(1, 3),
        torque=lambda t, R, omega: pushed(t) - damping @ omega,
        body_torque=pushed,
    )
    found = identify(
        Model(
            lgvi.PhysicalRigidBody.from_principal_moments(np.full(3, 1e-6)),
            (lgvi.AttitudeSensor(noise * SIGMA_R), lgvi.Gyroscope(noise * SIGMA_W)),
            torque=lgvi.LinearDamping(1e-4 * jnp.eye(3)),
        ),
        forced,
        free=lambda model: (model.body, model.torque),
    )
    assert found.converged
    assert found.unobservable == ()
    assert np.all(abs(errors_of(found, moments, MOMENTS)) < 4)
    assert np.all(found.standard_error(moments) < 0.01 * MOMENTS)
    assert np.all(abs(errors_of(found, lambda model: model.torque.matrix, damping)) < 4.5)
    assert re.search(r"torque\.matrix\[0, 0\] .* N m s$", str(found), re.MULTILINE)


def test_a_step_that_is_too_long_is_reported(tosses):
    coarse = identify(Model(ISOTROPIC, ATTITUDE), tosses, lgvi.MoserVeselovIntegrator(1.0))
    (message,) = [words for words in coarse.messages if "step of the integrator" in words]
    assert "take a smaller `dt` or a higher `order`" in message
    # It tells by how much: the estimate is off by about as many standard errors.
    off = np.linalg.norm(errors_of(coarse, ratios, MOMENTS / MOMENTS.sum()))
    assert coarse.step_bias > 0.5
    assert off < 4 + 3 * coarse.step_bias


def test_single_precision_gives_the_same_to_a_part_of_a_standard_error(tosses, estimate):
    with jax.enable_x64(False):
        body = lgvi.PhysicalRigidBody.from_principal_moments(np.full(3, 1e-3, np.float32))
        single = identify(Model(body, lgvi.AttitudeSensor(np.float32(SIGMA_R))), tosses)
    assert single.body.inertia.dtype == jnp.float32
    assert single.converged
    assert single.unobservable == estimate.unobservable
    difference = np.asarray(ratios(single.model)) - np.asarray(ratios(estimate.model))
    errors = estimate.standard_error(ratios)
    assert np.all(abs(difference) < 0.2 * errors)
    np.testing.assert_allclose(single.standard_error(ratios), errors, rtol=0.02)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"recordings": "log.csv"}, TypeError, "`recordings` must be `Recordings`"),
        ({"model": ISOTROPIC}, TypeError, "but is of the type `PhysicalRigidBody`"),
        ({"model": of(GYROSCOPE)}, ValueError, "the recordings do not have `angular_velocity`"),
        ({"model": of(ATTITUDE, GYROSCOPE)}, ValueError, "do not have `angular_velocity`"),
        (
            {"model": Model(lgvi.RigidBody(recorded.J), ATTITUDE)},
            TypeError,
            "use `PhysicalRigidBody`, not RigidBody",
        ),
        ({"segment": 0.0}, ValueError, "`segment` must be a time above 0 s, but is 0.0"),
        ({"noise": "unknown"}, ValueError, "`noise` must be .* 'unknown'"),
        ({"free": "inertia"}, TypeError, "`free` must be a function .* 'inertia'"),
        ({"free": lambda model: model.wheel}, ValueError, "`free` must take nodes .* 'wheel'"),
        ({"free": lambda model: ()}, ValueError, "`free` must choose a floating"),
        (
            {"free": lambda model: model.sensors["attitude"].sigma},
            ValueError,
            "not choose `attitude.sigma`",
        ),
        (
            {"free": lambda model: model.sensors["gyroscope"]},
            ValueError,
            "no 'gyroscope', and the sensors are 'attitude'",
        ),
        ({"free": lambda model: model.torque}, ValueError, "`free` must take nodes .* None"),
        (
            {"free": lambda model: model.sensors["attitude"].alignment[1]},
            ValueError,
            r"print\(model\)` lists them, but: an entry cannot be taken: take .* by equal `bounds`",
        ),
        (
            {"bounds": [(lambda model: model.sensors["attitude"].alignment, 0, 1)]},
            ValueError,
            r"`bounds\[0\]` must choose a leaf that is free",
        ),
        ({"bounds": [(lambda model: model.body, 2, 1)]}, ValueError, "not above the upper one"),
        (
            {"bounds": [(lambda model: model.body, [0, 1], 2)]},
            ValueError,
            r"each of its numbers, .* for 6",
        ),
        ({"bounds": [(lambda model: model.body, 0, 1)]}, ValueError, "must be within its bounds"),
        (
            {"integrator": lgvi.MoserVeselovIntegrator(np.ones(3))},
            ValueError,
            r"`integrator` must have a scalar `dt`.* \(3,\)",
        ),
        ({"model": of(lgvi.AttitudeSensor(0.0))}, ValueError, "`sigma` above 0 .* is 0.0"),
        ({"integrator": 0.01}, TypeError, "`integrator` must be `MoserVeselovIntegrator`"),
        (
            {"bounds": (lambda model: model.body, 0, 1)},
            TypeError,
            "`bounds` must be triples of a function",
        ),
        ({"iterations": 0}, ValueError, "`iterations` must be a whole number above 0"),
        (
            {"integrator": lgvi.MoserVeselovIntegrator(-0.01)},
            ValueError,
            "`integrator` must have a `dt` above 0 s, .* is -0.01",
        ),
        (
            {"integrator": lgvi.MoserVeselovIntegrator(1e-9)},
            ValueError,
            r"`dt` with at most 1e\+08 steps in each .* with 1e-09 s there are \d\.\de\+\d\d",
        ),
        (
            {
                "recordings": Recordings.from_arrays(
                    1e9 + np.arange(9) * 1e-5, attitude=np.tile(np.eye(3), (9, 1, 1))
                ),
                "model": Model(ISOTROPIC, ATTITUDE, lgvi.UniformGravity(1.0, np.ones(3))),
            },
            ValueError,
            "has times up to 1e.09 s, which float64 does not tell apart",
        ),
        ({"start": jnp.ones((3, 6))}, TypeError, "`start` must be `InitialStates`"),
        (
            {"start": InitialStates(jnp.eye(3), jnp.ones(3))},
            ValueError,
            "`start` must have the states of 3",
        ),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_bad_input_is_named(change, error, message, tosses):
    arguments = {"model": of(ATTITUDE), "recordings": tosses, **change}
    with pytest.raises(error, match=message):
        ANY(**arguments)


@pytest.mark.usefixtures("unchecked")
def test_a_likelihood_checks_what_it_is_given(tosses, estimate):
    with pytest.raises(ValueError, match=r"`integrator` must have a scalar `dt`.* \(3,\)"):
        negative_log_likelihood(tosses, lgvi.MoserVeselovIntegrator(np.ones(3)))
    value = negative_log_likelihood(tosses, lgvi.MoserVeselovIntegrator(0.01))
    with pytest.raises(ValueError, match=r"`model` must have a sensor .* have `angular_velocity`"):
        value(of(GYROSCOPE), estimate.states)
    with pytest.raises(ValueError, match="`states` must have the states of 3 trajectories"):
        value(estimate.model, InitialStates.from_rates(jnp.ones(3)))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((ISOTROPIC, ()), ValueError, "`sensors` must have a sensor, but is empty"),
        ((ISOTROPIC, SIGMA_R), TypeError, "`sensors` must be a sensor .* has 0.001"),
        ((ISOTROPIC, (ATTITUDE, ATTITUDE)), ValueError, "but has two for `attitude`"),
        ((ISOTROPIC, lgvi.Gyroscope), TypeError, "not their classes, but has Gyroscope"),
        ((ISOTROPIC, {"body": ATTITUDE}), ValueError, "not have a channel named `body`"),
        ((recorded.J, ATTITUDE), TypeError, "`body` must be"),
        ((lgvi.Gyrostat(recorded.J, np.ones(3)), ATTITUDE), TypeError, "without rotors"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_a_model_is_checked(arguments, error, message):
    with pytest.raises(error, match=message):
        Model(*arguments)


def test_a_trajectory_that_does_not_fit_is_named():
    tosses = [trajectory(0), trajectory(1, noise=3.0), trajectory(2)]
    shaken = Recordings.concatenate(tosses)
    estimate = identify(Model(ISOTROPIC, ATTITUDE), shaken)
    assert estimate.outliers == ("toss 1",)
    assert "trajectories that do not fit: 1: toss 1" in str(estimate)
    assert shaken.drop(estimate.outliers, "shaken").names == ("toss 0", "toss 2")


@pytest.mark.slow
def test_a_channel_without_readings_changes_nothing(tosses, estimate):
    t, R = tosses.channels["attitude"].t[0], tosses.channels["attitude"].value
    both = Recordings.concatenate(
        [Recordings.from_arrays(t, attitude=each, angular_velocity=(t, R[0, :, 0])) for each in R]
    ).drop_samples("angular_velocity", np.ones(R.shape[0] * R.shape[1], bool))
    found = identify(of(ATTITUDE, GYROSCOPE), both)
    np.testing.assert_allclose(ratios(found.model), ratios(estimate.model), rtol=1e-6)


def test_a_start_that_cannot_be_simulated_is_said(tosses):
    start = initial_states(Model(ISOTROPIC, ATTITUDE), tosses)
    fast = InitialStates(start.R, jnp.asarray(start.omega).at[1].multiply(100))
    with pytest.raises(RuntimeError, match=r"cannot .* in 1 of 3 trajectories \('toss 1'\)"):
        identify(Model(ISOTROPIC, ATTITUDE), tosses, start=fast)
