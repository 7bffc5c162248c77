"""The order and the longest step with which recordings are simulated."""

from dataclasses import replace

import numpy as np

from ...modules.integrator import MoserVeselovIntegrator
from ...modules.torques.base import as_law
from ..arguments import scalar_step
from ..data.formats import INPUTS
from ..data.recordings import Recordings
from ..model.model import Model


def choose_method(
    model: Model, recordings: Recordings, integrator: MoserVeselovIntegrator | None
) -> MoserVeselovIntegrator:
    """An integrator that does not raise, by default of the order that is cheapest for an accuracy.

    Its step is not used: see `first_steps`.
    """
    if integrator is not None:
        return replace(integrator, throw=False)
    order = 6
    if any(name in recordings.quantities for name in INPUTS):
        order = 2
    elif model.torque is not None:
        law = as_law("torque", model.torque)
        order = 2 if law.depends_on_rate else min(4, law.highest_order)
    return MoserVeselovIntegrator(1.0, order=order, throw=False)


def first_steps(
    integrator: MoserVeselovIntegrator | None, speeds: np.ndarray, turn: float
) -> np.ndarray:
    """The longest step of each trajectory (trajectories,), s.

    By default the body turns by at most `turn`, rad, at the angular speed of the trajectory.
    """
    if integrator is not None:
        return np.full(len(speeds), scalar_step(integrator))
    return turn / np.maximum(speeds, 1e-300)


def mean_intervals(recordings: Recordings) -> np.ndarray:
    """The mean time from sample to sample of each trajectory (trajectories,), s."""
    return np.array([np.mean(np.diff(recordings.times_of(each))) for each in recordings])
