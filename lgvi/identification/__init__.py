"""From recordings of a body's motion to its parameters, with their uncertainty."""

from .data.recordings import Recordings
from .data.samples import Samples
from .estimate import Estimate
from .experiment import Identifiability, identifiability
from .identify import identify
from .likelihood import negative_log_likelihood
from .model.model import Model
from .model.states import InitialStates
from .simulate import simulate_recordings
from .windows.initial_guess import initial_states

__all__ = [
    "Estimate",
    "Identifiability",
    "InitialStates",
    "Model",
    "Recordings",
    "Samples",
    "identifiability",
    "identify",
    "initial_states",
    "negative_log_likelihood",
    "simulate_recordings",
]
