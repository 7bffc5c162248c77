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
from lgvi.identification import Model, identify, negative_log_likelihood
from lgvi.identification.fit.flat_coordinates import Limits
from lgvi.identification.fit.sampler import Sampler, _log_density
from lgvi.identification.uncertainty.draws import require_convergence
from lgvi.plotting import plot_posterior

from ...systems import rng
from ..recorded import ISOTROPIC, SIGMA_R, ratios, trajectories

DRAWS, ROUGH = 600, 0.03


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


def test_the_density_is_that_of_the_likelihood_and_a_flat_prior(tosses, estimate):
    """Between points whose inertias differ, by the likelihood and by differences of entries.

    One of the points is beyond the plate, which is the limit of a body, and so has a mirror image.
    """
    target, _ = estimate.sampler._target(estimate.scaled)
    density = jax.jit(partial(_log_density, target))
    leaves_at = jax.jit(jax.vmap(target.leaves_at))
    likelihood = negative_log_likelihood(tosses, lgvi.MoserVeselovIntegrator(0.01, order=6))
    k, limits = target.known, target.leaves.limits
    assert k == 5
    assert not target.states.idle.any()

    @jax.jit
    def terms(z):
        """The logarithm of chi-square, and the changes of the states."""
        of_states = z[k:].reshape(target.states.idle.shape)
        shifts = target.states.shifts_at(limits.mirror(z[:k]), of_states)
        model = estimate.free.put(estimate.model, target.leaves_at(z))
        sigma = model.sensors["attitude"].sigma
        cost = 2 * (likelihood(model, estimate.states.moved(shifts)) - 540 * jnp.log(sigma))
        return jnp.log(cost), shifts

    def ratios_of_entries(z):
        bodies = [estimate.free.put(estimate.model, theta).body for theta in leaves_at(z)]
        J = np.stack([body.inertia for body in bodies])
        return (J / np.trace(J, axis1=1, axis2=2)[:, None, None]).reshape(len(z), 9)

    def volume(z):
        """Of the entries of the inertia over its trace, by differences."""
        steps = np.pad(np.eye(k), ((0, 0), (0, len(z) - k)))
        table = ratios_of_entries(z + 1e-4 * steps) - ratios_of_entries(z - 1e-4 * steps)
        return np.linalg.slogdet(table @ table.T)[1] / 2

    def expected(z):
        log_cost, shifts = terms(z)
        angle = np.linalg.norm(shifts[:, :3], axis=1)
        return -270 * log_cost + volume(z) + 2 * np.sum(np.log(np.sinc(angle / 2 / np.pi)))

    random = rng(400)
    a, b = random.normal(size=(2, target.unknowns)) * 800
    a[:k], b[:k] = random.normal(size=(2, k)) * 600
    number = limits.values[0] + limits.normals[0] @ a[:k]
    a[:k] -= limits.directions[0] * (number + 0.3 * limits.values[0])  # beyond the plate
    np.testing.assert_allclose(
        limits.values[0] + limits.normals[0] @ limits.mirror(a[:k]), 0.3 * limits.values[0]
    )
    assert abs(volume(a) - volume(b)) > 0.02
    np.testing.assert_allclose(density(b) - density(a), expected(b) - expected(a), atol=2e-3)


def test_what_is_beyond_limits_has_its_mirror_image():
    limits = Limits(
        values=np.ones(3),
        normals=np.eye(4)[:3],
        directions=np.eye(4)[:3],
        lower=np.array([0.5, -np.inf, 0.0]),
        upper=np.array([np.inf, 1.25, 2.0]),
    )
    for change, numbers in (
        (0.1, [1.1, 1.1, 1.1, 0.1]),
        (-0.75, [0.75, 0.25, 0.25, -0.75]),
        (3.5, [4.5, -2.0, 0.5, 3.5]),
    ):
        mirrored = limits.mirror(jnp.full(4, change))
        np.testing.assert_allclose(mirrored + np.array([1.0, 1.0, 1.0, 0.0]), numbers)
    slopes = jax.jacfwd(limits.mirror)(jnp.full(4, 3.5))
    np.testing.assert_allclose(abs(np.linalg.det(slopes)), 1)


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
            sampler.draw(500, jax.random.key(0), ())


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


@pytest.mark.parametrize(
    ("quantity", "error", "message"),
    [
        (ratios, ValueError, r"`quantity` must be a function that gives one number, but gives 3"),
        (0.3, TypeError, r"`quantity` must be a function of the model"),
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
