"""One configuration after a fit: its residuals, and the trajectories that do not fit."""

from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy.special import chdtrc, chdtri

from .data.recordings import Recordings
from .least_squares.block_arrow import OWN
from .model.model import Model
from .model.states import InitialStates
from .segments.chain import OfReadings, Which
from .uncertainty.noise import NO_NOISE
from .uncertainty.summary import Correlation, OfChannel

OUTLYING = 2.0  # times the residuals of the median trajectory


def count_state(model: Model) -> int:
    """How many numbers of an initial state are fitted."""
    # Where no sensor depends on the attitude, that at the start is not fitted.
    turned = any(sensor.depends_on_attitude for sensor in model.sensors.values())
    return OWN if turned else OWN // 2


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
    left
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
    left: float
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
            * np.sqrt(each.mean_square / (self.left or np.nan))
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
            channel: np.sqrt(each.median_square / self.left / chdtri(len(each.mean_square), 0.5))
            for channel, each in self.summary.items()
            if self.left
        }

    def statements(self) -> Iterator[str]:
        """The size of the residuals of each channel, how they are correlated, and outliers."""
        by_median = self.usual_residuals
        for channel, correlation in self.correlations.items() if self.left else ():
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
