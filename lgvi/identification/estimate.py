"""What an identification returns."""

from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.special import chdtrc

from .knowledge import AbstractKnowledge
from .model import Free, Model
from .noise import NO_NOISE
from .observability import Information
from .recordings import Recordings
from .report import statistics, table
from .residuals import InitialStates, Residuals

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
        return f"{table(self)}\n\n{statistics(self)}"

    def report(self) -> None:
        """Print a table of all estimated numbers, and how well the model fits."""
        print(self)
