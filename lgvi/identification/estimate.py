"""What an identification returns."""

from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.special import chdtrc, chdtri

from .data.recordings import Recordings
from .model.free import Free
from .model.model import Model
from .model.states import InitialStates
from .report import table
from .uncertainty.information import Information
from .uncertainty.noise import NO_NOISE, correlations, part_left
from .uncertainty.posterior import AbstractKnowledge
from .windows.residuals import Residuals

OUTLYING = 2.0  # times the residuals of the median trajectory
Noise = Literal["residuals", "given"]


class Estimate(AbstractKnowledge):
    """The most likely values of the free leaves, and how well they are known.

    Attributes
    ----------
    model
        The model with the estimated leaves.
    states
        The estimated initial states, at the first sample of each trajectory.
    converged
        Whether the fit reached a minimum.
    iterations
        Of Levenberg and Marquardt's method, at all levels.
    chi_square
        Sum of the losses: of the squared whitened residuals, if no loss is robust.
    degrees_of_freedom
        Number of residuals less that of estimated numbers.
    step_bias
        How far the step of the integrator moves the estimate, in standard errors: the largest for
        any combination of the free leaves.
    unobservable
        The directions of the free leaves that the recordings do not determine, in words.
    messages
        What the user should know, in words.
    recordings
        What was fitted.
    residuals
        Whitened residuals of each sensor (samples, 3), of all trajectories one after another; see
        [`Samples.split`][lgvi.identification.Samples].
    variance
        What the covariance for unit noise is multiplied with: 1, or the variance of the residuals.
    scaled
        Names of the leaves that are known only as parts of the trace of the inertia.
    free, information
        The free leaves as a vector, and what is known of it.
    """

    model: Model
    states: InitialStates
    recordings: Recordings
    residuals: Residuals
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
        for r, samples in zip(self.residuals, self.recordings.sensed, strict=True):
            if r is not None and samples is not None:
                trajectory = np.repeat(np.arange(len(total)), samples.count)
                total += np.bincount(trajectory, np.sum(r**2, axis=1), len(total))
        return total

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of trajectories that do not fit, to be looked at, or dropped from the recordings.

        Their residuals are more than twice as large as those of the median trajectory, which
        is found in less than one of a thousand sets of recordings by chance.
        """
        sensed = self.recordings.sensed
        readings = np.sum([each.count for each in sensed if each is not None], axis=0)
        freedom = 3 * readings - 6
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
        return f"{table(self)}\n\n{_statistics(self)}"

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
    for name, unit, sensor, rms, usual, found in _sensors(estimate):
        lines.append(
            f"{name}: residual {rms:.4g} {unit} for each axis, {usual:.4g} {unit} by the median "
            f"(sigma {sensor}), correlation of successive ones {found.value:+.3f} +- "
            f"{found.error:.3f}"
        )
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


def _sensors(estimate: Estimate):
    model, recorded = estimate.model, estimate.recordings.sensed
    part = part_left(estimate.recordings, estimate.degrees_of_freedom)
    named = (("attitude", "rad"), ("angular velocity", "rad/s"))
    found = correlations(estimate.residuals, estimate.recordings)
    for (name, unit), sensor, r, samples, correlation in zip(
        named, model.sensors, estimate.residuals, recorded, found, strict=True
    ):
        if sensor is None or r is None or samples is None or correlation is None or not part:
            continue
        s = np.sum(r**2, axis=1) / part
        size = np.sqrt(np.mean(np.asarray(sensor.sigma) ** 2))
        rms = size * np.sqrt(np.mean(s) / 3)
        usual = size * np.sqrt(np.median(s) / chdtri(3, 0.5))  # outliers hardly change it
        sigma = np.array2string(
            np.asarray(sensor.sigma, float), formatter={"float": "{:.4g}".format}
        )
        yield name, unit, sigma, rms, usual, correlation
