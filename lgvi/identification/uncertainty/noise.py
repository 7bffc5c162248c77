"""The size of the noise, from the residuals of a fit."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..data.recordings import Recordings
from ..model.model import Model
from ..windows.layout import Layout
from .information import Information

CORRELATED = 0.1  # of successive residuals, at most, that does not matter
NO_NOISE = 1e-12  # variance of whitened residuals below which they are rounding


def number_of_residuals(model: Model, layout: Layout) -> int:
    """Number of scalar residuals of all readings."""
    return sum(
        len(sensor.axes) * int(np.sum(layout.count_readings(channel)))
        for channel, sensor in model.sensors.items()
    )


def degrees_of_freedom(residuals: int, known: Information, prior: np.ndarray) -> int:
    """Number of residuals minus number of observable unknowns, as far as residuals tell them.

    `prior` (rows, p+1) are rows of what is known beforehand.
    """
    of_prior = np.sum(known.whiten(prior[:, :-1]) ** 2)
    return max(0, residuals - known.rank + round(float(of_prior)))


class Correlation(NamedTuple):
    """Correlation of successive residuals of a channel."""

    value: float
    error: float  # its standard error
    of_axes: np.ndarray  # (m,)

    @property
    def is_certain(self) -> bool:
        """Whether it is larger than what does not matter, and not by chance."""
        return self.value > CORRELATED + 4 * self.error


def compute_correlations(
    model: Model, residuals: Mapping[str, np.ndarray], recordings: Recordings
) -> dict[str, Correlation]:
    """Correlation of successive whitened residuals of each channel, where there are enough.

    Initial states are fitted to the residuals, which makes even white noise anticorrelated: that
    takes a line off readings which depend on the attitude, and a constant off others, about. This
    corrects for it.
    """
    found = {}
    for channel, sensor in model.sensors.items():
        samples, r = recordings.channels[channel], residuals[channel]
        fitted = 2 if sensor.depends_on_attitude else 1
        products = squares = np.zeros(len(sensor.axes))
        by_fit = 0.0
        pairs = left = count = 0
        times, of_trajectories = samples.split(samples.times), samples.split(r)
        for t, of_trajectory in zip(times, of_trajectories, strict=True):
            if len(t) <= fitted:
                continue
            line = np.linalg.qr(np.vander((t - t[0]) / (t[-1] - t[0]), fitted))[0]
            by_fit += np.sum(line[1:] * line[:-1])
            products = products + np.sum(of_trajectory[1:] * of_trajectory[:-1], axis=0)
            squares = squares + np.sum(of_trajectory**2, axis=0)
            pairs, left, count = pairs + len(t) - 1, left + len(t) - fitted, count + len(t)
        if left:
            both = np.append(products, np.mean(products)), np.append(squares, np.mean(squares))
            ratio = np.divide(*both, out=np.zeros_like(both[0]), where=both[1] > 0)
            values = np.clip((ratio * left + by_fit * (both[1] > 0)) / pairs, -1, 1)
            error = count / left / np.sqrt(len(sensor.axes) * pairs)
            found[channel] = Correlation(float(values[-1]), float(error), values[:-1])
    return found


def variance_factor(spread: np.ndarray, count: int, freedom: int) -> float:
    r"""The factor on the covariance for unit noise, from `WindowFactors.spread`.

    Without robust losses it is the variance of the whitened residuals. With them it is
    $\overline{|\psi|^2}/\overline{\psi'}^2$ for $\psi = \rho' r$ (Huber & Ronchetti, "Robust
    Statistics", 2nd ed., 2009, section 7.6), times the slope in the linearised problem.
    `count` is the number of residuals. Infinite without degrees of freedom.
    """
    if freedom == 0:
        return np.inf
    squares, slopes, in_problem = np.sum(spread.astype(float), axis=0)
    return squares / freedom * count * in_problem / slopes**2
