"""What an identification returns."""

from typing import Any

import numpy as np
from jaxtyping import Float

from .data.recordings import Recordings
from .fitted_part import FittedPart
from .model.model import Model
from .model.states import InitialStates
from .reported_estimate import AbstractReportedEstimate


class JointEstimate(AbstractReportedEstimate):
    """The most likely values of the free leaves of parameters, with their covariance.

    Attributes
    ----------
    parameters
        The parameters with the estimated leaves.
    parts
        For each configuration by its name the model, the recordings, the initial states, the
        residuals and their size `residual_rms`, such as `estimate.parts["bare"].model`: a
        [`FittedPart`][lgvi.identification.FittedPart].
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
        The directions of the free leaves that are not observable, and a turn of the initial
        attitudes that is not, in words.
    messages
        What the user should know, in words.
    mistakes
        Usual mistakes of a log that another reading would mend, in words.
    reasons
        Why the model cannot hold, as far as the fit tells; see also `verdict`.
    errors
        The kind of standard errors that the report has, and that the methods give by default:
        `"independent"`, `"clustered"`, `"correlated"` or `"bootstrap"`; see
        [`identify`][lgvi.identification.identify].
    reason
        Why the errors are of that kind, in words.
    variance
        The factor on the covariance for unit noise and independent residuals: 1, or the variance
        of the residuals.
    prior
        What was known beforehand.
    scaled
        Names of the leaves that are known only as parts of the trace of the inertia.
    free, information
        The free leaves as a vector, and the information on the vector.
    """


class Estimate(AbstractReportedEstimate):
    """The most likely values of the free leaves of a model, with their covariance.

    As [`JointEstimate`][lgvi.identification.JointEstimate], with the model as the parameters, and
    what its one part has.
    """

    @property
    def _part(self) -> FittedPart:
        (part,) = self.parts.values()
        return part

    @property
    def model(self) -> Model:
        """The model with the estimated leaves; those of each trajectory are as at the start."""
        return self.parameters

    @property
    def body(self):
        """The body with the estimated leaves; of unit trace if the scale is not observable."""
        return self.model.body

    @property
    def recordings(self) -> Recordings:
        """What was fitted."""
        return self._part.recordings

    @property
    def states(self) -> InitialStates:
        """The estimated initial states, at the first sample of each trajectory."""
        return self._part.states

    @property
    def residuals(self) -> dict[str, Float[np.ndarray, "samples m"]]:
        """Whitened residuals of each channel; see `FittedPart`."""
        return self._part.residuals

    @property
    def predicted(self) -> dict[str, Float[np.ndarray, "samples ..."]]:
        """What the sensor of each channel reads without noise; see `FittedPart`."""
        return self._part.predicted

    @property
    def own(self) -> Any:
        """A model of the leaves that each trajectory has of its own; see `FittedPart`."""
        return self._part.own

    @property
    def trajectory_chi_square(self) -> Float[np.ndarray, " trajectories"]:
        """Sum of the squared whitened residuals of each trajectory."""
        return self._part.trajectory_chi_square

    @property
    def residual_rms(self) -> dict[str, Float[np.ndarray, " m"]]:
        """Root mean square of the residuals of each channel; see `FittedPart`."""
        return self._part.residual_rms

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of trajectories that do not fit; see `FittedPart`."""
        return self._part.outliers
