"""A rotor of which one column of speeds is recorded: its axis, its inertia and its delay."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.identification import InitialStates, Model, Recordings, identify, simulate_recordings
from lgvi.identification.fit.fit import MAX_MISFIT_RATIO, fit
from lgvi.identification.start.measured import largest_rates

from .recorded import ISOTROPIC, SIGMA_R, SIGMA_W, moments, problem_of, trajectories, trajectory

MOMENTUM = 4e-5 * np.array([0.36, 0.48, 0.8])  # kg m², the spin inertia times the axis
DELAY = 0.02


def speed(t):
    return np.asarray(150 - 40 * t + 30 * np.sin(8 * t))


def sensors():
    return lgvi.AttitudeSensor(SIGMA_R), lgvi.Gyroscope(SIGMA_W)


def recorded(count):
    """The rotor has each speed later than its time stamp says."""
    return trajectories(
        count,
        key=22,
        interval=0.01,
        rates=True,
        rotor=lambda t: MOMENTUM * speed(t - DELAY),
        rotor_momentum=speed,
    )


def test_axis_inertia_and_delay_of_a_rotor_are_found():
    model = Model(ISOTROPIC, sensors(), rotor_inertia=np.array([1e-6, 1e-6, 1e-5]), rotor_delay=0.0)
    estimate = identify(model, recorded(3), free=lambda m: (m.body, m.rotor_inertia, m.rotor_delay))
    assert estimate.converged

    def found(m):
        return m.rotor_inertia / jnp.trace(m.body.inertia), m.rotor_delay

    (of_axis, delay), (axis_error, delay_error) = (
        found(estimate.model),
        estimate.standard_error(found),
    )
    truth = MOMENTUM / 9.3e-3
    np.testing.assert_allclose(np.asarray(of_axis), truth, rtol=5e-3)
    assert np.all(abs(np.asarray(of_axis) - truth) < 5 * axis_error)
    assert (
        abs(float(np.asarray(delay)) - DELAY) < 5 * delay_error + 1e-5
    )  # speeds are linear between samples
    assert delay_error < 1e-3


@pytest.mark.slow
def test_a_delay_that_is_left_out_is_suspected():
    model = Model(ISOTROPIC, sensors(), rotor_inertia=MOMENTUM)
    estimate = identify(model, recorded(3))
    assert estimate.suspects[0].name == "rotor_delay"
    assert estimate.suspects[0].values[0] == pytest.approx(DELAY, rel=0.2)


@pytest.mark.slow
def test_one_column_is_three_along_a_known_axis():
    """A fixed axis: the same motion, and the same moments."""
    one = recorded(2)
    three = Recordings.concatenate(
        [
            Recordings.from_arrays(
                each["attitude"][0],
                attitude=each["attitude"][1],
                angular_velocity=each["angular_velocity"][1],
                rotor_momentum=each["rotor_momentum"][1] * MOMENTUM,
            )
            for each in one
        ]
    )
    of_column = Model(ISOTROPIC, sensors(), rotor_inertia=MOMENTUM)
    first = identify(of_column, one, iterations=3)
    second = identify(Model(ISOTROPIC, sensors()), three, iterations=3)
    np.testing.assert_allclose(moments(first.model), moments(second.model), rtol=1e-9)
    seen = simulate_recordings(first.model, one, first.states)
    assert seen.rotor_momentum is not None
    assert seen.rotor_momentum.values.shape[1] == 1


def test_one_column_of_a_file_is_named_alone(tmp_path):
    file = tmp_path / "throw.csv"
    file.write_text("t,x,y,z,rpm\n0,1,2,3,400\n1,1,2,3,500\n")
    columns = ("x", "y", "z")
    read = Recordings.from_csv(file, angular_velocity=columns, rotor_momentum="rpm")
    assert read.rotor_momentum is not None
    np.testing.assert_array_equal(read.rotor_momentum.values, [[400.0], [500.0]])
    with pytest.raises(ValueError, match="`rotor_momentum` must name 3 or 1 different columns"):
        Recordings.from_csv(file, angular_velocity=columns, rotor_momentum=("t", "rpm"))


def test_a_rotor_that_does_not_go_with_the_model_is_told():
    with pytest.raises(ValueError, match=r"`rotor_inertia` must have shape \(3,\) where"):
        identify(Model(ISOTROPIC, sensors()), recorded(1))
    without = trajectory(1, rates=True)
    with pytest.raises(ValueError, match=r"`rotor_inertia` must have shape \(\) where"):
        identify(Model(ISOTROPIC, sensors(), rotor_inertia=MOMENTUM), without)
    with pytest.raises(ValueError, match="`rotor_delay` must be None"):
        identify(Model(ISOTROPIC, sensors(), rotor_delay=0.0), without)
    of_column = Model(ISOTROPIC, sensors(), rotor_inertia=MOMENTUM)
    with pytest.raises(ValueError, match="`rotor_delay` must be a time shorter than each record"):
        identify(replace(of_column, rotor_delay=jnp.asarray(5.0)), recorded(1))
    with pytest.raises(ValueError, match=r"`rotor_inertia` must have shape \(\) or \(3,\)"):
        Model(ISOTROPIC, sensors(), rotor_inertia=np.ones(2))
    other = trajectory(1, rates=True, rotor_momentum=lambda t: np.zeros(3))
    with pytest.raises(ValueError, match="must have 1 columns of `rotor_momentum`, as others"):
        Recordings.concatenate([recorded(1), other])


def fast_rotor(by_speed, moments, interval=0.005):
    """A rotor with many times the momentum of the body, so that its axis nutates quickly."""
    axis, spin = np.array([0.0, 0.0, 1.0]), 2e-5
    rotors = lgvi.Multirotor(np.zeros((1, 3)), axis, 0.0, 0.0, None, (1,), inertia=spin)
    given: dict[str, Any] = {"rotors": rotors} if by_speed else {"rotor_inertia": spin * axis}
    body = lgvi.PhysicalRigidBody.from_principal_moments(moments)
    t = np.arange(0, 0.5, interval)
    inputs = {"rotor_speed" if by_speed else "rotor_momentum": 800 * np.exp(-t)[:, None]}
    recorded: dict[str, Any] = {"angular_velocity": np.zeros((len(t), 3)), **inputs}
    states = InitialStates.from_rates([5.0, 1.0, 3.0])
    model = Model(body, lgvi.Gyroscope(SIGMA_W), **given)
    return model, Recordings.from_arrays(t, **recorded), states


@pytest.mark.parametrize(
    ("by_speed", "interval"),
    [(False, 0.005), pytest.param(True, 0.05, marks=pytest.mark.slow)],
)
def test_nutation_that_is_faster_than_the_body_turns_is_simulated_well(by_speed, interval):
    case = fast_rotor(by_speed, [2e-4, 3e-4, 3.5e-4], interval)
    rates, exact = (
        simulate_recordings(*case, integrator).channels["angular_velocity"].values
        for integrator in (None, lgvi.MoserVeselovIntegrator(1e-5, order=2))
    )
    assert np.max(abs(rates - exact)) < 0.1 * SIGMA_W


@pytest.mark.slow
def test_a_first_step_that_is_too_long_for_nutation_starts_no_other_fits():
    """With it whole trajectories fit much worse than short windows; with shorter steps not."""
    moments = np.array([2e-4, 3e-4, 3.5e-4])
    recorded = simulate_recordings(*fast_rotor(False, moments), key=jax.random.key(0))
    model, *_ = fast_rotor(False, np.full(3, 3e-4))
    problem = problem_of(model, recorded)
    result = fit(problem, None, None)
    assert result.converged
    assert result.starts == 1
    assert result.misfit_ratio == pytest.approx(1, abs=0.3)
    # With the first step, which an integrator keeps, it is as said.
    step = problem.turn_of_step / largest_rates(model, recorded).max()
    in_vain = replace(problem, is_in_vain=True)
    first = fit(in_vain, lgvi.MoserVeselovIntegrator(step, order=2), None)
    assert first.misfit_ratio > MAX_MISFIT_RATIO
    inertia = problem.free.put(model, result.theta).body.inertia
    found = np.linalg.eigvalsh(np.asarray(inertia))
    np.testing.assert_allclose(found, moments, rtol=0.02)
