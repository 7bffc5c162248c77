"""The least-squares problem about a point, and the integrator that it is made with."""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..modules.forcing import needs_order_two
from ..modules.integrator import MoserVeselovIntegrator
from .batches import batch_size
from .block_arrow import OWN, Rows
from .factor import Factors, factors
from .model import Free, Model
from .recordings import Recordings
from .residuals import InitialStates
from .samples import SENSED
from .windows import Windows

LEAST_CURVATURE = 0.05  # of a robust loss along a residual, relative to that across it


class Linearised(NamedTuple):
    """The problem about a point."""

    rows: Rows
    cost: float  # infinite where it cannot be computed, or linearised
    gap_cost: float  # the part of it that is of the gaps between segments
    factors: Factors


def linearised(
    model: Model,
    free: Free,
    theta: np.ndarray,
    states: InitialStates,
    windows: Windows,
    integrator: MoserVeselovIntegrator,
    width: np.ndarray | None = None,
    caution: float = 0.0,
) -> Linearised:
    """Residuals and derivatives of all windows, as many at a time as the cache is for.

    Gaps between segments are whitened by a `width` (6,). With a `caution` of 1 robust losses are
    replaced by parabolas above them, with less by such as are nearer to them and may cross them.
    """
    batch = batch_size(windows, OWN + len(theta))
    curvature = jnp.asarray(max(caution, LEAST_CURVATURE), windows.dt.dtype)
    found = factors(model, free, jnp.asarray(theta), states, windows, integrator, batch, curvature)
    cost, gap_cost = float(np.sum(found.cost)), 0.0
    rows = Rows(np.asarray(found.triangle), sizes=np.maximum(1, abs(theta)))
    if found.gap is not None and width is not None:
        gaps = np.asarray(found.gap, float) / width[:, None]
        gap_cost = float(np.sum(gaps[:, :, -1] ** 2))
        rows = rows._replace(gaps=gaps, position=np.asarray(windows.position))
    if rows.finite:
        rows = rows.without(unseen_size(model, free, windows))
    else:
        cost = np.inf
    return Linearised(rows, cost + gap_cost, gap_cost, found)


def unseen_size(model: Model, free: Free, given: Recordings | Windows) -> np.ndarray:
    """The change of the size of the inertia (p,) if nothing acts, as no motion shows it then.

    It is zero where the inertia is not free, or that of a body whose coordinates are not known.
    """
    acting = model.torque, given.body_torque, given.rotor_momentum
    return free.size if all(each is None for each in acting) else np.zeros_like(free.size)


def intervals(recordings: Recordings) -> np.ndarray:
    """The mean time from sample to sample of each trajectory (trajectories,), s."""
    times = [[of[0] for of in map(samples.get, SENSED) if of] for samples in recordings]
    return np.array([np.mean(np.diff(np.unique(np.concatenate(t)))) for t in times])


def method_for(
    model: Model,
    recordings: Recordings,
    integrator: MoserVeselovIntegrator | None,
    speeds: np.ndarray,
    turn: float,
) -> tuple[MoserVeselovIntegrator, np.ndarray]:
    """An integrator that does not raise, and the longest step of each trajectory.

    Those given, or else the order that costs least for an accuracy, and a step of at most `turn`,
    rad, at the angular speed of each trajectory.
    """
    if integrator is not None:
        return replace(integrator, throw=False), np.full(len(recordings), float(integrator.dt))
    order = 6
    if recordings.body_torque is not None or recordings.rotor_momentum is not None:
        order = 2
    elif model.torque is not None:
        order = 2 if needs_order_two(model.torque) else 4
    return MoserVeselovIntegrator(1.0, order=order, throw=False), turn / np.maximum(speeds, 1e-300)
