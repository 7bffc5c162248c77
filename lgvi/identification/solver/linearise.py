"""The least-squares problem about a point."""

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jax.sharding import Mesh
from scipy.linalg import block_diag

from ...modules.integrator import MoserVeselovIntegrator
from ..data.formats import INPUTS
from ..model.configuration import ModelAt
from ..model.free_leaves import ravel, scaling_of
from ..model.model import Model
from ..model.states import InitialStates
from ..running.processes import SINGLE_PROCESS, ProcessGroup
from ..segments.chain import LEAST_CURVATURE, Directions, gaps, linearise
from ..segments.segment import Chains
from .elimination import BlockArrow

ROUNDING_OF_PRIOR = 1e-4  # part of a derivative of a prior that may be rounding


class LinearisedPart(NamedTuple):
    """The problem of one configuration."""

    system: BlockArrow
    factors: "WindowFactors"  # of all windows in their order, without residuals and predictions
    layout: Chains
    number: int  # of scalar residuals


class Linearised(NamedTuple):
    """The problem of all configurations about a point.

    Costs of windows and parts are those of this process; sums are of all processes.
    """

    system: BlockArrow
    cost: float  # infinite where the residuals or their derivatives are not finite
    gap_cost: float  # the part of the cost from the gaps between segments
    costs: np.ndarray  # of all windows, one configuration after another
    number: int  # of scalar residuals
    loss_sums: np.ndarray  # (3,), sums from which `variance_factor` follows
    parts: list[LinearisedPart]

    @property
    def prior_cost(self) -> float:
        """The part of the cost from a prior."""
        return float(np.sum(self.system.of_prior()[:, -1] ** 2))

    @property
    def blocks(self) -> np.ndarray | None:
        """Blocks of time (windows, blocks, rows, 7+p) of which the windows are made."""
        found = [part.factors.blocks for part in self.parts]
        return None if any(each is None for each in found) else _stacked(found)


def linearise_part(
    at: ModelAt,
    states: InitialStates,
    layout: Chains,
    integrator: MoserVeselovIntegrator,
    gap_sigma: np.ndarray | None = None,
    robust_damping: float = 0.0,
    blocks: int = 1,
    mesh: Mesh | None = None,
    more: Directions | None = None,
) -> LinearisedPart:
    """Residuals and derivatives of all windows, behind the free leaves in `more` directions.

    Gaps between segments are whitened by a `width` of each unknown. With a `caution` of 1 a robust
    loss is replaced by a parabola that lies above it; with less by a parabola that is nearer to the
    loss and may cross it. Each window is made of so many `blocks` of time. Each device of a mesh
    has a part of the windows.
    """
    m, curvature = states.unknowns, max(robust_damping, LEAST_CURVATURE)
    windows = linearise(at, states, layout, integrator, curvature, blocks, mesh, more)
    others = 0 if more is None else more.leaves.shape[1]
    gap = None
    if layout.joined.any():
        following = states.at(np.roll(np.arange(layout.number), -1))
        gap = gaps(windows, following, layout.joined)
    found = WindowFactors(windows.triangles, windows.blocks, windows.cost, windows.loss_sums, gap)
    sizes = np.maximum(1, np.pad(abs(at.leaves), (0, others)))
    system = BlockArrow(found.triangle, sizes=sizes, unknowns=m)
    if gap is not None and gap_sigma is not None:
        system = system._replace(gaps=gap / gap_sigma[:, None], position=layout.position)
    if system.finite:
        recorded = layout.recordings.quantities
        direction = unobservable_scale_direction(at.model, at.selected, recorded)
        system = system.without(np.pad(direction, (0, others)))
    if at.jacobian is not None:
        jacobian = np.asarray(block_diag(at.jacobian, np.eye(others)))
        system, found = _in_free_leaves(system, found, jacobian)
    number = _count_residuals(at.model, layout)
    return LinearisedPart(system, found, layout, number)


class WindowFactors(NamedTuple):
    """The least-squares problem of each window."""

    triangle: np.ndarray  # (windows, 1+m+p, 1+m+p), of m own unknowns
    blocks: np.ndarray | None  # (windows, blocks, rows, 1+m+p), what the triangle is made of
    cost: np.ndarray  # (windows,), sum of the losses; infinite if a step did not converge
    loss_sums: np.ndarray  # (windows, 3), sums from which `variance_factor` follows
    gap: np.ndarray | None  # (windows, m, 1+2m+p), as in `BlockArrow`, but not whitened


def _count_residuals(model: Model, layout: Chains) -> int:
    """Number of scalar residuals of all readings."""
    return sum(
        len(sensor.axes) * int(np.sum(layout.count_readings(channel)))
        for channel, sensor in model.sensors.items()
    )


def _in_free_leaves(
    system: BlockArrow, factors: WindowFactors, jacobian: np.ndarray
) -> tuple[BlockArrow, WindowFactors]:
    """Rows in a model's leaves as rows in the free leaves, of which these are functions."""
    m = system.unknowns
    triangles = chained(system.triangles, m, jacobian)
    gaps = None if system.gaps is None else chained(system.gaps, 2 * m, jacobian)
    blocks = None if factors.blocks is None else chained(factors.blocks, m, jacobian)
    found = BlockArrow(triangles, gaps, system.position, unknowns=m)
    return found, factors._replace(triangle=triangles, blocks=blocks)


def chained(rows: Any, first: int, jacobian: np.ndarray) -> np.ndarray:
    """Rows (..., first+q+1) with a Jacobian (q, p), or (..., q, p), behind (..., first+p+1)."""
    rows = np.asarray(rows)
    common = (rows[..., first:-1].astype(float) @ jacobian).astype(rows.dtype)
    return np.concatenate([rows[..., :first], common, rows[..., -1:]], axis=-1)


def join_parts(
    parts: list[LinearisedPart],
    theta: np.ndarray,
    prior: np.ndarray,
    processes: ProcessGroup = SINGLE_PROCESS,
) -> Linearised:
    """The problem of all configurations and processes, with the rows of a prior (rows, p+1)."""
    costs = np.concatenate([np.asarray(part.factors.cost, float) for part in parts])
    cost, gap_cost, systems = float(np.sum(costs)), 0.0, [part.system for part in parts]
    if not all(system.finite for system in systems) or not np.all(np.isfinite(prior)):
        cost = np.inf
    system = systems[0]._replace(sizes=np.maximum(1, abs(theta)), processes=processes)
    if len(parts) > 1:
        system = system._replace(triangles=_stacked([each.triangles for each in systems]))
        if any(each.gaps is not None for each in systems):
            shape = system.unknowns, system.triangles.shape[2] + system.unknowns
            gaps = [
                np.zeros((len(each.triangles), *shape)) if each.gaps is None else each.gaps
                for each in systems
            ]
            position = np.concatenate([each.positions for each in systems])
            gaps = np.concatenate(gaps)
            system = system._replace(gaps=gaps, position=position)
    if system.gaps is not None:
        gap_cost = float(np.sum(system.gaps[:, :, -1] ** 2))
    numbers = float(sum(part.number for part in parts))
    loss_sums = np.concatenate([np.asarray(part.factors.loss_sums, float) for part in parts])
    sums = [cost, gap_cost, numbers, *np.sum(loss_sums, axis=0)]
    cost, gap_cost, number, *loss_sums = processes.sum(sums).tolist()
    if len(prior):
        system = system._replace(prior=prior)
        along = np.broadcast_to(system.unobservable, theta.shape)
        size = abs(prior[:, :-1]) @ abs(along)
        if np.any(abs(prior[:, :-1] @ along) > ROUNDING_OF_PRIOR * size):
            system = system._replace(unobservable=0.0)
        cost += float(np.sum(prior[:, -1] ** 2))
    cost += gap_cost
    return Linearised(system, cost, gap_cost, costs, int(number), np.array(loss_sums), parts)


def _stacked(tables: Sequence[Any]) -> np.ndarray:
    """Tables (n, ..., rows, columns) one after another, with rows of zeros where some have less."""
    most = max(each.shape[-2] for each in tables)
    padded = [
        np.pad(each, [*[(0, 0)] * (each.ndim - 2), (0, most - each.shape[-2]), (0, 0)])
        for each in tables
    ]
    return np.concatenate(padded)


def unobservable_scale_direction(
    model: Model, selected: Any, recorded: Collection[str]
) -> np.ndarray:
    """The direction of the selected leaves that scales the inertia, if nothing else acts; or zero.

    Without torques and rotors, of which no quantity is `recorded`, no motion depends on the scale.
    Zero also where the inertia is not selected, or the body is of a class whose coordinates are
    not known.
    """
    direction = ravel(eqx.filter(scaling_of(model), selected))
    return direction * (model.torque is None and not any(name in recorded for name in INPUTS))
