"""The fit of one configuration: its model, states, and residuals in a few numbers."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy.special import chdtrc, chdtri

from ..data.recordings import Recordings
from ..data.samples import OfTrajectory
from ..model.configuration import Configuration
from ..model.model import Model
from ..model.states import InitialStates
from ..segments.chain import ReadingArrays, Which
from ..solver.elimination import STATE_SIZE
from ..uncertainty.information import NO_NOISE
from .problem import FitResult, Problem, SimulatedReadings

CORRELATED = 0.1  # correlation of successive residuals, at most, that does not matter
MOST_SQUARES = 1_000_000  # residuals of a channel, evenly chosen, whose median is taken
OUTLYING = 2.0  # ratio of an outlier's residuals, at least, to those of the median trajectory


class Correlation(NamedTuple):
    """Correlation of successive residuals of a channel."""

    value: float
    error: float  # its standard error
    of_axes: np.ndarray  # (m,)

    @property
    def is_certain(self) -> bool:
        """Whether the correlation is large enough to matter, and not by chance."""
        return self.value > CORRELATED + 4 * self.error


class OfChannel(NamedTuple):
    """The whitened residuals of a channel in a few numbers."""

    chi_square: np.ndarray  # (trajectories,), sum of squares
    mean_square: np.ndarray  # (m,)
    median_square: float  # of the lengths of residuals
    correlation: Correlation | None  # None if there are not enough residuals


def summarise(
    model: Model,
    recordings: Recordings,
    parts: Iterable[tuple[Iterable[OfTrajectory], Mapping[str, np.ndarray]]],
) -> dict[str, OfChannel]:
    """Residuals (readings, m) of each channel in a few numbers.

    `parts` are successive groups of trajectories of the recordings, with their residuals.
    """
    sums_of_channels = {}
    for channel, sensor in model.sensors.items():
        total = int(np.sum(recordings.channels[channel].count))
        fitted = 2 if sensor.depends_on_attitude else 1
        sums_of_channels[channel] = _Sums(len(sensor.axes), fitted, -(-total // MOST_SQUARES) or 1)
    for trajectories, residuals in parts:
        first = dict.fromkeys(sums_of_channels, 0)
        for samples in trajectories:
            for channel, sums in sums_of_channels.items():
                t = samples[channel][0]
                begin, end = first[channel], first[channel] + len(t)
                sums.add(t, residuals[channel][begin:end])
                first[channel] = end
    return {channel: sums.summary() for channel, sums in sums_of_channels.items()}


class _Sums:
    """Sums over the trajectories that were added, for one channel."""

    def __init__(self, axes: int, fitted: int, spacing: int):
        self.fitted, self.spacing = fitted, spacing
        self.chi_square: list[float] = []
        self.kept_squares: list[np.ndarray] = []
        self.all_squares = np.zeros(axes)  # squares of all residuals
        self.products, self.squares = np.zeros(axes), np.zeros(axes)
        self.by_fit = 0.0
        self.readings = self.pairs = self.left = self.count = 0

    def add(self, t: np.ndarray, r: np.ndarray) -> None:
        """Add the residuals (readings, m) of a trajectory."""
        squares = np.sum(r**2, axis=0)
        self.chi_square.append(float(np.sum(squares)))
        kept = r[-self.readings % self.spacing :: self.spacing]
        self.kept_squares.append(np.sum(kept**2, axis=1))
        self.all_squares += squares
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

    def summary(self) -> OfChannel:
        """The residuals that were added, in a few numbers."""
        median = np.median(np.concatenate(self.kept_squares)) if self.readings else np.nan
        return OfChannel(
            np.array(self.chi_square),
            self.all_squares / (self.readings or np.nan),
            float(median),
            self._correlation(),
        )

    def _correlation(self) -> Correlation | None:
        """Correlation of successive residuals.

        Initial states are fitted to the residuals, which makes even white noise anticorrelated:
        the fit removes about a line from readings that depend on the attitude, and a constant from
        other readings. The correlation is corrected for this.
        """
        if not self.left:
            return None
        products = np.append(self.products, np.mean(self.products))
        squares = np.append(self.squares, np.mean(self.squares))
        ratio = np.divide(products, squares, out=np.zeros_like(products), where=squares > 0)
        values = (ratio * self.left + self.by_fit * (squares > 0)) / self.pairs
        values = np.clip(values, -1, 1)
        error = self.count / self.left / np.sqrt(len(self.all_squares) * self.pairs)
        return Correlation(float(values[-1]), float(error), values[:-1])


def count_state(model: Model) -> int:
    """The number of fitted numbers of an initial state."""
    # Where no sensor depends on the attitude, the initial attitude is not fitted.
    has_attitude = any(sensor.depends_on_attitude for sensor in model.sensors.values())
    return STATE_SIZE if has_attitude else STATE_SIZE // 2


class FittedPart(eqx.Module):
    """One configuration after a fit.

    Attributes
    ----------
    model
        The model with the estimated leaves. Leaves that each trajectory has of its own are as at
        the start.
    recordings
        The recordings that were fitted.
    states
        The estimated initial states, at the first sample of each trajectory.
    own
        A model of the leaves that each trajectory has of its own (trajectories, ...), and no other
        leaves; None if there are no such leaves.
    noise_fraction
        The part of the squares of the noise that the fit leaves in residuals, approximately:
        degrees of freedom over residuals.
    summary
        The residuals of each channel in a few numbers.
    simulate
        A function that gives the `"residuals"`, or the `"predicted"` readings.
    """

    model: Model
    recordings: Recordings
    states: InitialStates
    summary: dict[str, OfChannel]
    noise_fraction: float
    own: Any
    simulate: Callable[[Which], ReadingArrays]

    @property
    def residuals(self) -> dict[str, Float[np.ndarray, "samples m"]]:
        """Whitened residuals of each channel (samples, m), of all trajectories one after another.

        See [`Samples.split`][lgvi.identification.Samples]. Residuals of more than some hundred
        thousand readings are not kept, but simulated again on each use.
        """
        return self.simulate("residuals")

    @property
    def predicted(self) -> dict[str, Float[np.ndarray, "samples ..."]]:
        """Simulated readings of the sensor of each channel without noise (samples, ...).

        In the order of the residuals.
        """
        return self.simulate("predicted")

    @property
    def trajectory_chi_square(self) -> Float[np.ndarray, " trajectories"]:
        """Sum of the squared whitened residuals of each trajectory."""
        return np.sum([channel.chi_square for channel in self.summary.values()], axis=0)

    @property
    def trajectory_freedom(self) -> Float[np.ndarray, " trajectories"]:
        """Number of residuals of each trajectory, less the number of its own unknowns."""
        own_count = sum(np.size(leaf[0]) for leaf in jax.tree.leaves(self.own))
        return self._residual_counts - (count_state(self.model) + own_count)

    @property
    def _residual_counts(self) -> np.ndarray:
        """Number of residuals of each trajectory (trajectories,)."""
        counts = [
            len(sensor.axes) * self.recordings.channels[channel].count
            for channel, sensor in self.model.sensors.items()
        ]
        return np.sum(counts, axis=0)

    @property
    def expected_chi_square(self) -> Float[np.ndarray, " trajectories"]:
        """The sum of squares of each trajectory that the fit leaves of noise of unit variance."""
        freedom = self.trajectory_freedom
        total = self.noise_fraction * np.sum(self._residual_counts)
        return freedom * total / max(np.sum(freedom), 1)

    @property
    def correlations(self) -> dict[str, Correlation]:
        """How successive residuals of each channel are correlated, where there are enough."""
        correlations = {name: channel.correlation for name, channel in self.summary.items()}
        return {name: value for name, value in correlations.items() if value is not None}

    @property
    def residual_rms(self) -> dict[str, Float[np.ndarray, " m"]]:
        """Root mean square of the residuals about each axis (m,) of each channel.

        In the unit of the sensor's `sigma`, corrected for the part that the fit removes: an
        estimate of `sigma`. NaN if as many numbers are fitted as were read.
        """
        return {
            name: np.asarray(self.model.sensors[name].sigma, float)
            * np.sqrt(channel.mean_square / (self.noise_fraction or np.nan))
            for name, channel in self.summary.items()
        }

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of trajectories that do not fit, to be looked at, or dropped from the recordings.

        Residuals of an outlier are more than twice as large as those of the median trajectory. By
        chance there is an outlier in less than one of a thousand sets of recordings.
        """
        freedom = self.trajectory_freedom
        judged = freedom > 0  # other trajectories are fitted exactly
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
            name: np.sqrt(
                channel.median_square / self.noise_fraction / chdtri(len(channel.mean_square), 0.5)
            )
            for name, channel in self.summary.items()
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
            sigmas = np.array2string(sigma, formatter={"float": "{:.4g}".format})
            sizes = ", ".join(f"{size:.4g}" for size in self.residual_rms[channel])
            by_axis = ", ".join(f"{r:+.3f}" for r in correlation.of_axes)
            yield (
                f"{channel.replace('_', ' ')}: residual {rms:.4g} {sensor.unit} for each axis, "
                f"{usual:.4g} {sensor.unit} by the median (sigma {sigmas}), correlation of "
                f"successive ones {correlation.value:+.3f} +- {correlation.error:.3f}; of "
                f"{', '.join(sensor.axes)}: residuals {sizes}, correlations {by_axis}"
            )
        outliers = self.outliers
        if outliers:
            yield f"trajectories that do not fit: {len(outliers)}: {', '.join(outliers)}"
        if self.recordings.dropped:
            yield f"dropped: {'; '.join(self.recordings.dropped)}"


def fitted_parts(problem: Problem, result: FitResult) -> dict[str, FittedPart]:
    """The fit of each configuration, by its name, with the estimated parameters in a problem."""
    level = result.level
    simulated = SimulatedReadings(result.problem, level, result.theta, result.states)
    sizes = np.array([_count_residuals(part) for part in problem.configurations])
    unknowns = [
        (count_state(part.model) + len(part.own_start)) * len(part.recordings)
        for part in problem.configurations
    ]
    by_states = np.maximum(sizes - unknowns, 0)  # residuals that the initial states leave
    total = int(problem.processes.sum(np.sum(by_states)))
    noise_fractions = by_states * (result.freedom / max(1, total)) / sizes
    parts = {}
    for k, configuration in enumerate(problem.configurations):
        model = configuration.model_at(problem.parameters, problem.free, problem.free.theta)
        states = result.states.at(level.first_windows_of(k))
        residuals = simulated.in_parts(k, "residuals")
        parts[configuration.name] = FittedPart(
            model=model,
            recordings=configuration.recordings,
            states=jax.device_put(configuration.initial_states(states)),
            summary=summarise(configuration.model, configuration.recordings, residuals),
            noise_fraction=float(noise_fractions[k]),
            own=configuration.own_of(states),
            simulate=partial(simulated.of_configuration, k),
        )
    return parts


def _count_residuals(configuration: Configuration) -> int:
    channels = configuration.recordings.channels
    return sum(
        len(sensor.axes) * int(np.sum(channels[channel].count))
        for channel, sensor in configuration.model.sensors.items()
    )
