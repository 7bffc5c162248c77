"""The residuals of a fit in a few numbers, taken from some trajectories after others."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from ..data.recordings import Recordings
from ..data.samples import OfTrajectory
from ..model.model import Model

CORRELATED = 0.1  # of successive residuals, at most, that does not matter
MOST_SQUARES = 1_000_000  # residuals of a channel, evenly chosen, whose median is taken


class Correlation(NamedTuple):
    """Correlation of successive residuals of a channel."""

    value: float
    error: float  # its standard error
    of_axes: np.ndarray  # (m,)

    @property
    def is_certain(self) -> bool:
        """Whether it is larger than what does not matter, and not by chance."""
        return self.value > CORRELATED + 4 * self.error


class OfChannel(NamedTuple):
    """What the whitened residuals of a channel are like."""

    chi_square: np.ndarray  # (trajectories,), sum of squares
    mean_square: np.ndarray  # (m,)
    median_square: float  # of the lengths of residuals
    correlation: Correlation | None  # None if there are not enough


def summarise(
    model: Model,
    recordings: Recordings,
    parts: Iterable[tuple[Iterable[OfTrajectory], Mapping[str, np.ndarray]]],
) -> dict[str, OfChannel]:
    """Residuals (readings, m) of each channel in a few numbers.

    `parts` are some trajectories of the recordings after others, with their residuals.
    """
    found = {}
    for channel, sensor in model.sensors.items():
        total = int(np.sum(recordings.channels[channel].count))
        fitted = 2 if sensor.depends_on_attitude else 1
        found[channel] = _Sums(len(sensor.axes), fitted, -(-total // MOST_SQUARES) or 1)
    for trajectories, residuals in parts:
        first = dict.fromkeys(found, 0)
        for each in trajectories:
            for channel, sums in found.items():
                t = each[channel][0]
                begin, end = first[channel], first[channel] + len(t)
                sums.add(t, residuals[channel][begin:end])
                first[channel] = end
    return {channel: sums.of_channel() for channel, sums in found.items()}


class _Sums:
    """Sums over the trajectories that were added."""

    def __init__(self, axes: int, fitted: int, spacing: int):
        self.fitted, self.spacing = fitted, spacing
        self.chi_square: list[float] = []
        self.some: list[np.ndarray] = []
        self.every = np.zeros(axes)  # squares of all residuals
        self.products, self.squares = np.zeros(axes), np.zeros(axes)
        self.by_fit = 0.0
        self.readings = self.pairs = self.left = self.count = 0

    def add(self, t: np.ndarray, r: np.ndarray) -> None:
        """Add the residuals (readings, m) of a trajectory."""
        squares = np.sum(r**2, axis=0)
        self.chi_square.append(float(np.sum(squares)))
        some = r[-self.readings % self.spacing :: self.spacing]
        self.some.append(np.sum(some**2, axis=1))
        self.every += squares
        self.readings += len(t)
        if len(t) <= self.fitted:
            return
        line = np.linalg.qr(np.vander((t - t[0]) / (t[-1] - t[0]), self.fitted))[0]
        self.by_fit += np.sum(line[1:] * line[:-1])
        self.products += np.sum(r[1:] * r[:-1], axis=0)
        self.squares += squares
        self.pairs += len(t) - 1
        self.left += len(t) - self.fitted
        self.count += len(t)

    def of_channel(self) -> OfChannel:
        """What was added, in a few numbers."""
        none = not self.readings
        return OfChannel(
            np.array(self.chi_square),
            np.full(len(self.every), np.nan) if none else self.every / self.readings,
            np.nan if none else float(np.median(np.concatenate(self.some))),
            self._correlation(),
        )

    def _correlation(self) -> Correlation | None:
        """Correlation of successive residuals.

        Initial states are fitted to the residuals, which makes even white noise anticorrelated:
        that takes a line off readings which depend on the attitude, and a constant off others,
        about. This corrects for it.
        """
        if not self.left:
            return None
        products = np.append(self.products, np.mean(self.products))
        squares = np.append(self.squares, np.mean(self.squares))
        ratio = np.divide(products, squares, out=np.zeros_like(products), where=squares > 0)
        values = (ratio * self.left + self.by_fit * (squares > 0)) / self.pairs
        values = np.clip(values, -1, 1)
        error = self.count / self.left / np.sqrt(len(self.every) * self.pairs)
        return Correlation(float(values[-1]), float(error), values[:-1])
