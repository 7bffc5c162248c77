"""Draws of the posterior and profiles: against a linear model, other fits, and the density."""

import logging
import sys
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import lgvi
from lgvi.identification import (
    InitialStates,
    Model,
    identify,
    negative_log_likelihood,
    simulate_recordings,
)
from lgvi.identification.fit.flat_coordinates import _order_limits
from lgvi.identification.fit.sampler import Sampler, _log_density
from lgvi.identification.uncertainty.draws import require_convergence
from lgvi.plotting import plot_posterior

from ...systems import rng
from ..recorded import ISOTROPIC, SIGMA_R, SIGMA_W, ratios, trajectories

DRAWS, ROUGH = 600, 0.03
FINE = lgvi.MoserVeselovIntegrator(0.01, order=6)
STATES = InitialStates.from_rates([[3.0, 1.5, 1.0], [-1.0, 2.5, 2.0]])  # rad/s


def smallest(model):
    return ratios(model)[0]


@pytest.fixture(scope="module")
def draws(estimate):
    return estimate.sample(DRAWS, jax.random.key(0))


def test_draws_have_the_distribution_of_a_linear_fit(estimate, draws):
    """Errors are a thousandth of the moments, so that the model is linear."""
    drawn = draws.evaluate(ratios).reshape(-1, 3)[:, :2]  # their sum is 1
    covariance = estimate.covariance(ratios, "independent")[:2, :2]
    centred = drawn - np.asarray(ratios(estimate.model))[:2]
    white = np.linalg.solve(np.linalg.cholesky(covariance), centred.T)
    size = 1 / np.sqrt(np.min(draws.effective_sample_size[draws.r_hat > 0]))
    np.testing.assert_allclose(np.mean(white, axis=1), 0, atol=4 * size)
    np.testing.assert_allclose(np.cov(white), np.eye(2), atol=6 * size)
    lower, upper = draws.interval(ratios)
    ends = np.stack([lower, upper]) - np.stack(estimate.interval(ratios, "independent"))
    errors = ends / np.asarray(estimate.standard_error(ratios, "independent"))
    # The quantile at 0.975 of n normal numbers has an error of 2.7 / sqrt(n).
    np.testing.assert_allclose(errors, 0, atol=4 * 2.7 * size)
    np.testing.assert_allclose(
        draws.standard_error(ratios), np.std(draws.evaluate(ratios), axis=(0, 1)), rtol=1e-3
    )


def test_draws_have_the_shape_of_a_quantity(estimate, draws):
    values = draws.evaluate(lambda m: {"J": m.body.inertia, "s": smallest(m)})
    assert values["J"].shape == (4, DRAWS, 3, 3)
    np.testing.assert_allclose(
        values["s"],
        np.linalg.eigvalsh(values["J"])[..., 0] / np.trace(values["J"], axis1=2, axis2=3),
        rtol=1e-5,
    )
    assert draws.draws.shape == (4, DRAWS, 6)
    np.testing.assert_allclose(values["s"].std() / smallest_error(estimate), 1, rtol=0.1)


def smallest_error(estimate):
    return float(estimate.standard_error(smallest, "independent"))


def test_the_report_of_draws_has_all_numbers(estimate, draws):
    text = str(draws)
    for name in estimate.summary()["name"]:
        assert name in text
    assert "4 x 600 draws" in text
    assert "overall scale of the inertia" in text
    assert np.all(np.isinf(draws.interval(lambda m: m.body.inertia)[1]))  # not observable
    assert np.isinf(draws.standard_error(lambda m: m.body.inertia)[0, 0])
    table = draws.summary()
    k = list(table["name"]).index("principal moment, smallest")
    assert table["standard_error"][k] == pytest.approx(float(draws.standard_error(smallest)))


def test_further_calls_and_other_recordings_compile_nothing(draws, caplog):
    other = identify(Model(ISOTROPIC, lgvi.AttitudeSensor(SIGMA_R)), trajectories(3, key=7))
    other.evaluate(ratios, draws.draws[0])
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        again = other.sample(DRAWS, jax.random.key(1))
    programs = [x.getMessage() for x in caplog.records if "Finished XLA" in x.getMessage()]
    assert not programs
    assert not np.array_equal(again.draws, draws.draws)


def gyroscope_of(known_axes, torque=None):
    moments, body = [1.1e-3, 1.4e-3, 2.0e-3], lgvi.PhysicalRigidBody
    body = lgvi.KnownAxesRigidBody if known_axes else body
    return Model(body.from_principal_moments(moments), lgvi.Gyroscope(SIGMA_W), torque=torque)


def entries_of_inertia(model):
    return (model.body.inertia / jnp.trace(model.body.inertia)).ravel()


def with_torque(model):
    torque = model.torque.torque / jnp.trace(model.body.inertia)
    return jnp.concatenate([entries_of_inertia(model), torque])


@pytest.fixture
def case_of(tosses, estimate, rough):
    """Recordings, an estimate, a function in which the prior is flat, and changes of states."""

    def make(case):
        if case == "attitudes":
            return tosses, estimate, entries_of_inertia, 800
        if case == "noise given, prior":
            few, at = rough
            prior = [(smallest, 0.2, 1e-3)]
            at = identify(at.model, few, noise="given", prior=prior)
            return few, at, entries_of_inertia, 10
        torque = lgvi.ConstantTorque(np.array([2e-3, 0.0, 1e-3])) if case == "torque" else None
        start = gyroscope_of(case == "known axes", torque)
        recordings = simulate_recordings(start, 0.02 * np.arange(30), STATES, key=jax.random.key(5))
        if torque is None:
            return recordings, identify(start, recordings), entries_of_inertia, 10
        at = identify(start, recordings, free=lambda m: (m.body, m.torque))
        return recordings, at, with_torque, 3

    return make


@pytest.mark.parametrize("case", ["attitudes", "noise given, prior", "known axes", "torque"])
def test_the_density_is_that_of_the_likelihood_and_a_flat_prior(case_of, case):
    """Between points whose inertias differ, by the likelihood and by differences of numbers.

    One of the points is beyond the plate, which is the limit of a body, and so has a mirror image.
    """
    recordings, estimate, numbers_of, far = case_of(case)
    target, _ = estimate.sampler._target()
    density = jax.jit(partial(_log_density, target))
    k, limits, problem = target.dimension, target.leaves.limits, estimate.sampler.problem
    likelihood = negative_log_likelihood(recordings, FINE)
    readings = sum(np.sum(np.isfinite(x)) for x in readings_of(recordings))
    is_attitude = "attitude" in estimate.model.sensors
    sensor = estimate.model.sensors["attitude" if is_attitude else "angular_velocity"]
    count = float(readings / 3 if is_attitude else readings)  # residuals

    @jax.jit
    def terms(z):
        """Chi-square, the priors, and the changes of the states."""
        shifts = target.states.shifts_at(
            limits.mirror(z[:k]), z[k:].reshape(target.states.idle.shape)
        )
        model = estimate.free.put(estimate.model, target.leaves_at(z))
        noise = count * jnp.log(sensor.sigma)
        cost = 2 * (likelihood(model, estimate.states.moved(shifts)) - noise)
        priors = [
            (prior.function(model) - prior.mean[0]) / prior.deviation[0] for prior in problem.prior
        ]
        return cost, sum(x**2 for x in priors) / 2, shifts

    @jax.jit
    @jax.vmap
    def numbers_at(z):
        return numbers_of(estimate.free.put(estimate.model, target.leaves_at(z)))

    def volume(z):
        """Of the numbers, by differences."""
        steps = 1e-4 * np.pad(np.eye(k), ((0, 0), (0, len(z) - k)))
        table = numbers_at(z + steps) - numbers_at(z - steps)
        return np.linalg.slogdet(table @ table.T)[1] / 2

    def expected(z):
        cost, of_priors, shifts = terms(z)
        fitted = cost / 2 if problem.noise_is_given else count / 2 * np.log(cost)
        angle = np.linalg.norm(shifts[:, :3], axis=1)
        uniform = 2 * np.sum(np.log(np.sinc(angle / 2 / np.pi)))
        idle = np.sum((target.states.idle.ravel() * z[k:]) ** 2) / 2
        return volume(z) + uniform - fitted - of_priors - idle

    random = rng(400)
    a, b = random.normal(size=(2, target.unknowns)) * far
    a[:k], b[:k] = random.normal(size=(2, k)) * min(far, 600)
    number = limits.values[0] + limits.normals[0] @ a[:k]
    a[:k] -= limits.directions[0] * (number + 0.3 * limits.values[0])  # beyond the plate
    np.testing.assert_allclose(
        limits.values[0] + limits.normals[0] @ limits.mirror(a[:k]), 0.3 * limits.values[0]
    )
    change = expected(b) - expected(a)
    np.testing.assert_allclose(density(b) - density(a), change, rtol=1e-6, atol=2e-3)


def readings_of(recordings):
    """All recorded numbers."""
    return [samples.value for samples in recordings.quantities.values()]


def test_what_is_beyond_limits_has_its_mirror_image():
    numbers, lower = np.ones(3), np.array([0.5, -np.inf, 0.0])
    upper, of_numbers = np.array([np.inf, 1.25, 2.0]), rng(401).normal(size=(3, 3))
    limits = _order_limits(numbers, of_numbers, lower, upper)
    z = rng(402).normal(size=(1000, 3))
    mirrored = jax.jit(jax.vmap(limits.mirror))(z)
    inside = numbers + np.asarray(mirrored) @ of_numbers.T
    assert np.all((inside > lower - 1e-9) & (inside < upper + 1e-9))
    is_within = np.all(
        (lower < numbers + z @ of_numbers.T) & (numbers + z @ of_numbers.T < upper), 1
    )
    assert 10 < np.sum(is_within) < 990
    np.testing.assert_allclose(mirrored[is_within], z[is_within])
    volumes = np.linalg.det(jax.jit(jax.vmap(jax.jacfwd(limits.mirror)))(z))
    np.testing.assert_allclose(abs(volumes), 1)


def test_draws_that_do_not_tell_the_posterior_are_an_error(draws):
    bad = draws.r_hat + 0.02
    with pytest.raises(RuntimeError, match=r"R-hat is above 1.01 for body.log_chol.*more `draws`"):
        require_convergence(replace(draws, r_hat=bad))
    few = draws.effective_sample_size / 100
    with pytest.raises(RuntimeError, match=r"effective sample size is below 400.*`prior`"):
        require_convergence(replace(draws, effective_sample_size=few))
    with pytest.raises(RuntimeError, match=r"25 of 2400 transitions diverge"):
        require_convergence(replace(draws, divergences=25))
    require_convergence(replace(draws, divergences=24))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"draws": 99}, ValueError, r"`draws` must be a whole number of at least 100"),
        ({"draws": 500.0}, ValueError, r"`draws` must be a whole number of at least 100"),
        ({"key": 0}, TypeError, r"`key` must be a random key"),
    ],
)
def test_bad_arguments_of_sample_are_named(estimate, unchecked, arguments, error, message):
    with pytest.raises(error, match=message):
        estimate.sample(**({"draws": 500, "key": jax.random.key(0)} | arguments))


def test_without_the_package_the_error_says_what_to_install(estimate, monkeypatch):
    monkeypatch.setitem(sys.modules, "blackjax", None)
    with pytest.raises(ImportError, match=r'pip install "lgvi\[sampling\]"'):
        estimate.sample(500, jax.random.key(0))


def test_what_is_no_likelihood_is_not_sampled(estimate, tosses):
    sensor = lgvi.AttitudeSensor(SIGMA_R, loss=lgvi.Huber(2.0))
    configuration = estimate.sampler.problem.configurations[0]
    robust = configuration._replace(model=Model(ISOTROPIC, sensor))
    at = estimate.sampler
    for change, variance, message in (
        ({"configurations": [robust]}, 1.0, r"no draws with a robust loss"),
        ({}, np.inf, r"no more was read than is fitted"),
    ):
        problem = replace(at.problem, **change)
        sampler = Sampler(problem, at.longest_steps, at.states, at.known, variance)
        with pytest.raises(ValueError, match=message):
            sampler.draw(500, jax.random.key(0))


def test_a_body_with_bounds_is_not_sampled(tosses):
    sensor, bounds = lgvi.AttitudeSensor(SIGMA_R), [(lambda m: m.body.log_cholesky, -9.0, 9.0)]
    bounded = identify(Model(ISOTROPIC, sensor), tosses, bounds=bounds, iterations=2)
    with pytest.raises(ValueError, match=r"no draws where a leaf of a body has bounds"):
        bounded.sample(500, jax.random.key(0))


def test_draws_as_a_prior_are_about_their_mean(draws):
    ((function, mean, deviation),) = draws.as_prior()
    rows = draws.evaluate(function).reshape(-1, 5)
    size = 1 / np.sqrt(len(rows))
    np.testing.assert_allclose(np.mean(rows, axis=0), mean, atol=0.02)
    np.testing.assert_allclose(np.cov(rows.T), deviation**2 * np.eye(5), atol=6 * size)


def test_a_profile_of_a_linear_model_is_the_interval(estimate):
    profile = estimate.profile(smallest)
    lower, upper = estimate.interval(smallest, "independent")
    assert profile.value == pytest.approx(float(smallest(estimate.model)))
    width = float(upper - lower)
    np.testing.assert_allclose([profile.lower, profile.upper], [lower, upper], atol=0.01 * width)
    assert "95 % interval" in str(profile)
    narrow = estimate.profile(smallest, level=0.5)
    lower, upper = estimate.interval(smallest, "independent", level=0.5)
    np.testing.assert_allclose([narrow.lower, narrow.upper], [lower, upper], atol=0.01 * width)


@pytest.fixture(scope="module")
def rough():
    """A fit to few attitudes, by which moments are known roughly."""
    sensor = lgvi.AttitudeSensor(ROUGH)
    few = trajectories(3, samples=12, interval=0.15, noise=ROUGH / SIGMA_R)
    return few, identify(Model(ISOTROPIC, sensor), few, noise="given")


def test_chi_square_at_the_ends_of_a_profile_is_higher_by_the_threshold(rough):
    """By another fit, with the number held by a prior."""
    few, estimate = rough
    profile = estimate.profile(smallest)
    assert profile.threshold == pytest.approx(1.959964**2, rel=1e-6)
    half = (profile.upper - profile.lower) / 2
    for end in (profile.lower, profile.upper):
        prior = [(smallest, end, 1e-4 * half)]
        held = identify(estimate.model, few, prior=prior, noise="given")
        assert float(smallest(held.model)) == pytest.approx(end, abs=1e-3 * half)
        rise = held.chi_square - estimate.chi_square
        assert rise == pytest.approx(profile.threshold, rel=5e-3)
    grown = estimate.profile(lambda model: jnp.exp(300 * smallest(model)))
    for drawn, end in zip((grown.lower, grown.upper), (profile.lower, profile.upper), strict=True):
        assert np.log(drawn) / 300 == pytest.approx(end, abs=2e-3 * half)
    assert np.all(np.diff(profile.values) > 0)
    assert profile.rises[list(profile.values).index(profile.value)] == 0


def test_an_end_that_is_not_reached_is_infinite(rough):
    _, estimate = rough
    start, error = float(smallest(estimate.model)), smallest_error(estimate)
    profile = estimate.profile(lambda model: jnp.sin((smallest(model) - start) / (0.3 * error)))
    assert (profile.lower, profile.upper) == (-np.inf, np.inf)
    np.testing.assert_allclose(profile.values[[0, -1]], [-0.95, 0.95], atol=0.05)
    assert np.all(profile.rises < profile.threshold)
    assert "followed to" in str(profile)
    unknown = estimate.profile(lambda model: model.body.inertia[0, 0])
    assert (unknown.lower, unknown.upper) == (-np.inf, np.inf)
    assert str(unknown) == "not observable"


@pytest.mark.parametrize(
    ("quantity", "error", "message"),
    [
        (ratios, ValueError, r"`quantity` must be a function that gives one number, but gives 3"),
        (0.3, TypeError, r"`quantity` must be a function of the model"),
        (
            lambda model: 0 * smallest(model) + 2,
            ValueError,
            r"must depend on what is free.*always 2",
        ),
    ],
)
def test_a_profile_is_that_of_one_number(estimate, unchecked, quantity, error, message):
    with pytest.raises(error, match=message):
        estimate.profile(quantity)
    with pytest.raises(ValueError, match=r"`level` must be a probability"):
        estimate.profile(smallest, level=1.0)


def test_the_picture_has_all_three(estimate, draws):
    profile = estimate.profile(smallest)
    figure, axis = plt.subplots()
    assert plot_posterior(estimate, smallest, profile, draws, label="smallest", ax=axis) is figure
    assert axis.get_xlabel() == "smallest"
    lines = {line.get_label(): np.asarray(line.get_ydata(), float) for line in axis.lines}
    x = np.asarray(axis.lines[0].get_xdata(), float)
    assert np.trapezoid(lines["normal"], x) == pytest.approx(1, abs=0.1)
    assert abs(x[np.argmax(lines["normal"])] - profile.value) < x[1] - x[0]
    bars: Any = axis.patches
    area = sum(bar.get_height() * bar.get_width() for bar in bars)
    assert area == pytest.approx(1, abs=0.01)
    ends = [np.asarray(line.get_xdata()) for line in axis.lines if line.get_marker() == "|"]
    np.testing.assert_allclose(ends[1], [profile.lower, profile.upper])
    np.testing.assert_allclose(ends[2], np.stack(draws.interval(smallest)))
    plt.close(figure)
    with pytest.raises(ValueError, match=r"`profile` must be that of `quantity`"):
        plot_posterior(estimate, lambda model: 2 * smallest(model), profile, draws)
