"""What an experiment would tell, before any data."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import ArrayLike, Float

from ..modules.body import AbstractRigidBody
from ..modules.integrator import MoserVeselovIntegrator
from ..modules.torques.base import Torque
from .arguments import Sensor, model_of, require_noise
from .data.recordings import Recordings
from .fit import TURN_OF_STEP
from .least_squares.linearise import linearised
from .model.free import Free, Where, body_of, free_leaves
from .model.model import Model
from .model.states import InitialStates
from .report import table
from .simulate import simulate_recordings
from .uncertainty.information import Information, information
from .uncertainty.posterior import AbstractKnowledge
from .uncertainty.unobservable import described
from .windows.grid import whole
from .windows.initial_guess import largest_rates
from .windows.layout import lay_out
from .windows.step_size import method_for


class Identifiability(AbstractKnowledge):
    """What an experiment would tell of the free leaves, with the noise that the sensors are given.

    Attributes
    ----------
    model
        The model at which it was found.
    unobservable
        The directions of the free leaves that would not be determined, in words, and what would
        show them.
    scaled
        Names of the leaves that would be known only as parts of the trace of the inertia.
    variance
        1: standard errors are those of the given noise.
    free, information
        The free leaves as a vector, and what would be known of it.
    """

    model: Model
    unobservable: tuple[str, ...]
    scaled: tuple[str, ...]
    variance: float
    free: Free
    information: Information

    @property
    def singular_values(self) -> Float[np.ndarray, " leaves"]:
        """Of the whitened Jacobian with respect to the free leaves, initial states eliminated.

        One divided by it is the standard error along its direction; so zero, to rounding, is what
        is not observable.
        """
        return self.information.singular_values()

    def __str__(self) -> str:
        values = ", ".join(f"{value:.3g}" for value in self.singular_values)
        lines = [table(self), "", f"singular values of the whitened Jacobian: {values}"]
        return "\n".join([*lines, *(f"not observable: {words}" for words in self.unobservable)])

    def report(self) -> None:
        """Print a table of the standard errors to expect, and what would not be observable."""
        print(self)


def identifiability(
    body: AbstractRigidBody,
    layout: Recordings | ArrayLike,
    sensors: Sensor | Sequence[Sensor],
    states: InitialStates,
    integrator: MoserVeselovIntegrator | None = None,
    *,
    torque: Torque | None = None,
    rotor_inertia: ArrayLike = 1.0,
    time_scale: ArrayLike = 1.0,
    free: Where = body_of,
) -> Identifiability:
    """What would be known after an experiment, before there are any data.

    The motion is simulated, and the derivative of what the sensors read is taken with respect to
    the free leaves and the initial states, which are unknown too.

    Parameters
    ----------
    body, layout, sensors, states, integrator, torque, rotor_inertia, time_scale
        The experiment, as for
        [`simulate_recordings`][lgvi.identification.simulate_recordings].
    free
        What is to be estimated, as for [`identify`][lgvi.identification.identify].

    Returns
    -------
    Identifiability
        Standard errors to expect, singular values, and the directions that are not observable.

    Raises
    ------
    ValueError, TypeError
        For arguments that do not go together.
    RuntimeError
        If a step of the integrator does not converge.
    """
    given = {"torque": torque, "rotor_inertia": rotor_inertia, "time_scale": time_scale}
    recordings = simulate_recordings(body, layout, sensors, states, integrator, **given)
    model = model_of(body, recordings, sensors, **given)
    require_noise(model.sensors)
    selected = free_leaves(model, free, ())
    speeds = largest_rates(recordings, float(model.time_scale))
    method, longest_step = method_for(model, recordings, integrator, speeds, TURN_OF_STEP)
    (laid_out,) = lay_out(recordings, [whole(recordings)], longest_step)
    dtype = jax.dtypes.canonicalize_dtype(float)
    states = InitialStates(*(np.asarray(x, dtype) for x in (states.R, states.omega)))
    problem = linearised(model, selected, selected.theta, states, laid_out, method)
    if not np.isfinite(problem.cost):
        raise RuntimeError("A step did not converge: take an `integrator` with a shorter `dt`.")
    known = information(problem.rows, np.zeros(len(selected.theta), bool))
    return Identifiability(**described(model, selected, known)._asdict(), variance=1.0)
