"""From recordings of a body's motion to its parameters, with their uncertainty."""

from .data.recordings import Recordings as Recordings
from .data.samples import Samples as Samples
from .diagnosis.doubts import Suspect as Suspect
from .estimate import Estimate as Estimate
from .estimate import JointEstimate as JointEstimate
from .experiment import Identifiability as Identifiability
from .experiment import identifiability as identifiability
from .fitted_part import FittedPart as FittedPart
from .identify import identify as identify
from .identify_jointly import identify_jointly as identify_jointly
from .likelihood import negative_log_likelihood as negative_log_likelihood
from .model.model import Model as Model
from .model.states import InitialStates as InitialStates
from .simulate import simulate_recordings as simulate_recordings
from .windows.initial_guess import initial_states as initial_states
