"""How large the noise was, from the residuals that are left."""

from typing import NamedTuple

import jax
import numpy as np

from .linearised import LEAST_CURVATURE
from .model import Model
from .observability import Information
from .recordings import Recordings
from .residuals import Residuals
from .windows import Windows

NO_NOISE = 1e-12  # variance of a whitened residual below which only rounding is left


def number_of_readings(windows: Windows) -> int:
    return sum(int(readings.mask.sum()) for readings in windows.readings if readings is not None)


def degrees_of_freedom(windows: Windows, known: Information) -> int:
    """Number of residuals less that of unknowns that they determine."""
    return max(0, 3 * number_of_readings(windows) - known.rank)


def part_left(recordings: Recordings, freedom: int) -> float:
    """What part of the squares of the noise fitted numbers leave."""
    return freedom / sum(3 * int(samples.mask.sum()) for samples in recordings.sensed if samples)


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
        for times, of_trajectory, mask in zip(samples.t, np.asarray(r), samples.mask, strict=True):
            t, of_trajectory = times[mask], of_trajectory[mask].astype(float)
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


def variance_factor(model: Model, residuals: Residuals, windows: Windows, freedom: int) -> float:
    r"""What the covariance for unit noise is to be multiplied with.

    Without robust losses the variance of the whitened residuals. With them
    $\overline{|\psi|^2}/\overline{\psi'}^2$ for $\psi = \rho' r$ (Huber & Ronchetti, "Robust
    Statistics", 2nd ed., 2009, section 7.6), times the slope that the linearised problem holds.
    Infinite if as many numbers were fitted as were read.
    """
    if freedom == 0:
        return np.inf
    squares = slopes = held = 0.0
    for sensor, r, readings in zip(model.sensors, residuals, windows.readings, strict=True):
        if sensor is None or r is None or readings is None:
            continue
        s = np.sum(np.asarray(r, float) ** 2, axis=-1)[np.asarray(readings.mask)]
        if sensor.loss is None:
            w, change = np.ones_like(s), np.zeros_like(s)
        else:
            w = np.asarray(sensor.loss.weight(s), float)
            change = np.asarray(jax.vmap(jax.grad(sensor.loss.weight))(s), float)
        squares += np.sum(w**2 * s)
        slopes += np.sum(w + 2 / 3 * change * s)
        held += np.sum(2 / 3 * w + np.maximum(w + 2 * change * s, LEAST_CURVATURE * w) / 3)
    count = number_of_readings(windows)
    return squares / freedom * count * held / slopes**2
