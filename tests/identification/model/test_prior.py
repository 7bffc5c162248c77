"""What is known beforehand counts as a measurement does."""

import re
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgvi
from lgvi.identification import InitialStates, Model, Recordings, identify, simulate_recordings
from lgvi.identification.fit.fit import fit
from lgvi.identification.model.selection import select_free_leaves

from ..recorded import (
    ISOTROPIC,
    MODEL,
    MOMENTS,
    SIGMA_R,
    SIGMA_W,
    J,
    moments,
    problem_of,
    ratios,
    trajectory,
)

TRACE = MOMENTS.sum()


def biased(bias):
    return Recordings.concatenate(
        [trajectory(195 + i, rates=True, bias=each) for i, each in enumerate(bias)]
    )


def bias_of(model):
    return model.sensors["angular_velocity"].bias


def inertia_of(model):
    return model.body.inertia


def trace_of(model):
    return jnp.trace(model.body.inertia)


def test_a_prior_counts_as_a_measurement():
    """Its information is added, in the units of the noise that the residuals tell."""
    recorded = biased(np.tile([0.05, 0.0, -0.02], (3, 1)))
    sigma = 5.0  # times too large
    model = Model(
        ISOTROPIC, (lgvi.AttitudeSensor(sigma * SIGMA_R), lgvi.Gyroscope(sigma * SIGMA_W))
    )

    def free(m):
        return m.body, bias_of(m)

    options: dict[str, Any] = {"free": free, "errors": "independent"}
    plain = identify(model, recorded, **options)
    error = np.asarray(plain.standard_error(bias_of))
    found = np.asarray(bias_of(plain.model))
    mean, deviation = found + np.array([1, -2, 10]) * error, np.array([3, 1, 0.5]) * error
    known = identify(model, recorded, prior=[(bias_of, mean, deviation)], **options)
    assert known.converged
    of_noise = np.linalg.inv(plain.covariance(bias_of)) * plain.variance / known.variance
    whole = of_noise + np.diag(deviation**-2.0)
    scale = np.sqrt(np.diag(np.linalg.inv(whole)))
    off = known.covariance(bias_of) - np.linalg.inv(whole)
    np.testing.assert_allclose(off / np.outer(scale, scale), 0, atol=0.01)
    expected = np.linalg.solve(whole, of_noise @ found + mean / deviation**2)
    np.testing.assert_allclose((bias_of(known.model) - expected) / scale, 0, atol=0.05)
    assert known.variance == pytest.approx(1 / sigma**2, rel=0.1)
    report = str(known)
    assert "prior of angular_velocity.bias[0]: " in report
    assert report.count("IMPLAUSIBLE") == 1
    for kind in ("clustered", "bootstrap"):
        # But for the last, which the recordings contradict.
        assert np.all((known.standard_error(bias_of, kind) < 1.3 * deviation)[:2])


@pytest.mark.slow
def test_a_prior_makes_the_scale_observable(tosses):
    estimate = identify(MODEL, tosses, prior={"size": (trace_of, TRACE, 0.1 * TRACE)})
    assert "prior of size: " in str(estimate)
    assert estimate.unobservable == ()
    assert estimate.scale_is_observable
    error = estimate.standard_error(trace_of)
    assert error == pytest.approx(0.1 * TRACE, rel=1e-3)
    lower, upper = estimate.interval(trace_of)
    np.testing.assert_allclose(
        [lower, upper], TRACE + 1.96 * 0.1 * TRACE * np.array([-1, 1]), rtol=1e-2
    )
    np.testing.assert_allclose(moments(estimate.model), MOMENTS, rtol=0.05)


@pytest.mark.parametrize(
    ("prior", "words"),
    [
        (3, r"`prior` must be triples"),
        ([(3, 0.0, 1.0)], r"`prior\[0\]` must begin with a function"),
        ([(lambda m: m.time_scale, 0.0, 1.0)], r"`prior\[0\]` must have a function that depends"),
        ([(moments, 0.0, 0.0)], r"`prior\[0\]` must have a standard deviation above 0"),
        (
            [(moments, [1, 2], 1.0)],
            r"`prior\[0\]` must have a mean in the shape .* \(3,\), or",
        ),
        (
            [(inertia_of, np.zeros(9), 1.0)],
            r"`prior\[0\]` must have a mean in the shape .* \(3, 3\)",
        ),
        ([(moments, np.nan, 1.0)], r"`prior\[0\]` must have a finite mean, but has nan"),
        (
            [(lambda m: "much", 0.0, 1.0)],
            r"`prior\[0\]` must have a function .* gives numbers",
        ),
        ([(lambda m: None, 0.0, 1.0)], r"`prior\[0\]` must have a function that gives numbers"),
        ([(lambda m: m.sensors["b"].bias, 0.0, 1.0)], r"but it raises KeyError: 'b'"),
        ({"size": (moments, 0.0, 0.0)}, r"`prior\['size'\]` must have a standard deviation"),
        ([(moments, "big", 1.0)], r"`prior\[0\]` must have a mean of numbers, .* but has 'big'"),
    ],
)
def test_a_wrong_prior_is_told(tosses, prior, words):
    with pytest.raises((TypeError, ValueError), match=words):
        identify(MODEL, tosses, prior=prior)


@pytest.mark.slow
def test_a_prior_counts_whatever_its_weight_is(tosses):
    """Where the residuals tell nothing, with noise that is far below `sigma`, and without noise."""
    deviation = 1e3 * TRACE
    weak = identify(MODEL, tosses, prior=[(trace_of, TRACE, deviation)], errors="independent")
    assert weak.unobservable == ()
    assert weak.standard_error(trace_of) == pytest.approx(deviation, rel=1e-6)
    truth = Model(lgvi.RigidBody(J), MODEL.sensors)
    states = InitialStates.from_rates([[1.0, 6, 1], [4.0, 1, 5]])
    exact = simulate_recordings(truth, np.arange(40) * 0.02, states)
    options: dict[str, Any] = {"errors": "independent"}
    mean = 2 * TRACE
    without_noise = identify(MODEL, exact, prior=[(trace_of, mean, 0.1 * mean)], **options)
    assert without_noise.unobservable == ()
    assert trace_of(without_noise.model) == pytest.approx(mean, rel=1e-6)
    assert without_noise.standard_error(trace_of) == pytest.approx(0.1 * mean, rel=1e-6)
    np.testing.assert_allclose(ratios(without_noise.model), MOMENTS / TRACE, atol=1e-5)


@pytest.mark.slow
def test_the_noise_that_weighs_a_prior_is_that_of_the_last_step():
    """A first step that is too long leaves residuals that are no noise."""
    truth = Model(lgvi.RigidBody(J), lgvi.Gyroscope(1e-5))
    states = InitialStates.from_rates([[1.0, 6, 1], [4.0, 1, 5]])
    recorded = simulate_recordings(truth, np.arange(40) * 0.1, states, key=jax.random.key(201))
    model = Model(ISOTROPIC, truth.sensors)
    problem = problem_of(model, recorded, prior=[(trace_of, TRACE, 0.1 * TRACE)])
    result = fit(replace(problem, turn_of_step=1.0), None, None)
    assert result.converged
    assert result.variance == pytest.approx(1, rel=0.3)
    slope = jax.grad(lambda theta: trace_of(problem.free.put(model, theta)))(result.theta)
    (variance,) = result.information.covariance_of(np.asarray(slope)[None])
    error = np.sqrt(result.variance * variance[0])
    assert error == pytest.approx(0.1 * TRACE, rel=1e-3)


def test_a_sigma_that_is_far_too_large_starts_no_false_alarm(tosses):
    """Short windows and whole trajectories weigh a prior by the noise that there is."""
    model = Model(ISOTROPIC, lgvi.AttitudeSensor(100 * SIGMA_R))
    estimate = identify(model, tosses, prior=[(trace_of, 0.8 * TRACE, 0.05 * TRACE)])
    assert estimate.converged
    assert estimate.messages == ()


@pytest.mark.slow
def test_degrees_of_freedom_are_those_of_the_noise_alone(tosses):
    """An error that a prior decides has none of its own to be estimated."""
    few = tosses.select(tosses.names[:1]).crop(0, 0.1)
    options: dict[str, Any] = {"errors": "independent", "prior": [(moments, MOMENTS, MOMENTS)]}
    estimate = identify(MODEL, few, **options)
    lower, upper = estimate.interval(trace_of)
    error = estimate.standard_error(trace_of)
    assert float(upper - lower) == pytest.approx(2 * 1.96 * float(error), rel=0.1)


BOTH = Model(ISOTROPIC, (lgvi.AttitudeSensor(SIGMA_R), lgvi.Gyroscope(SIGMA_W)))


def body_and_bias(model):
    return model.body, bias_of(model)


def test_one_entry_of_a_leaf_is_estimated_where_equal_bounds_hold_the_others():
    thrown = biased([(0.02, 0, 0), (0.02, 0, 0)])
    bounds = [(bias_of, [-1, 0, 0], [1, 0, 0])]
    estimate = identify(BOTH, thrown, free=body_and_bias, bounds=bounds)
    assert estimate.converged
    assert not any("at its bound" in words for words in estimate.messages)
    bias, error = bias_of(estimate.model), estimate.standard_error(bias_of)
    np.testing.assert_array_equal(bias[1:], 0)
    assert abs(bias[0] - 0.02) < 4 * error[0]
    assert error[0] > 1e-5
    # As where a tight prior holds them, which the recordings cannot contradict.
    prior = [(lambda model: bias_of(model)[1:], 0.0, 1e-8)]
    held = identify(BOTH, thrown, free=body_and_bias, prior=prior)
    np.testing.assert_allclose(bias, bias_of(held.model), atol=1e-3 * error[0])
    np.testing.assert_allclose(error[0], held.standard_error(bias_of)[0], rtol=0.01)
    assert str(held).count("which the recordings cannot contradict") == 2


def test_a_prior_that_rounding_would_hide_is_refused():
    prior = [(lambda model: bias_of(model), 0.03, 1e-9)]
    with pytest.raises(ValueError, match=r"`prior\[0\]` must have a mean within .* but it is 3.0e"):
        identify(BOTH, biased([(0.02, 0, 0)]), free=body_and_bias, prior=prior)


def test_a_model_prints_the_leaves_that_free_can_take():
    model = Model(
        ISOTROPIC, (lgvi.AttitudeSensor(SIGMA_R), lgvi.Gyroscope(SIGMA_W, bias=np.arange(1, 4)))
    )
    text = str(model)
    assert re.search(r"sensors\['angular_velocity'\]\.bias +\[1\.0, 2\.0, 3\.0\] +rad/s\n", text)
    assert "free after a number is given: sensors['attitude'].time_offset," in text
    assert "sigma" not in text
    leaves = [line.split()[0] for line in text.split("\n\n")[0].splitlines()[1:]]
    for leaf in leaves:
        assert len(select_free_leaves(model, eval(f"lambda model: model.{leaf}"), ()).theta) > 0
