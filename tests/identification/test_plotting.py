"""Pictures of an estimate hold what they say."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from lgvi.plotting import plot_moments, plot_prediction, plot_residuals

from .recorded import SIGMA_R, ratios


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def test_residuals_are_drawn_in_their_unit(estimate):
    (axis,) = plot_residuals(estimate).axes
    dots = [line for line in axis.lines if line.get_marker() == "."]
    drawn = np.stack([line.get_ydata() for line in dots], axis=1)
    assert drawn.shape == (180, 3)
    np.testing.assert_allclose(np.std(drawn), 1e3 * SIGMA_R, rtol=0.1)  # mrad
    assert "mrad" in axis.get_ylabel()


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
