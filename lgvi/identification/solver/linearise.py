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
    chains: Chains
    number: int  # of scalar residuals
    costs: np.ndarray  # (windows,), sums of the losses; infinite if a step did not converge
    loss_sums: np.ndarray  # (windows, 3), sums from which `variance_factor` follows
    blocks: np.ndarray | None  # (windows, blocks, rows, 1+m+p), what the triangles are made of
    gaps: np.ndarray | None  # (windows, m), from the end of a window to the next one, or zero


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
    def residual_cost(self) -> float:
        """The part of the cost from the residuals, without those of a prior and of gaps."""
        return self.cost - self.prior_cost - self.gap_cost

    @property
    def blocks(self) -> np.ndarray | None:
        """Blocks of time (windows, blocks, rows, 7+p) of which the windows are made."""
        blocks = [part.blocks for part in self.parts if part.blocks is not None]
        return _stacked(blocks) if len(blocks) == len(self.parts) else None


def linearise_part(
    at: ModelAt,
    states: InitialStates,
    chains: Chains,
    integrator: MoserVeselovIntegrator,
    gap_sigma: np.ndarray | None = None,
    robust_damping: float = 0.0,
    blocks: int = 1,
    mesh: Mesh | None = None,
    more: Directions | None = None,
) -> LinearisedPart:
    """Residuals and derivatives of all windows, behind the free leaves in `more` directions.

    Gaps between windows have a standard deviation `gap_sigma` (m,). With a `robust_damping` of 1 a
    robust loss is replaced by a parabola that lies above the loss; with less by a parabola that is
    nearer to the loss and may cross it. Each window is made of `blocks` blocks of time. Each device
    of a mesh has a part of the windows.
    """
    m, curvature = states.unknowns, max(robust_damping, LEAST_CURVATURE)
    windows = linearise(at, states, chains, integrator, curvature, blocks, mesh, more)
    others = 0 if more is None else more.leaves.shape[1]
    rows_of_gaps = None
    if chains.joined.any():
        following = states.at(np.roll(np.arange(chains.number), -1))
        rows_of_gaps = gaps(windows, following, chains.joined)
    sizes = np.maximum(1, np.pad(abs(at.leaves), (0, others)))
    system = BlockArrow(windows.triangles, sizes=sizes, unknowns=m)
    if rows_of_gaps is not None and gap_sigma is not None:
        whitened = rows_of_gaps / gap_sigma[:, None]
        system = system._replace(gaps=whitened, position=chains.position)
    if system.finite:
        recorded = chains.recordings.quantities
        direction = unobservable_scale_direction(at.model, at.selected, recorded)
        system = system.without(np.pad(direction, (0, others)))
    of_blocks = windows.blocks
    if at.jacobian is not None:  # the model's leaves are functions of the free leaves
        jacobian = np.asarray(block_diag(at.jacobian, np.eye(others)))
        system = BlockArrow(
            chained(system.triangles, m, jacobian),
            None if system.gaps is None else chained(system.gaps, 2 * m, jacobian),
            system.position,
            unknowns=m,
        )
        of_blocks = None if of_blocks is None else chained(of_blocks, m, jacobian)
    return LinearisedPart(
        system,
        chains,
        _count_residuals(at.model, chains),
        np.asarray(windows.cost, float),
        np.asarray(windows.loss_sums, float),
        of_blocks,
        None if rows_of_gaps is None else rows_of_gaps[:, :, -1],
    )


def _count_residuals(model: Model, chains: Chains) -> int:
    """Number of scalar residuals of all readings."""
    return sum(
        len(sensor.axes) * int(np.sum(chains.count_readings(channel)))
        for channel, sensor in model.sensors.items()
    )


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
    costs = np.concatenate([part.costs for part in parts])
    cost, gap_cost, systems = float(np.sum(costs)), 0.0, [part.system for part in parts]
    if not all(system.finite for system in systems) or not np.all(np.isfinite(prior)):
        cost = np.inf
    system = systems[0]._replace(sizes=np.maximum(1, abs(theta)), processes=processes)
    if len(parts) > 1:
        system = system._replace(triangles=_stacked([part.system.triangles for part in parts]))
        if any(part.system.gaps is not None for part in parts):
            shape = system.unknowns, system.triangles.shape[2] + system.unknowns
            gaps = [
                np.zeros((len(each.triangles), *shape)) if each.gaps is None else each.gaps
                for each in systems
            ]
            position = np.concatenate([part.system.positions for part in parts])
            gaps = np.concatenate(gaps)
            system = system._replace(gaps=gaps, position=position)
    if system.gaps is not None:
        gap_cost = float(np.sum(system.gaps[:, :, -1] ** 2))
    numbers = float(sum(part.number for part in parts))
    loss_sums = np.concatenate([part.loss_sums for part in parts])
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
    most = max(table.shape[-2] for table in tables)
    padded = [
        np.pad(table, [*[(0, 0)] * (table.ndim - 2), (0, most - table.shape[-2]), (0, 0)])
        for table in tables
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
