r"""Long windows linearised in pieces, so that memory does not grow with their length.

The motion is simulated first, without derivatives, for the states at which the pieces begin. Then
the pieces are linearised side by side, each with respect to its own state. So is the end of each,
and the state of the next piece is $\phi_{k+1} = A_k\phi_k + B_k\theta$. Put into one another these
give the rows of all pieces in the unknowns of the window.
"""

from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array

from ...modules.integrator import MoserVeselovIntegrator
from ...modules.sensors.base import time_offset_of
from ..compilation import compiled
from ..model.configuration import ModelAt
from ..model.free import put_leaves
from ..model.model import Model
from ..model.states import InitialStates, Numbers
from ..windows.batching import map_batches
from ..windows.devices import count_devices, on_devices
from ..windows.grid import Windows
from ..windows.group import Group
from ..windows.residuals import simulate_states
from .elimination import triangularise
from .window_qr import WindowFactors, factorise

PIECE = 128  # steps of a piece, at most
FEWEST = 4  # pieces of a window that is cut
SIDE_BY_SIDE = 64  # pieces, as many as the cache is for


def count_pieces(model: Model, group: Group, blocks: int) -> int:
    """Into how many pieces each window is cut, a multiple of the number of blocks; or one.

    Windows of few steps in all are not cut: another program would take longer to compile.
    """
    recorded = bool(group.rows.inputs)
    offset = any(time_offset_of(sensor) is not None for sensor in model.sensors.values())
    # A delayed rotor, and what acts at a sensor's own times, are known in the whole window alone.
    if group.is_small or model.rotor_delay is not None or (recorded and offset):
        return 1
    of_block = -(-group.longest // (blocks * (PIECE - 1)))  # so that no more readings fit in
    return blocks * of_block if of_block > 1 and blocks * of_block >= FEWEST else 1


def factorise_in_pieces(
    at: ModelAt,
    group: Group,
    count: int,
    some: np.ndarray,
    states: InitialStates,
    following: InitialStates,
    joined: np.ndarray | None,
    integrator: MoserVeselovIntegrator,
    least_curvature: np.ndarray,
    blocks: int,
    few: bool,
    mesh: Mesh | None,
) -> WindowFactors:
    """Some windows of a group, each in so many pieces; as `factorise`."""
    dtype, m = states.omega.dtype, states.unknowns
    point = at.model, at.selected, at.leaves.astype(dtype), at.own
    taken = group.cut(some)
    windows, nodes = taken.windows(np.arange(len(some))), taken.nodes_of_pieces(count)
    starts = simulate_starts(*point, states, windows, nodes, integrator, mesh, few=few)
    starts = jax.tree.map(np.asarray, starts)  # (windows, pieces, ...)
    ends = jax.tree.map(
        lambda start, end: np.concatenate([start[:, 1:], end[:, None]], axis=1).astype(dtype),
        starts,
        following,
    )
    continued = np.ones((len(some), count), bool)
    continued[:, -1] = False if joined is None else joined
    starts, ends = (jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), x) for x in (starts, ends))
    pieces = taken.in_pieces(count, PIECE)

    def of_batch(index):
        given = starts.at(index), pieces.windows(index), ends.at(index), continued.ravel()[index]
        factors = factorise(*point, *given, integrator, least_curvature, 1, mesh, few=few)
        return factors.without_readings()

    found = map_batches(of_batch, len(pieces), SIDE_BY_SIDE * count_devices(mesh))
    triangle, gap, cost, spread = (
        x.reshape(len(some), count, *x.shape[1:])
        for x in (found.triangle, found.gap, found.cost, found.spread)
    )
    with np.errstate(over="ignore", invalid="ignore"):  # where a motion gets lost
        starts_of, gap = _chained(gap.astype(float), m)
        rows = triangle[..., :m].astype(float) @ starts_of
        rows[..., m:] += triangle[..., m:-1]
        rows = np.concatenate([rows, triangle[..., -1:]], axis=-1)
        of_blocks = triangularise(rows.reshape(len(some), blocks, -1, rows.shape[-1]))
        of_blocks, gap = of_blocks.astype(dtype), gap.astype(dtype)
        return found._replace(
            triangle=triangularise(of_blocks.reshape(len(some), -1, rows.shape[-1])),
            blocks=of_blocks if blocks > 1 else None,
            cost=np.sum(cost, axis=1),
            spread=np.sum(spread, axis=1),
            gap=None if joined is None else gap,
        )


@compiled("states between pieces")
def simulate_starts(
    model: Model,
    selected: Any,
    leaves: Numbers,
    own: Any,
    states: InitialStates,
    windows: Windows,
    nodes: Array | np.ndarray,
    integrator: MoserVeselovIntegrator,
    mesh: Mesh | None,
) -> InitialStates:
    """States (windows, pieces, ...) at nodes (windows, pieces) of the grids of windows."""

    def of_window(state, window, nodes):
        at = put_leaves(model, selected, leaves)
        return simulate_states(at, own, state, window, nodes, integrator)

    return on_devices(jax.vmap(of_window), (0, 0, 0), mesh)(states, windows, nodes)


def _chained(gaps: np.ndarray, m: int) -> tuple[np.ndarray, np.ndarray]:
    """The states of pieces (windows, pieces, m, m+p) in the unknowns of the window, and its gap.

    `gaps` (windows, pieces, m, 2m+p+1) are those of all pieces; the last is that of the window.
    """
    following, of_piece = gaps[:, :-1, :, :m], gaps[:, :-1, :, m:-1]
    step = -np.linalg.solve(following, of_piece)
    states = np.zeros((*gaps.shape[:3], of_piece.shape[-1]))
    states[:, 0, :, :m] = np.eye(m)
    for k in range(step.shape[1]):
        states[:, k + 1] = step[:, k, :, :m] @ states[:, k]
        states[:, k + 1, :, m:] += step[:, k, :, m:]
    last = gaps[:, -1]
    common = last[:, :, m : 2 * m] @ states[:, -1]
    common[:, :, m:] += last[:, :, 2 * m : -1]
    return states, np.concatenate([last[:, :, :m], common, last[:, :, -1:]], axis=2)
