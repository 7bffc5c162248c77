"""From recordings of a body's motion to its parameters, with their uncertainty."""

from .estimate import Estimate
from .likelihood import negative_log_likelihood
from .maximum_likelihood import identify
from .model import Model
from .planning import Identifiability, identifiability
from .recordings import Recordings
from .samples import Samples
from .starts import initial_states
from .states import InitialStates
from .synthetic import simulate_recordings

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
