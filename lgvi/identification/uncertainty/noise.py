"""How large the noise was, from the residuals that are left."""

from typing import NamedTuple

import numpy as np

from ..data.recordings import Recordings
from ..windows.layout import Layout
from ..windows.residuals import Residuals
from .information import Information

NO_NOISE = 1e-12  # variance of a whitened residual below which only rounding is left


def number_of_readings(layout: Layout) -> int:
    given = [readings for _, windows in layout.parts for readings in windows.readings]
    return sum(int(readings.mask.sum()) for readings in given if readings is not None)


def degrees_of_freedom(layout: Layout, known: Information) -> int:
    """Number of residuals less that of unknowns that they determine."""
    return max(0, 3 * number_of_readings(layout) - known.rank)


def part_left(recordings: Recordings, freedom: int) -> float:
    """What part of the squares of the noise fitted numbers leave."""
    return freedom / sum(3 * len(samples.times) for samples in recordings.sensed if samples)


class Correlation(NamedTuple):
    """Of successive residuals of a sensor."""

    value: float
    error: float  # its standard error


def correlations(residuals: Residuals, recordings: Recordings) -> tuple[Correlation | None, ...]:
    """Correlation of successive whitened residuals of each sensor.

    The initial states fitted to them take a line off attitudes and a constant off rates, about,
    which leaves even white noise anticorrelated; here that is taken off again.
    """
    found = []
    for r, samples, fitted in zip(residuals, recordings.sensed, (2, 1), strict=True):
        if r is None or samples is None:
            found.append(None)
            continue
        products = squares = by_fit = 0.0
        pairs = left = count = 0
        times, of_trajectories = samples.split(samples.times), samples.split(np.asarray(r))
        for t, of_trajectory in zip(times, of_trajectories, strict=True):
            if len(t) <= fitted:
                continue
            line = np.linalg.qr(np.vander((t - t[0]) / (t[-1] - t[0]), fitted))[0]
            by_fit += np.sum(line[1:] * line[:-1])
            products += np.mean(np.sum(of_trajectory[1:] * of_trajectory[:-1], axis=0))
            squares += np.mean(np.sum(of_trajectory**2, axis=0))
            pairs, left, count = pairs + len(t) - 1, left + len(t) - fitted, count + len(t)
        if not left:
            found.append(None)
            continue
        value = (products * left / squares + by_fit) / pairs if squares else 0.0
        error = count / left / np.sqrt(3 * pairs)
        found.append(Correlation(float(np.clip(value, -1, 1)), float(error)))
    return tuple(found)


def variance_factor(spread: np.ndarray, count: int, freedom: int) -> float:
    r"""What the covariance for unit noise is to be multiplied with, from `Factors.spread`.

    Without robust losses the variance of the whitened residuals. With them
    $\overline{|\psi|^2}/\overline{\psi'}^2$ for $\psi = \rho' r$ (Huber & Ronchetti, "Robust
    Statistics", 2nd ed., 2009, section 7.6), times the slope that the linearised problem holds.
    Infinite if as many numbers were fitted as were read, `count` times three.
    """
    if freedom == 0:
        return np.inf
    squares, slopes, held = np.sum(spread.astype(float), axis=0)
    return squares / freedom * count * held / slopes**2
