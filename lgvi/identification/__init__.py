"""From recordings of a body's motion to its parameters, with their uncertainty."""

from .data.recordings import Recordings
from .data.samples import Samples
from .diagnosis.doubts import Suspect
from .estimate import Estimate, JointEstimate
from .experiment import Identifiability, identifiability
from .fitted_part import FittedPart
from .identify import identify
from .identify_jointly import identify_jointly
from .likelihood import negative_log_likelihood
from .model.model import Model
from .model.states import InitialStates
from .simulate import simulate_recordings
from .windows.initial_guess import initial_states

__all__ = [
    "Estimate",
    "FittedPart",
    "Identifiability",
    "InitialStates",
    "JointEstimate",
    "Model",
    "Recordings",
    "Samples",
    "Suspect",
    "identifiability",
    "identify",
    "identify_jointly",
    "initial_states",
    "negative_log_likelihood",
    "simulate_recordings",
]
