"""What an identification returns."""

from collections.abc import Iterator
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.special import chdtrc, chdtri

from .data.recordings import Recordings
from .model.free import Free
from .model.model import Model
from .model.states import InitialStates
from .report import format_table
from .uncertainty.information import Information
from .uncertainty.noise import NO_NOISE, compute_correlations
from .uncertainty.posterior import AbstractPosterior

OUTLYING = 2.0  # times the residuals of the median trajectory
Noise = Literal["residuals", "given"]


class Estimate(AbstractPosterior):
    """The most likely values of the free leaves, with their covariance.

    Attributes
    ----------
    model
        The model with the estimated leaves.
    states
        The estimated initial states, at the first sample of each trajectory.
    converged
        Whether the fit reached a minimum.
    iterations
        Number of iterations of Levenberg and Marquardt's method, at all lengths of windows.
    chi_square
        Sum of the losses: of the squared whitened residuals, if no loss is robust.
    degrees_of_freedom
        Number of residuals minus number of estimated numbers.
    step_bias
        Shift of the estimate by the step of the integrator, in standard errors: the largest of any
        combination of the free leaves.
    unobservable
        The directions of the free leaves that are not observable, in words.
    messages
        What the user should know, in words.
    recordings
        What was fitted.
    residuals
        Whitened residuals of each channel (samples, m), of all trajectories one after another; see
        [`Samples.split`][lgvi.identification.Samples].
    predicted
        What the sensor of each channel reads without noise (samples, ...), in the same order.
    variance
        The factor on the covariance for unit noise: 1, or the variance of the residuals.
    scaled
        Names of the leaves that are known only as parts of the trace of the inertia.
    free, information
        The free leaves as a vector, and the information on the vector.
    """

    model: Model
    states: InitialStates
    recordings: Recordings
    residuals: dict[str, Float[np.ndarray, "samples m"]]
    predicted: dict[str, Float[np.ndarray, "samples ..."]]
    converged: bool
    iterations: int
    chi_square: float
    degrees_of_freedom: int
    step_bias: float
    unobservable: tuple[str, ...]
    messages: tuple[str, ...]
    variance: float
    scaled: tuple[str, ...]
    free: Free
    information: Information

    @property
    def trajectory_chi_square(self) -> Float[np.ndarray, " trajectories"]:
        """Sum of the squared whitened residuals of each trajectory."""
        total = np.zeros(len(self.recordings))
        for channel, r in self.residuals.items():
            trajectory = np.repeat(np.arange(len(total)), self.recordings.channels[channel].count)
            total += np.bincount(trajectory, np.sum(r**2, axis=1), len(total))
        return total

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of trajectories that do not fit, to be looked at, or dropped from the recordings.

        Their residuals are more than twice as large as the residuals of the median trajectory. By
        chance that happens in less than one of a thousand sets of recordings.
        """
        counts = [
            len(sensor.axes) * self.recordings.channels[channel].count
            for channel, sensor in self.model.sensors.items()
        ]
        freedom = np.sum(counts, axis=0) - 6
        judged = freedom > 0  # others are fitted exactly
        if not judged.any():
            return ()
        freedom, chi_square = freedom[judged], self.trajectory_chi_square[judged]
        ratio = chi_square / freedom
        median = np.median(ratio)
        chance = chdtrc(freedom, chi_square / max(median, NO_NOISE))
        outlying = (chance < 1e-3 / len(ratio)) & (ratio > OUTLYING**2 * median)
        return tuple(np.array(self.recordings.names)[judged][outlying].tolist())

    def __str__(self) -> str:
        return f"{format_table(self)}\n\n{_statistics(self)}"

    def report(self) -> None:
        """Print a table of all estimated numbers, and how well the model fits."""
        print(self)


def _statistics(estimate: Estimate) -> str:
    """How well the model fits, and which trajectories it does not."""
    chi_square, freedom = estimate.chi_square, estimate.degrees_of_freedom
    lines = [f"trajectories: {len(estimate.recordings)}, degrees of freedom: {freedom}"]
    if freedom:
        kind = "robust loss" if estimate.model.is_robust else "chi-square"
        lines[0] += f", {kind} for each: {chi_square / freedom:.4g}"
    lines += _of_channels(estimate)
    outliers = estimate.outliers
    if outliers:
        lines.append(f"trajectories that do not fit: {len(outliers)}: {', '.join(outliers)}")
    if estimate.recordings.dropped:
        lines.append(f"dropped: {'; '.join(estimate.recordings.dropped)}")
    lines.append(
        f"{'converged' if estimate.converged else 'NOT CONVERGED'} after {estimate.iterations} "
        f"iterations; the step of the integrator moves the estimate by {estimate.step_bias:.1g} "
        "standard errors"
    )
    lines += [f"not observable: {words}" for words in estimate.unobservable]
    lines += [f"note: {message}" for message in estimate.messages]
    return "\n".join(lines)


def _of_channels(estimate: Estimate) -> Iterator[str]:
    """The size of the residuals of each channel, and how they are correlated."""
    part_left = estimate.degrees_of_freedom / sum(r.size for r in estimate.residuals.values())
    if not part_left:
        return
    found = compute_correlations(estimate.model, estimate.residuals, estimate.recordings)
    for channel, correlation in found.items():
        sensor, axes = estimate.model.sensors[channel], estimate.residuals[channel].shape[1]
        s = np.sum(estimate.residuals[channel] ** 2, axis=1) / part_left
        sigma = np.asarray(sensor.sigma, float)
        size = np.sqrt(np.mean(sigma**2))
        rms = size * np.sqrt(np.mean(s) / axes)
        usual = size * np.sqrt(np.median(s) / chdtri(axes, 0.5))  # outliers hardly change it
        given = np.array2string(sigma, formatter={"float": "{:.4g}".format})
        yield (
            f"{channel.replace('_', ' ')}: residual {rms:.4g} {sensor.unit} for each axis, "
            f"{usual:.4g} {sensor.unit} by the median (sigma {given}), correlation of successive "
            f"ones {correlation.value:+.3f} +- {correlation.error:.3f}"
        )
