"""How large the noise was, from the residuals that are left."""

from typing import Any, NamedTuple

import jax
import numpy as np

from .linearised import LEAST_CURVATURE
from .model import Model
from .observability import Information
from .recordings import Recordings
from .residuals import Residuals
from .samples import Samples
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


def correlations(
    residuals: Residuals, recordings: Recordings, freedom: int
) -> tuple[Correlation | None, ...]:
    """Correlation of successive whitened residuals of each sensor.

    The numbers fitted to them take a smooth part off, which leaves even white noise anticorrelated;
    here that is taken off again.
    """
    left = part_left(recordings, freedom)

    def of_sensor(r: Any, samples: Samples | None) -> Correlation | None:
        if r is None or samples is None or not left:
            return None
        r, mask = np.asarray(r, float), samples.mask
        both = mask[:, 1:] & mask[:, :-1]
        pairs = np.sum(r[:, 1:] * r[:, :-1], axis=2)[both]
        squares = np.sum(r**2, axis=2)[mask]
        found = np.mean(pairs) / np.mean(squares) if len(pairs) and np.any(squares) else 0.0
        error = 1 / np.sqrt(max(1, pairs.size * 3)) / left
        return Correlation(float(np.clip(found + 1 / left - 1, -1, 1)), float(error))

    return tuple(map(of_sensor, residuals, recordings.sensed))


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
