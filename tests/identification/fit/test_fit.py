"""Recordings that are coarse, short or still, starts far off, and models in other units."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

import lgvi
from lgvi.identification import (
    InitialStates,
    Model,
    Recordings,
    identifiability,
    identify,
    initial_states,
    simulate_recordings,
)
from lgvi.identification.fit import fit
from lgvi.identification.fit.problem import Problem
from lgvi.identification.segments import levels
from lgvi.identification.solver.elimination import STATE_SIZE, BlockArrow, triangularise
from lgvi.identification.solver.levenberg_marquardt import LeastGain, Point, minimise
from lgvi.identification.solver.linearise import Linearised
from lgvi.modules.body import AbstractRigidBody

from ...systems import euler_equations, rng, rotation
from ..recorded import (
    ISOTROPIC,
    MODEL,
    MOMENTS,
    SIGMA_R,
    J,
    errors_of,
    moments,
    ratios,
    trajectories,
)

BODY = lgvi.PhysicalRigidBody.from_inertia(J)
ATTITUDE = lgvi.AttitudeSensor(SIGMA_R)
T = np.arange(50) * 0.04
STATES = InitialStates(
    jnp.asarray(np.stack([rotation(120, i) for i in range(3)])),
    jnp.asarray(rng(121).normal(size=(3, 3)) * 2),
)


@pytest.mark.parametrize("segment", [None, 0.6])
def test_many_trajectories_are_fitted_from_a_sample_of_them(monkeypatch, segment):
    """The estimate is that of all trajectories, of which few are fitted at first."""
    recordings = trajectories(12)
    every = identify(MODEL, recordings, segment=segment)
    of_all = fit._fit_all
    monkeypatch.setattr(levels, "SAMPLE_TRAJECTORIES", 3)
    monkeypatch.setattr(levels, "SAMPLE_STEPS", 1)
    first = identify(MODEL, recordings, segment=segment)
    np.testing.assert_allclose(moments(first.model), moments(every.model), rtol=1e-5)
    np.testing.assert_allclose(first.chi_square, every.chi_square, rtol=1e-6)
    np.testing.assert_allclose(first.covariance(), every.covariance(), rtol=1e-3)
    assert first.converged
    monkeypatch.setattr(fit, "_fit_all", lambda *_: None)  # where the sample does not tell enough
    again = identify(MODEL, recordings, segment=segment)
    np.testing.assert_allclose(again.chi_square, every.chi_square, rtol=1e-6)
    monkeypatch.setattr(fit, "_fit_all", of_all)

    fitted, linearise = [], Problem.linearise

    def count(problem, level, theta, *arguments):
        fitted.append((len({window.trajectory for window in level.windows[0]}), theta))
        return linearise(problem, level, theta, *arguments)

    monkeypatch.setattr(Problem, "linearise", count)
    identify(MODEL, recordings, segment=segment)
    numbers = [number for number, _ in fitted]
    first_of_all = numbers.index(12)
    assert set(numbers[:first_of_all]) == {3}
    # The leaves begin where the sample ended.
    ended, begun = fitted[first_of_all - 1][1], fitted[first_of_all][1]
    np.testing.assert_allclose(begun, ended, atol=0.1)


def test_at_the_minimum_no_unknown_gains_more_than_another(monkeypatch):
    """The leaves are as near to the minimum as in a fit of one trajectory."""
    given, minimise = [], Problem.minimise

    def record(problem, level, tolerance, *arguments):
        given.append(tolerance)
        return minimise(problem, level, tolerance, *arguments)

    monkeypatch.setattr(Problem, "minimise", record)
    estimate = identify(MODEL, trajectories(3))
    leaves = len(estimate.covariance())
    assert given[-1] == pytest.approx(LeastGain(1e-6 * (leaves + 3 * 6), 1e-6 * leaves))


def test_suspects_of_many_trajectories_are_tried_on_a_sample(monkeypatch):
    body = lgvi.PhysicalRigidBody.from_inertia(J)
    skewed = Model(body, lgvi.Gyroscope(SIGMA_R, bias=np.array([0.01, 0, 0])))
    states = InitialStates.from_rates(np.array([2.0, 2.0, 2.0]) + 0.2 * rng(3).normal(size=(12, 3)))
    recordings = simulate_recordings(skewed, T, states, key=jax.random.key(1))
    start = Model(body, lgvi.Gyroscope(SIGMA_R))
    (every, *_) = identify(start, recordings).suspects
    monkeypatch.setattr(levels, "SAMPLE_TRAJECTORIES", 1)
    monkeypatch.setattr(levels, "SAMPLE_STEPS", 1)
    estimate = identify(start, recordings)
    (of_some, *_) = estimate.suspects
    assert of_some.name == every.name == "angular_velocity.bias"
    assert of_some.gain == pytest.approx(every.gain / 3, rel=0.5)
    assert "tried on 4 of the 12 trajectories, chosen at random" in str(estimate)
    assert of_some.errors / every.errors == pytest.approx(np.sqrt(3), rel=0.3)


def test_a_body_that_turns_far_between_samples_is_identified():
    coarse = trajectories(12, samples=13, interval=0.2, speed=(4, 4.0001))
    estimate = identify(MODEL, coarse)
    assert estimate.converged
    assert estimate.messages == ()
    assert np.all(abs(errors_of(estimate, ratios, MOMENTS / MOMENTS.sum())) < 4)


@pytest.mark.parametrize("turn", [0.1, 1.0, 3.0])
@pytest.mark.parametrize("spoilt", [0, 1, 3])
def test_a_start_does_not_follow_a_single_wrong_attitude(spoilt, turn):
    exact = trajectories(1, noise=0.0)
    R = exact.channels["attitude"].value[0].copy()
    R[spoilt] = R[spoilt] @ Rotation.from_rotvec([0, 0.6 * turn, 0.8 * turn]).as_matrix()
    right = initial_states(MODEL, exact)
    t = exact.channels["attitude"].t[0]
    found = initial_states(MODEL, Recordings.from_arrays(t, attitude=R))
    size = jnp.linalg.norm(right.omega)
    assert jnp.linalg.norm(found.omega - right.omega) < 0.01 * size
    assert jnp.max(abs(found.R - right.R)) < 1e-3


@pytest.mark.parametrize("missing", [[2, 3, 4, 5, 6], [3, 4, 5, 6, 7, 8], []])
def test_a_start_bridges_gaps_and_goes_back_to_rates_that_begin_before(missing):
    t = np.delete(np.arange(30) * 0.1, missing)
    turn = 4.0 * t  # rad
    R = Rotation.from_rotvec(np.outer(turn, [0, 0, 1]))
    rates = np.arange(30) * 0.1 - 0.6, np.tile([0.0, 0.0, 4.0], (30, 1))
    found = initial_states(MODEL, Recordings.from_arrays(t, attitude=R))
    np.testing.assert_allclose(found.omega[0], [0, 0, 4], atol=1e-9)
    np.testing.assert_allclose(found.R[0], np.eye(3), atol=1e-9)
    both = Recordings.from_arrays(t, attitude=R, angular_velocity=rates)
    found = initial_states(Model(ISOTROPIC, (ATTITUDE, lgvi.Gyroscope(1e-3))), both)
    before = Rotation.from_rotvec([0, 0, -0.6 * 4]).as_matrix()
    np.testing.assert_allclose(found.R[0], before, atol=1e-9)


def test_of_a_body_at_rest_nothing_is_known_but_that_it_rests():
    still = Recordings.from_arrays(T, attitude=np.tile(np.eye(3), (50, 1, 1)))
    estimate = identify(MODEL, still, noise="given")
    assert estimate.converged
    assert np.all(np.isinf(estimate.standard_error(ratios)))
    assert len(estimate.unobservable) > 1
    assert np.all(estimate.states.omega == 0)


def test_a_toss_that_is_too_short_shows_no_scale_and_the_estimate_says_how_little_it_knows():
    estimate = identify(
        Model(ISOTROPIC, ATTITUDE), trajectories(1, key=1, samples=5, interval=0.02)
    )
    assert estimate.unobservable[0].startswith("overall scale of the inertia")
    assert np.trace(estimate.body.inertia) == pytest.approx(1, abs=1e-6)
    assert np.all(np.isinf(estimate.standard_error(moments)))
    assert len(estimate.unobservable) > 1
    assert all("would show it" in words or "make it" in words for words in estimate.unobservable)


def push(t, R):
    return jnp.where((t > 0.537) & (t < 1.163), 1.0, 0.0) * jnp.array([1e-3, 0.0, -5e-4])


@pytest.mark.parametrize(
    ("law", "sigma", "dt"),
    [
        pytest.param(lgvi.LinearDamping(0.1 * J), SIGMA_R, 1e-3, id="smooth"),
        pytest.param(push, 6e-2, 5e-4, id="jump", marks=pytest.mark.slow),
    ],
)
def test_the_bias_that_shorter_steps_leave_is_at_most_as_reported(law, sigma, dt):
    model = Model(BODY, lgvi.AttitudeSensor(sigma), law)
    recorded = simulate_recordings(model, T, STATES, key=jax.random.key(0))
    estimate = identify(model, recorded, errors="independent")
    exact = identify(estimate.model, recorded, lgvi.MoserVeselovIntegrator(dt))
    assert estimate.step_bias < 0.1

    def parts(model):
        return (model.body.inertia / jnp.trace(model.body.inertia))[np.triu_indices(3)][:5]

    shift = np.asarray(parts(estimate.model) - parts(exact.model))
    size = np.sqrt(shift @ np.linalg.solve(estimate.covariance(parts), shift))
    assert 0.3 * estimate.step_bias < size < 1.1 * estimate.step_bias


@pytest.mark.slow
def test_a_step_is_refined_where_the_torque_law_jumps():
    push, begin, end = np.array([0.02, 0.0, -0.01]), 0.53, 1.17
    t = np.array([0.0, begin, begin + 1e-6, end, end + 1e-6, 2.0])
    law = lgvi.SampledTorque(t, np.outer([0, 0, 1, 1, 0, 0], push))
    recorded = trajectories(3, key=12, noise=30, torque=lambda t, *_: push * (begin < t < end))
    # With so much noise two refinements are enough, each of which compiles a program.
    estimate = identify(Model(ISOTROPIC, lgvi.AttitudeSensor(30 * SIGMA_R), torque=law), recorded)
    assert estimate.converged
    assert estimate.messages == ()
    assert estimate.step_bias < 0.1
    assert np.all(abs(errors_of(estimate, moments, MOMENTS)) < 4)


def test_no_noise_is_told_where_all_numbers_are_fitted():
    short = trajectories(7, samples=2)
    estimate = identify(MODEL, short)
    assert estimate.degrees_of_freedom == 0
    assert "degrees of freedom: 0\n" in str(estimate)
    (message,) = estimate.messages
    assert message.startswith("As many numbers are fitted as were read")
    assert np.all(np.isinf(estimate.standard_error(ratios)))
    # Nor are those that are fitted exactly the measure of others.
    mixed = Recordings.concatenate([short, trajectories(4, key=1, samples=30)])
    estimate = identify(MODEL, mixed)
    assert estimate.messages == ()
    assert estimate.outliers == ()


def test_leaves_of_another_precision_do_not_stop_a_fit(tosses, estimate):
    body = lgvi.PhysicalRigidBody.from_principal_moments(np.full(3, 1e-3, np.float32))
    single = identify(Model(body, lgvi.AttitudeSensor(np.float32(SIGMA_R))), tosses)
    assert single.converged
    np.testing.assert_allclose(ratios(single.model), ratios(estimate.model), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("free", ["mass", "mass and offset"])
def test_of_a_weight_and_an_inertia_only_the_ratio_is_known(free):
    law = lgvi.UniformGravity(0.02, jnp.array([0.01, 0.02, 0.05]))
    plan = identifiability(
        Model(BODY, ATTITUDE, torque=law),
        T,
        STATES,
        free=lambda m: (
            (m.body, m.torque.mass) if free == "mass" else (m.body, m.torque.mass, m.torque.offset)
        ),
    )
    assert not plan.scale_is_observable
    assert np.all(np.isinf(plan.standard_error(moments)))
    assert np.all(plan.standard_error(ratios) < 0.01)
    assert np.trace(plan.body.inertia) == pytest.approx(1)
    assert plan.unobservable[0].startswith("overall scale of the inertia, together with `torque.")
    assert len(plan.unobservable) == (1 if free == "mass" else 2)


class Ball(AbstractRigidBody):
    """A body of one's own, whose leaf is no logarithm."""

    size: Float[Array, ""]

    @property
    def inertia(self):
        """Inertia (3, 3), kg m²."""
        return self.size * jnp.eye(3)


@pytest.mark.slow
def test_a_body_of_ones_own_stays_what_it_is():
    omega = np.array([1.0, -2.0, 2.0])
    rolling = Recordings.from_arrays(T, attitude=Rotation.from_rotvec(np.outer(T, omega)))
    estimate = identify(Model(Ball(jnp.asarray(10.0)), ATTITUDE), rolling, noise="given")
    assert estimate.converged
    np.testing.assert_allclose(estimate.states.omega[0], omega, atol=1e-9)
    assert not estimate.scale_is_observable
    assert isinstance(estimate.body, Ball)
    assert estimate.body.size == 10
    assert np.isinf(estimate.standard_error(lambda model: model.body.size))


def test_units_do_not_matter_for_what_is_observable():
    random = rng(122)
    columns = random.normal(size=(2, 10, STATE_SIZE + 4))
    unit = np.array([1.0, 1e14, 1e-9])
    scaled = columns.copy()
    scaled[:, :, STATE_SIZE:-1] /= unit
    rows = [
        BlockArrow(triangularise(table), sizes=sizes)
        for table, sizes in ((columns, 1.0), (scaled, np.maximum(1, unit)))
    ]
    np.testing.assert_allclose(rows[1].lengths() * unit, rows[0].lengths(), rtol=1e-12)


@pytest.mark.parametrize("least_gain", [LeastGain(1e-20), LeastGain(10.0, 1e-20)])
def test_no_step_is_longer_than_a_linear_model_is_good(least_gain):
    seen: list[float] = []
    nothing: Any = None

    def linearise(theta, states, robust_damping):  # of the residual exp(theta) - 1
        seen.append(theta[0])
        row = np.eye(STATE_SIZE, STATE_SIZE + 2)
        table = np.concatenate([row, np.zeros((1, STATE_SIZE + 2))])
        table[-1, -2:] = np.exp(theta[0]), np.exp(theta[0]) - 1
        cost = (np.exp(theta[0]) - 1) ** 2
        return Linearised(BlockArrow(table[None]), cost, 0.0, *[nothing] * 4)

    one = np.ones(1)
    end, _, converged = minimise(
        linearise,
        lambda states, own: states,
        Point(-5 * one, None),
        -np.inf * one,
        np.inf * one,
        2 * one,
        ["0"],
        lambda problem: least_gain,
        50,
        lambda point, cost: None,
    )
    assert converged
    assert end.theta[0] == pytest.approx(0, abs=1e-9)
    assert np.max(np.abs(np.diff(seen))) <= 2
    assert not BlockArrow(np.full((1, 8, 8), 1e200)).finite


@pytest.mark.slow
def test_a_motion_from_rest_is_simulated_as_finely_as_it_becomes_fast():
    t = np.arange(16) * 0.12
    push = np.outer(np.ones(16), [0.02, -0.01, 0.03])
    layout = Recordings.from_arrays(t, attitude=np.tile(np.eye(3), (16, 1, 1)), body_torque=push)
    rest = InitialStates.from_attitudes(jnp.eye(3))
    plans = [
        identifiability(Model(BODY, ATTITUDE), layout, rest, integrator)
        for integrator in (None, lgvi.MoserVeselovIntegrator(0.008))
    ]
    assert np.linalg.norm(push[0]) * t[-1] / MOMENTS[2] > 10  # rad/s, at the end
    errors = [plan.standard_error(moments) for plan in plans]
    np.testing.assert_allclose(*errors, rtol=0.05)
    found = simulate_recordings(Model(BODY, ATTITUDE), layout, rest).channels["attitude"]
    R, _ = euler_equations(np.eye(3), np.zeros(3), J, t, lambda *_: push[0])
    turns = Rotation.from_matrix(R).inv() * Rotation.from_matrix(found.value[0])
    assert np.max(turns.magnitude()) < 2e-3


@pytest.mark.parametrize("late", [-0.1, pytest.param(0.1, marks=pytest.mark.slow)])
def test_what_is_read_at_another_time_is_what_is_there_then(late):
    t, push = np.append(0.5, 1 + T), np.array([1e-3, 0, 5e-4])
    layout = Recordings.from_arrays(
        t,
        attitude=np.tile(np.eye(3), (len(t), 1, 1)),
        body_torque=(np.array([0.0, 4.0]), np.outer([0, 4], push)),
    )
    states, sensor = STATES.at(np.array([0])), lgvi.AttitudeSensor(SIGMA_R, time_offset=late)
    found = simulate_recordings(Model(BODY, sensor), layout, states).channels["attitude"]

    def apart(times):
        """The largest angle from what is there at other times."""
        start, pi0 = np.asarray(states.R[0]), J @ np.asarray(states.omega[0])
        R, _ = euler_equations(start, pi0, J, times, lambda t, *_: t * push)
        turns = Rotation.from_matrix(R[1:]).inv() * Rotation.from_matrix(found.value[0, 1:])
        return np.max(turns.magnitude())

    assert apart(t) > 0.1
    assert apart(np.append(0.5, t[1:] + late)) < 2e-3


@pytest.mark.slow
def test_gaps_stay_open_where_a_minimisation_does_not_converge():
    """Narrower gaps would cost more and more, and chi-square would tell nothing of residuals."""
    moments, law = np.array([1e-3, 2e-3, 2.5e-3]), lgvi.LinearDamping(2e-4 * np.eye(3))
    truth = Model(lgvi.RigidBody(np.diag(moments)), lgvi.Gyroscope(1e-2), law)
    states = InitialStates.from_rates([3.0, 0.5, 2.0])
    recorded = simulate_recordings(truth, np.arange(600) * 0.02, states, key=jax.random.key(0))
    estimate = identify(Model(ISOTROPIC, lgvi.Gyroscope(1e-2)), recorded, segment=1.5, iterations=6)
    assert not estimate.converged
    assert estimate.iterations < 100
    squares = np.sum(estimate.residuals["angular_velocity"] ** 2)
    assert estimate.chi_square == pytest.approx(squares, rel=1e-6)
    assert estimate.chi_square < 1e8
