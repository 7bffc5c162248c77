"""Pictures of an estimate hold what they say."""

import dataclasses

import matplotlib.pyplot as plt
import numpy as np
import pytest

import lgvi
from lgvi.identification import Model
from lgvi.plotting import plot_moments, plot_prediction, plot_residuals

from .recorded import SIGMA_R, ratios, trajectory


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def test_residuals_are_drawn_in_their_unit(estimate):
    (axis,) = plot_residuals(estimate).axes
    dots = [line for line in axis.lines if line.get_marker() == "."]
    drawn = np.stack([line.get_ydata() for line in dots], axis=1)
    assert drawn.shape == (180, 3)
    np.testing.assert_allclose(np.std(drawn), SIGMA_R, rtol=0.1)
    assert axis.get_ylabel() == "residual of the\nattitude (rad)"


def with_two_channels(estimate, model, recordings, residuals):
    part = dataclasses.replace(estimate.parts[""], recordings=recordings, residuals=residuals)
    return dataclasses.replace(estimate, parameters=model, parts={"": part})


def test_residuals_of_all_sensors_are_drawn_over_the_same_time(estimate):
    recordings = trajectory(0, rates=True, interval=0.03)
    missing = np.arange(60) < 10
    recordings = recordings.drop_samples("angular_velocity", missing)
    model = Model(estimate.body, (lgvi.AttitudeSensor(1.0), lgvi.Gyroscope(1.0)))
    residuals = {"attitude": np.ones((60, 3)), "angular_velocity": np.ones((50, 3))}
    both = with_two_channels(estimate, model, recordings, residuals)
    drawn = [np.asarray(axis.lines[0].get_xdata()) for axis in plot_residuals(both).axes]
    np.testing.assert_allclose(drawn[0], 0.03 * np.arange(60), atol=1e-12)
    np.testing.assert_allclose(drawn[1], 0.03 * np.arange(10, 60))


def test_a_channel_without_readings_has_an_empty_row(estimate):
    recordings = trajectory(0, rates=True).drop_samples("angular_velocity", np.ones(60, bool))
    model = Model(estimate.body, (lgvi.AttitudeSensor(1.0), lgvi.Gyroscope(1.0)))
    residuals = {"attitude": np.ones((60, 3)), "angular_velocity": np.ones((0, 3))}
    both = with_two_channels(estimate, model, recordings, residuals)
    _, empty = plot_residuals(both).axes
    assert all(len(np.asarray(line.get_xdata())) == 0 for line in empty.lines)


def test_prediction_is_near_what_was_recorded(estimate):
    (axis,) = plot_prediction(estimate, "toss 1").axes
    lines = [line for line in axis.lines if line.get_linestyle() == "-"]
    dots = [line for line in axis.lines if line.get_marker() == "."]
    assert len(lines) == len(dots) == 4
    for line, dot in zip(lines, dots, strict=True):
        difference = np.asarray(line.get_ydata()) - np.asarray(dot.get_ydata())
        assert 0 < abs(difference).max() < 5 * SIGMA_R
    assert "toss 1" in axis.get_title()
    with pytest.raises(ValueError, match=r"`trajectory` must be one of .* but is 'toss 9'"):
        plot_prediction(estimate, "toss 9")


def test_ellipses_hold_the_parts_they_say(estimate):
    figure = plot_moments(estimate)
    covariance = estimate.covariance(ratios)
    values = np.asarray(ratios(estimate.model))
    random = np.random.default_rng(0).multivariate_normal(values, covariance, 20_000)
    for axis, pair in zip(figure.axes, ((0, 1), (0, 2), (1, 2)), strict=True):
        for ellipse, part in zip(axis.patches, (0.68, 0.95), strict=True):
            inside = ellipse.get_patch_transform().inverted().transform(random[:, pair])
            found = np.mean(np.linalg.norm(inside, axis=1) < 1)
            assert found == pytest.approx(part, abs=0.015)
