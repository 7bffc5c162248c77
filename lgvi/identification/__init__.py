"""From recordings of a body's motion to its parameters, with their uncertainty."""

from .data.recordings import Recordings as Recordings
from .data.samples import Samples as Samples
from .diagnosis.suspects import Suspect as Suspect
from .estimate.estimate import Estimate as Estimate
from .estimate.estimate import JointEstimate as JointEstimate
from .estimate.validation import Validation as Validation
from .fit.part import FittedPart as FittedPart
from .fit.profile import Profile as Profile
from .identifiability import Identifiability as Identifiability
from .identifiability import identifiability as identifiability
from .identify import identify as identify
from .identify import identify_jointly as identify_jointly
from .likelihood import negative_log_likelihood as negative_log_likelihood
from .model.model import Model as Model
from .model.states import InitialStates as InitialStates
from .planning.limits import Limits as Limits
from .planning.limits import LimitUse as LimitUse
from .planning.limits import Motors as Motors
from .planning.limits import Torques as Torques
from .planning.limits import Wheels as Wheels
from .planning.plan import Plan as Plan
from .planning.plan import plan as plan
from .simulate import simulate_recordings as simulate_recordings
from .start.guess import initial_states as initial_states
from .uncertainty.draws import PosteriorDraws as PosteriorDraws
