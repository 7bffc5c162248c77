"""Pictures of an estimate hold what they say."""

import dataclasses
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest

import lgvi
from lgvi.identification import Model
from lgvi.plotting import plot_fit, plot_identifiability, plot_moments, plot_residuals

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
    simulate = {"residuals": residuals}.__getitem__
    part = dataclasses.replace(estimate.parts[""], recordings=recordings, simulate=simulate)
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


def test_the_fitted_motion_is_near_what_was_recorded_and_goes_through_gaps(estimate):
    """Lines are simulated on a grid of their own; dots lie on them within the noise."""
    above, below = plot_fit(estimate, "toss 1").axes
    lines = [line for line in above.lines if line.get_linestyle() == "-"]
    dots = [line for line in above.lines if line.get_marker() == "."]
    assert len(lines) == len(dots) == 4
    for line, dot in zip(lines, dots, strict=True):
        (t, curve), (at, recorded) = (np.asarray(each.get_data()) for each in (line, dot))
        assert len(t) == 600
        assert np.max(np.diff(t)) < 2 * np.min(np.diff(t))
        difference = np.interp(at, t, curve) - recorded
        assert 0 < abs(difference).max() < 5 * SIGMA_R
    assert "toss 1" in above.get_title()
    assert below.get_ylabel() == "residual\n(rad)"
    residuals = np.stack([line.get_ydata() for line in below.lines[:3]], axis=1)
    samples = estimate.recordings.channels["attitude"]
    np.testing.assert_array_equal(
        residuals, samples.split(estimate.residuals["attitude"] * SIGMA_R)[1]
    )
    with pytest.raises(ValueError, match=r"`trajectory` must be one of .* but is 'toss 9'"):
        plot_fit(estimate, "toss 9")


def test_pictures_are_drawn_in_axes_that_are_given(estimate):
    figure, axes = plt.subplots(1, 3)
    assert plot_moments(estimate, ax=axes) is figure
    assert all(axis.patches for axis in axes)
    with pytest.raises(ValueError, match="`ax` must be 3 of Matplotlib's axes, but has 1"):
        plot_moments(estimate, ax=axes[:1])


def test_bars_are_as_long_as_standard_errors(estimate):
    (axis,) = plot_identifiability(estimate).axes
    summary = estimate.summary()
    labels = [label.get_text() for label in axis.get_yticklabels()]
    bars: list[Any] = list(axis.patches)
    ends = {label: bar.get_x() + bar.get_width() for label, bar in zip(labels, bars, strict=True)}
    for name, value, error in zip(
        summary["name"], summary["value"], summary["standard_error"], strict=True
    ):
        if "moment" in name:
            assert ends[name] == pytest.approx(100 * error / value)
    assert "not observable" in [text.get_text() for text in axis.texts]


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
