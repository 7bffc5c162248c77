"""The order and the longest step with which recordings are simulated."""

from collections.abc import Mapping
from dataclasses import replace

import jax
import numpy as np

from ...modules.integrator import MoserVeselovIntegrator
from ...modules.torques.base import as_law
from ..data.formats import INPUTS
from ..data.recordings import Recordings
from ..model.model import Model

SEEN_TURN = 1.0  # rad, of a nutation between readings, at most, which they can show


def choose_method(
    model: Model,
    recordings: Recordings,
    integrator: MoserVeselovIntegrator | None,
    speeds: np.ndarray,
    turn: float | Mapping[int, float],
) -> tuple[MoserVeselovIntegrator, np.ndarray]:
    """An integrator that does not raise, and the longest step of each trajectory.

    By default the order is the cheapest for an accuracy, and a step turns by at most `turn`, rad,
    for all orders or by order, at the angular speed of each trajectory and that of its nutation by
    rotors together.
    """
    if integrator is not None:
        return replace(integrator, throw=False), np.full(len(recordings), float(integrator.dt))
    order = 6
    if any(name in recordings.quantities for name in INPUTS):
        order = 2
    elif model.torque is not None:
        law = as_law("torque", model.torque)
        order = 2 if law.depends_on_rate else min(4, law.highest_order)
    by_rotors = rates_by_rotors(model, recordings)
    if np.any(by_rotors > 0):  # The inertia may be a guess, and much too small.
        speeds = speeds + np.fmin(by_rotors, SEEN_TURN / mean_intervals(recordings))
    turn = turn[order] if isinstance(turn, Mapping) else turn
    return MoserVeselovIntegrator(1.0, order=order, throw=False), turn / np.maximum(speeds, 1e-300)


def rates_by_rotors(model: Model, recordings: Recordings) -> np.ndarray:
    """About the fastest nutation that rotors cause (trajectories,), rad in a recorded second."""
    momenta = np.zeros(len(recordings))
    if (recorded := recordings.rotor_momentum) is not None:
        size = float(np.linalg.norm(np.asarray(model.rotor_inertia, float)))
        momenta += [size * _largest(values) for _, values in recorded]
    if (recorded := recordings.rotor_speed) is not None and (rotors := model.rotors) is not None:
        of_each = np.asarray(jax.vmap(rotors.momentum)(np.eye(len(rotors.arms))), float)
        momenta += [_largest(speeds @ of_each) for _, speeds in recorded]
    smallest = np.linalg.eigvalsh(np.asarray(model.body.inertia, float))[0]
    return momenta / smallest * float(model.time_scale)


def _largest(vectors: np.ndarray) -> float:
    return np.max(np.linalg.norm(vectors, axis=1))


def mean_intervals(recordings: Recordings) -> np.ndarray:
    """The mean time from sample to sample of each trajectory (trajectories,), s."""
    return np.array([np.mean(np.diff(recordings.times_of(each))) for each in recordings])
