"""The residuals of a fit in a few numbers, taken from some trajectories after others."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy.special import chdtrc, chdtri

from ..data.recordings import Recordings
from ..data.samples import OfTrajectory
from ..model.model import Model
from ..model.states import InitialStates
from ..segments.chain import OfReadings, Which
from ..solver.elimination import STATE_SIZE
from ..uncertainty.information import NO_NOISE

CORRELATED = 0.1  # of successive residuals, at most, that does not matter
MOST_SQUARES = 1_000_000  # residuals of a channel, evenly chosen, whose median is taken

OUTLYING = 2.0  # times the residuals of the median trajectory


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


def count_state(model: Model) -> int:
    """How many numbers of an initial state are fitted."""
    # Where no sensor depends on the attitude, that at the start is not fitted.
    turned = any(sensor.depends_on_attitude for sensor in model.sensors.values())
    return STATE_SIZE if turned else STATE_SIZE // 2


class FittedPart(eqx.Module):
    """One configuration after a fit.

    Attributes
    ----------
    model
        The model with the estimated leaves. Leaves that each trajectory has of its own are those
        of the start.
    recordings
        What was fitted.
    states
        The estimated initial states, at the first sample of each trajectory.
    own
        A model of the leaves that each trajectory has of its own (trajectories, ...), with nothing
        else; None if there are none.
    noise_fraction
        The part of the squares of the noise that the fit leaves in residuals, about: degrees of
        freedom over residuals.
    summary
        What the residuals of each channel are like, in a few numbers.
    simulate
        A function that gives `"residuals"` or what is `"predicted"`.
    """

    model: Model
    recordings: Recordings
    states: InitialStates
    summary: dict[str, OfChannel]
    noise_fraction: float
    own: Any
    simulate: Callable[[Which], OfReadings]

    @property
    def residuals(self) -> dict[str, Float[np.ndarray, "samples m"]]:
        """Whitened residuals of each channel (samples, m), of all trajectories one after another.

        See [`Samples.split`][lgvi.identification.Samples]. Those of more than some hundred thousand
        readings are not kept: they are simulated again whenever they are asked for.
        """
        return self.simulate("residuals")

    @property
    def predicted(self) -> dict[str, Float[np.ndarray, "samples ..."]]:
        """What the sensor of each channel reads without noise (samples, ...), simulated.

        In the order of the residuals.
        """
        return self.simulate("predicted")

    @property
    def trajectory_chi_square(self) -> Float[np.ndarray, " trajectories"]:
        """Sum of the squared whitened residuals of each trajectory."""
        return np.sum([each.chi_square for each in self.summary.values()], axis=0)

    @property
    def trajectory_freedom(self) -> Float[np.ndarray, " trajectories"]:
        """Residuals of each trajectory, less the numbers that it has of its own."""
        counts = [
            len(sensor.axes) * self.recordings.channels[channel].count
            for channel, sensor in self.model.sensors.items()
        ]
        own = sum(np.size(leaf[0]) for leaf in jax.tree.leaves(self.own))
        return np.sum(counts, axis=0) - (count_state(self.model) + own)

    @property
    def correlations(self) -> dict[str, Correlation]:
        """How successive residuals of each channel are correlated, where there are enough."""
        found = {channel: each.correlation for channel, each in self.summary.items()}
        return {channel: each for channel, each in found.items() if each is not None}

    @property
    def residual_rms(self) -> dict[str, Float[np.ndarray, " m"]]:
        """Root mean square of the residuals about each axis (m,) of each channel.

        In the unit of the sensor's `sigma`, with the part that the fit has taken off put back: an
        estimate of `sigma`. NaN if as many numbers are fitted as were read.
        """
        return {
            channel: np.asarray(self.model.sensors[channel].sigma, float)
            * np.sqrt(each.mean_square / (self.noise_fraction or np.nan))
            for channel, each in self.summary.items()
        }

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of trajectories that do not fit, to be looked at, or dropped from the recordings.

        Their residuals are more than twice as large as the residuals of the median trajectory. By
        chance that happens in less than one of a thousand sets of recordings.
        """
        freedom = self.trajectory_freedom
        judged = freedom > 0  # others are fitted exactly
        if not judged.any():
            return ()
        freedom, chi_square = freedom[judged], self.trajectory_chi_square[judged]
        ratio = chi_square / freedom
        median = np.median(ratio)
        chance = chdtrc(freedom, chi_square / max(median, NO_NOISE))
        outlying = (chance < 1e-3 / len(ratio)) & (ratio > OUTLYING**2 * median)
        return tuple(np.array(self.recordings.names)[judged][outlying].tolist())

    @property
    def usual_residuals(self) -> dict[str, float]:
        """Residuals of each channel in units of `sigma`, by the median: outliers hardly count."""
        return {
            channel: np.sqrt(
                each.median_square / self.noise_fraction / chdtri(len(each.mean_square), 0.5)
            )
            for channel, each in self.summary.items()
            if self.noise_fraction
        }

    def statements(self) -> Iterator[str]:
        """The size of the residuals of each channel, how they are correlated, and outliers."""
        by_median = self.usual_residuals
        for channel, correlation in self.correlations.items() if self.noise_fraction else ():
            sensor = self.model.sensors[channel]
            sigma = np.asarray(sensor.sigma, float)
            rms = np.sqrt(np.mean(self.residual_rms[channel] ** 2))
            usual = np.sqrt(np.mean(sigma**2)) * by_median[channel]
            given = np.array2string(sigma, formatter={"float": "{:.4g}".format})
            sizes = ", ".join(f"{size:.4g}" for size in self.residual_rms[channel])
            by_axis = ", ".join(f"{r:+.3f}" for r in correlation.of_axes)
            yield (
                f"{channel.replace('_', ' ')}: residual {rms:.4g} {sensor.unit} for each axis, "
                f"{usual:.4g} {sensor.unit} by the median (sigma {given}), correlation of "
                f"successive ones {correlation.value:+.3f} +- {correlation.error:.3f}; of "
                f"{', '.join(sensor.axes)}: residuals {sizes}, correlations {by_axis}"
            )
        outliers = self.outliers
        if outliers:
            yield f"trajectories that do not fit: {len(outliers)}: {', '.join(outliers)}"
        if self.recordings.dropped:
            yield f"dropped: {'; '.join(self.recordings.dropped)}"
