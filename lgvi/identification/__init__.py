"""From recordings of a body's motion to its parameters, with their uncertainty."""

from .estimate import Estimate
from .likelihood import negative_log_likelihood
from .maximum_likelihood import identify
from .model import Model
from .recordings import Recordings, Samples
from .residuals import InitialStates
from .starts import initial_states

__all__ = [
    "Estimate",
    "InitialStates",
    "Model",
    "Recordings",
    "Samples",
    "identify",
    "initial_states",
    "negative_log_likelihood",
]
