"""The order and the longest step with which recordings are simulated."""

from dataclasses import replace

import numpy as np

from ...modules.integrator import MoserVeselovIntegrator
from ...modules.torques.base import as_law
from ..data.formats import INPUTS
from ..data.recordings import Recordings
from ..model.model import Model


def choose_method(
    model: Model,
    recordings: Recordings,
    integrator: MoserVeselovIntegrator | None,
    speeds: np.ndarray,
    turn: float,
) -> tuple[MoserVeselovIntegrator, np.ndarray]:
    """An integrator that does not raise, and the longest step of each trajectory.

    By default the order is the cheapest for an accuracy, and a step turns by at most `turn`, rad,
    at the angular speed of each trajectory.
    """
    if integrator is not None:
        return replace(integrator, throw=False), np.full(len(recordings), float(integrator.dt))
    order = 6
    if any(name in recordings.quantities for name in INPUTS):
        order = 2
    elif model.torque is not None:
        law = as_law("torque", model.torque)
        order = 2 if law.depends_on_rate else min(4, law.highest_order)
    return MoserVeselovIntegrator(1.0, order=order, throw=False), turn / np.maximum(speeds, 1e-300)


def mean_intervals(recordings: Recordings) -> np.ndarray:
    """The mean time from sample to sample of each trajectory (trajectories,), s."""
    return np.array([np.mean(np.diff(recordings.times_of(each))) for each in recordings])
