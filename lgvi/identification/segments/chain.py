r"""Segments chained to windows: derivatives of residuals by initial states and leaves.

Along a segment the small change of the state $x_k$ follows $x_{k+1} = A_k x_k + B_k$, with a column
for each unknown; the local derivatives are those of `programs`. What is left of the rows of a
segment is their triangle, and of a chain of segments that of its window.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh
from scipy.spatial.transform import Rotation

from ...modules.integrator import MoserVeselovIntegrator
from ..model.configuration import ModelAt
from ..model.free import ravel
from ..model.model import Model
from ..model.states import InitialStates, state_leaves
from .programs import SIX, Advanced, Changes, Local, Programs, Segment
from .segment import Chains, Table

SMALL_TURN = 1e-3  # rad, for which a series replaces a quotient
LEAST_CURVATURE = 0.05  # of a robust loss along a residual, over the curvature across it


class Places(NamedTuple):
    """Where the numbers of a model's parts are in the vector of all its floating-point leaves."""

    number: int
    index: Any  # the model, with the place of each number
    states: np.ndarray  # places of leaves that are a state

    @classmethod
    def of_model(cls, model: Model) -> "Places":
        """The places of the numbers of a model."""
        leaves, structure = jax.tree.flatten(eqx.filter(model, eqx.is_inexact_array))
        ends = np.cumsum([leaf.size for leaf in leaves])
        index = [
            np.arange(end - leaf.size, end).reshape(leaf.shape)
            for end, leaf in zip(ends, leaves, strict=True)
        ]
        index, states = jax.tree.unflatten(structure, index), state_leaves(model)
        none = np.zeros(0, int)
        found = cls(int(ends[-1]), index, none)
        return found if states is None else found._replace(states=found.of(states))

    def of(self, selected: Any) -> np.ndarray:
        """The places of the leaves that are selected in a model of True and False."""
        return ravel(eqx.filter(self.index, selected)).astype(int)

    def part(self, name: str) -> np.ndarray:
        """The places of a part of the model, such as its body."""
        return ravel(getattr(self.index, name)).astype(int)

    def sensor(self, channel: str) -> np.ndarray:
        """The places of a sensor."""
        return ravel(self.index.sensors[channel]).astype(int)

    @property
    def rotor_delay(self) -> np.ndarray:
        """The place of the delay of rotors, if there is one."""
        return self.part("rotor_delay")

    @property
    def time_offsets(self) -> dict[str, np.ndarray]:
        """The place of the time offset of each sensor, if it has one."""
        sensors = self.index.sensors.items()
        return {k: ravel(getattr(each, "time_offset", None)).astype(int) for k, each in sensors}


class Rows(NamedTuple):
    """Derivatives along segments (segments, ...), with a column for each direction."""

    residuals: dict[str, np.ndarray]  # (nodes, axes, columns), by channel
    end: np.ndarray  # (6 + states, columns), of the turn, omega and leaves that are a state


def times_six(v: np.ndarray) -> np.ndarray:
    """The matrix (..., 3, 6) of the six numbers of a symmetric matrix in its product with `v`."""
    found = np.zeros((*v.shape[:-1], 3, 6))
    for k, (i, j) in enumerate(zip(*SIX, strict=True)):
        found[..., i, k] = v[..., j]
        found[..., j, k] = v[..., i]
    return found


class Given(NamedTuple):
    """Changes of what goes into segments (segments, ..., columns), one column for each direction.

    Of leaves that are not the body's, `leaves` has them as they are.
    """

    inertia: np.ndarray  # (6, columns), of xx, yy, zz, xy, xz, yz
    scale: np.ndarray  # (1, columns), relative, of all times
    acting: np.ndarray | None  # (nodes, 9, columns), of rho, tau and the rate of rho
    leaves: np.ndarray  # (leaves, columns), for all segments

    def part(self, name: str) -> np.ndarray | None:
        """Changes of what acts at the nodes."""
        of = {"rho": slice(0, 3), "tau": slice(3, 6), "rho_rate": slice(6, 9)}[name]
        return None if self.acting is None else self.acting[:, :, of]


def derive(
    local: Local,
    segments: Segment,
    leaves: np.ndarray,
    places: Places,
    directions: np.ndarray,
    parts: tuple[np.ndarray, np.ndarray],
) -> Rows:
    """Derivatives with respect to the turn and the rate at the start, and along `directions`.

    Parameters
    ----------
    local, segments
        Local derivatives of segments.
    leaves
        All floating-point leaves of the model (segments, leaves).
    places
        Where they are.
    directions
        The changes of all leaves (leaves, columns). The first six columns belong to the state and
        are zero.
    parts
        The parts of a step at which its stages begin and end.
    """
    given = _given(local, segments, leaves, places, directions)
    states = _states(local, given, places, parts)
    turn, momentum = states[:, :, :3], states[:, :, 3:]
    change = momentum - times_six(local.omega) @ given.inertia[:, None]
    if given.acting is not None:
        change -= given.acting[:, :, :3]
    omega = np.linalg.inv(local.J.astype(float))[:, None] @ change
    times = np.stack([local.t, local.t - local.t[:, :1]], axis=-1)[..., None]
    times = times * given.scale[:, None]
    alpha, shape = None, (*local.t.shape, 3, directions.shape[1])
    if local.acceleration is not None:
        names = {name: given.part(name) for name in ("rho", "tau", "rho_rate")}
        of_law = directions[places.part("torque")]
        rest = {"inertia": given.inertia[:, None], "t": times[:, :, :1], "law": of_law}
        alpha = _sum(
            local.acceleration, {"turn": turn, "momentum": momentum, **rest, **names}, shape
        )
    residuals, offsets = {}, places.time_offsets
    for channel, changes in local.readings.items():
        of_sensor, offset = places.sensor(channel), offsets[channel]
        axes = *segments.mask[channel].shape, _axes(changes)
        of = {"turn": turn, "omega": omega, "alpha": alpha, "times": times}
        rows = _sum(changes, of | {"leaves": directions[of_sensor]}, (*axes, directions.shape[1]))
        if len(offset) and directions[[*offset, *places.part("time_scale")]].any():
            # The sensor reads the motion later. A clock that is slower does not delay it more.
            later = directions[offset] - leaves[:, offset, None] * given.scale
            rows += _sum(changes, _flow(local), (*axes, 1)) * later[:, None]
        residuals[channel] = rows
    end = np.concatenate([turn[:, -1], omega[:, -1]], axis=1)
    if local.own is not None:
        of = {
            name: directions[places.part(name)] for name in ("rotor_inertia", "rotors", "sensors")
        }
        own = len(places.states), directions.shape[1]
        own = _sum(local.own, of | {"scale": given.scale}, (len(end), *own))
        end = np.concatenate([end, own], axis=1)
    return Rows(residuals, end)


def _axes(changes: Changes) -> int:
    """Number of axes of the residual of a sensor."""
    return next(iter(changes.values())).shape[2]


def _flow(local: Local) -> dict[str, np.ndarray]:
    """What changes with time at the nodes (segments, nodes, ..., 1)."""
    return {
        "turn": local.omega[..., None],
        "omega": local.alpha[..., None],
        "alpha": _slope(local.alpha, local.t)[..., None],
        "times": np.ones((*local.t.shape, 2, 1)),
    }


def _given(
    local: Local, segments: Segment, leaves: np.ndarray, places: Places, directions: np.ndarray
) -> Given:
    body, clock = directions[places.part("body")], directions[places.part("time_scale")]
    inertia = local.of_leaves.astype(float) @ body
    scale = clock / leaves[:, places.part("time_scale"), None].astype(float)
    acting = None
    if local.acting is not None:
        of = {name: directions[places.part(name)] for name in ("rotor_inertia", "rotors")}
        acting = (*local.t.shape, 9, directions.shape[1])
        acting = _sum(local.acting, of | {"scale": scale[:, None]}, acting)
        delay = directions[places.rotor_delay]
        if delay.any():  # rotors have later what is recorded: less by the slope
            factor = leaves[:, None, places.part("rotor_inertia")]
            acting[:, :, :3] -= (factor * segments.rates["rotor_momentum"])[..., None] * delay
    return Given(inertia, scale, acting, directions)


def _states(
    local: Local, given: Given, places: Places, parts: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Changes of turn and momentum at the nodes (segments, nodes, 6, columns)."""
    (number, drifts), nodes = local.turn.shape[:2], local.t.shape[1]
    columns, stages = given.inertia.shape[2], drifts // (nodes - 1)
    x = np.zeros((number, 6, columns))
    x[:, range(3), range(3)] = 1
    x[:, 3:, 3:6] = local.J
    x[:, 3:] += times_six(local.omega[:, 0]) @ given.inertia
    if given.acting is not None:
        x[:, 3:] += given.acting[:, 0, :3]
    # (segments, drifts, 3, columns), of the turn of each drift
    source = local.by_inertia @ given.inertia[:, None]
    if given.scale.any():
        source += local.by_scale[..., None] * given.scale[:, None]
    if given.acting is not None:
        rho = given.acting[:, :, :3]
        middle = (rho[:, :-1] + rho[:, 1:]) / 2
        source += local.by_rotors @ np.repeat(middle, stages, axis=1)
    if local.by_start is not None:
        source += local.by_start @ x[:, None, 3:]
    cross = _hat(local.momentum)
    A = np.zeros((number, drifts, 6, 6))
    A[..., :3, :3] = A[..., 3:, 3:] = local.turn
    A[..., :3, 3:] = local.by_momentum
    A[..., 3:, 3:] += cross @ local.by_momentum
    B = np.concatenate([source, cross @ source], axis=2)
    kicks = [
        None if changes is None else _kick(changes, local, given, places, part)
        for changes, part in zip((local.before, local.after), parts, strict=True)
    ]
    states = np.empty((number, nodes, 6, columns))
    states[:, 0] = x
    for k in range(drifts):
        for kick, is_before in zip(kicks, (True, False), strict=True):
            if not is_before:
                x = A[:, k] @ x + B[:, k]
            if kick is not None:
                matrix, of_kick = kick
                x[:, 3:] += matrix[:, k] @ x + of_kick[:, k]
        if (k + 1) % stages == 0:
            states[:, (k + 1) // stages] = x
    return states


def _kick(
    changes: Changes, local: Local, given: Given, places: Places, parts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Changes of momentum by kicks (segments, drifts, 3, ...), by the state and along columns."""
    (number, drifts), columns = local.turn.shape[:2], given.inertia.shape[2]
    matrix = np.zeros((number, drifts, 3, 6))
    for name, part in (("turn", slice(0, 3)), ("momentum", slice(3, 6))):
        if name in changes:
            matrix[..., part] = changes[name]

    def at(values: np.ndarray | None, parts: np.ndarray) -> np.ndarray | None:
        if values is None:
            return None
        parts = parts.reshape(1, 1, -1, *[1] * (values.ndim - 2))
        between = values[:, :-1, None] + parts * np.diff(values, axis=1)[:, :, None]
        return between.reshape(number, drifts, *values.shape[2:])

    scale = given.scale[:, None]
    of = {
        "inertia": given.inertia[:, None],
        "rho": at(given.part("rho"), np.full(len(parts), 0.5)),
        "tau": at(given.part("tau"), parts),
        "scale": scale,
        "t": at(local.t[..., None, None], parts) * scale,
        "law": given.leaves[places.part("torque")],
    }
    return matrix, _sum(changes, of, (number, drifts, 3, columns))


def _sum(changes: Changes, of: Mapping[str, Any], shape: tuple[int, ...]) -> np.ndarray:
    """The sum of local derivatives times what changes, of what is known to change."""
    total = np.zeros(shape)
    for name, matrix in changes.items():
        if (change := of.get(name)) is not None:
            total += matrix @ change
    return total


def _hat(v: np.ndarray) -> np.ndarray:
    """Matrices (..., 3, 3) of the cross product with vectors."""
    found = np.zeros((*v.shape, 3))
    found[..., 2, 1] = v[..., 0]
    found[..., 0, 2] = v[..., 1]
    found[..., 1, 0] = v[..., 2]
    return found - np.swapaxes(found, -1, -2)


def _slope(values: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Slopes (segments, nodes, 3) of lines from the node before to the node after."""
    index = np.arange(t.shape[1])
    after, before = np.minimum(index + 1, index[-1]), np.maximum(index - 1, 0)
    run = (t[:, after] - t[:, before])[..., None]
    return (values[:, after] - values[:, before]) / np.where(run != 0, run, 1)


class Windows(NamedTuple):
    """What is left of the rows of windows (windows, ...), and their ends."""

    triangles: np.ndarray  # (1+m+p, 1+m+p), of m own unknowns
    blocks: np.ndarray | None  # (blocks, 1+m+p, 1+m+p), what the triangle is made of
    cost: np.ndarray  # sum of the losses; infinite if a drift was not solved
    spread: np.ndarray  # (3,), sums from which `variance_factor` follows
    end: InitialStates
    of_end: np.ndarray  # (m, m+p), its derivative
    readings: dict[str, np.ndarray]  # (readings, ...), of all windows, by channel


class Started(NamedTuple):
    """Windows as segments, with the states at which these begin (segments, ...)."""

    programs: Programs
    table: Table
    window: np.ndarray  # number of the window of each segment
    leaves: np.ndarray  # (segments, leaves), of the model
    R: np.ndarray
    omega: np.ndarray


def begin(
    at: ModelAt,
    places: Places,
    states: InitialStates,
    chains: Chains,
    numbers: np.ndarray,
    method: MoserVeselovIntegrator,
    mesh: Mesh | None,
) -> Started:
    """The segments of some windows, simulated one after another from states (windows, ...)."""
    leaves = np.tile(ravel(eqx.filter(at.model, eqx.is_inexact_array)), (len(numbers), 1))
    leaves[:, places.of(at.selected)] = at.leaves
    if at.own is not None and states.own is not None:
        own = places.of(at.own)
        leaves[:, own] = states.own[:, : len(own)]
    scale = leaves[:, places.part("time_scale")[0]]  # offsets are true seconds
    late = np.zeros((len(numbers), 1 + len(chains.channels)))
    offsets = places.time_offsets
    for channel, k in chains.clocks.items():
        late[:, k] = leaves[:, offsets[channel][0]] / scale
    delay = leaves[0, places.rotor_delay[0]] if len(places.rotor_delay) else None
    table = chains.table(numbers, late, delay)
    dtype, total = states.omega.dtype, len(table.segments.dt)
    window = np.repeat(np.arange(len(numbers)), table.counts)
    lanes = chains.sizes.few_lanes if chains.few else chains.sizes.lanes
    programs = Programs(at.model, method, chains.few, lanes, mesh)
    leaves = leaves[window].astype(dtype)
    R, omega = np.empty((total, 3, 3), dtype), np.empty((total, 3), dtype)
    R[table.first], omega[table.first] = states.R, states.omega
    for k in range(int(table.counts.max()) - 1):
        here = table.first[table.counts > k + 1] + k
        some = jax.tree.map(lambda x, here=here: x[here], table.segments)
        found = programs.advance(leaves[here], R[here], omega[here], some)
        R[here + 1], omega[here + 1] = found.R, found.omega
        leaves[(here + 1)[:, None], places.states] = found.own
    return Started(programs, table, window, leaves, R, omega)


def linearise(
    at: ModelAt,
    states: InitialStates,
    chains: Chains,
    method: MoserVeselovIntegrator,
    least_curvature: float,
    blocks: int,
    keep: str | None,
    mesh: Mesh | None,
) -> Windows:
    """Residuals of windows and their derivatives by their initial states and selected leaves.

    The curvature of a robust loss along a residual is at least `least_curvature` times the
    curvature across the residual. Each window is made of so many `blocks` of time. Of all readings
    the `residuals` or what is `predicted` is kept, if asked for.
    """
    places = Places.of_model(at.model)
    parts = [
        _linearise(
            at, places, states.at(some), chains, some, method, least_curvature, blocks, keep, mesh
        )
        for some in chains.groups()
    ]
    if len(parts) == 1:
        return parts[0]
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _linearise(
    at, places, states, chains, numbers, method, least_curvature, blocks, keep, mesh
) -> Windows:
    began = begin(at, places, states, chains, numbers, method, mesh)
    first, count, steps = began.table[1:]
    window = began.window
    m, p = states.unknowns, len(at.leaves)
    own = np.zeros(0, int) if at.own is None else places.of(at.own)
    directions = np.zeros((places.number, m + p))
    directions[own, 6 + np.arange(len(own))] = 1
    directions[places.of(at.selected), m + np.arange(p)] = 1
    evolving = 6 + np.flatnonzero(np.isin(own, places.states))
    position = np.arange(len(window)) - first[window]
    total, columns, length = len(window), 1 + m + p, chains.sizes.steps
    ends = np.zeros((total, m, m + p))
    ends[:, range(6, m), range(6, m)] = 1
    cost, spread, tables, keys = np.empty(total), np.empty((total, 3)), [], []
    R, omega, states_own = (
        np.empty((total, 3, 3)),
        np.empty((total, 3)),
        np.empty((total, len(places.states))),
    )
    kept: dict[str, list[np.ndarray]] = {channel: [] for channel in at.model.sensors}
    done = 0
    with np.errstate(over="ignore", invalid="ignore"):  # where a motion gets lost
        for segments, advanced, local in began.programs.linearise(*began[3:], began.table.segments):
            here = slice(done, done + len(advanced.cost))
            done = here.stop
            given = local, segments, began.leaves[here], places, directions
            rows = derive(*given, began.programs.parts(segments))
            ends[here, :6] = rows.end[:, :6]
            ends[here, evolving] = rows.end[:, 6:]
            cost[here], R[here], omega[here] = advanced.cost, advanced.R, advanced.omega
            states_own[here] = advanced.own
            table, spread[here] = _weigh(at.model, segments, advanced, rows, least_curvature)
            node = length * position[here, None] + np.arange(length + 1)
            block = node * blocks // (steps[window[here]] + 1)[:, None]
            block = np.minimum(block, blocks - 1)
            for channel in kept if keep else ():
                kept[channel].append(getattr(advanced, keep)[channel][segments.mask[channel]])
            least = block[:, 0]
            for k in range(int(np.max(block[:, -1] - least)) + 1):
                chosen = np.flatnonzero(least + k <= block[:, -1])
                inside = (block[chosen] == least[chosen, None] + k)[:, :, None, None]
                some = (table[chosen] * inside).reshape(len(chosen), -1, columns)
                tables.append(_triangles(some))
                keys.append(np.stack([done - len(advanced.cost) + chosen, least[chosen] + k]))
        segment, block = np.concatenate(keys, axis=1)
        table = np.concatenate(tables)
        of_starts, of_end = _chain(ends, first, count)
        common = table[:, :, :m] @ of_starts[segment]
        common[:, :, m:] += table[:, :, m:-1]
        table = np.concatenate([common, table[:, :, -1:]], axis=2)
        order = np.lexsort((segment, block, window[segment]))
        table, key = _merge(table[order], (window[segment] * blocks + block)[order])
        of_blocks = None
        if blocks > 1:
            of_blocks = np.zeros((len(numbers) * blocks, columns, columns))
            of_blocks[key] = table
            of_blocks = of_blocks.reshape(len(numbers), blocks, columns, columns)
        triangles, _ = _merge(table, key // blocks)
    last = first + count - 1
    return Windows(
        triangles,
        of_blocks,
        np.add.reduceat(cost, first),
        np.add.reduceat(spread, first),
        _end(states, R[last], omega[last], evolving - 6, states_own[last]),
        of_end,
        {channel: np.concatenate(each) for channel, each in kept.items()} if keep else {},
    )


def gaps(found: Windows, following: InitialStates, joined: np.ndarray) -> np.ndarray:
    """The rows of gaps between windows and the next ones (windows, m, 2m+p+1), as in `BlockArrow`.

    Zero where a window is not joined to the next one, which begins with the `following` state.
    """
    m = found.of_end.shape[1]
    between = np.swapaxes(found.end.R, 1, 2).astype(float) @ following.R
    turn = Rotation.from_matrix(between).as_rotvec()
    rows = np.zeros((len(turn), m, m + found.of_end.shape[2] + 1))
    rows[:, :, :m] = np.eye(m)
    rows[:, :, m:-1] = -found.of_end
    left = _inverse_jacobian(turn)
    rows[:, :3, :3] = np.swapaxes(left, 1, 2)
    rows[:, :3, m:-1] = -left @ found.of_end[:, :3]
    rows[:, :3, -1], rows[:, 3:6, -1] = turn, following.omega - found.end.omega
    if following.own is not None and found.end.own is not None:
        rows[:, 6:, -1] = following.own - found.end.own
    rows[~joined] = 0
    return rows


def _inverse_jacobian(turn: np.ndarray) -> np.ndarray:
    r"""The inverse left Jacobian (n, 3, 3) of rotation vectors (n, 3)."""
    angle = np.linalg.norm(turn, axis=1)[:, None, None]
    half = np.where(angle > SMALL_TURN, angle, 1) / 2
    factor = np.where(angle > SMALL_TURN, (1 - half / np.tan(half)) / (4 * half**2), 1 / 12)
    hat = _hat(turn)
    return np.eye(3) - hat / 2 + factor * (hat @ hat)


def _end(
    states: InitialStates, R: np.ndarray, omega: np.ndarray, evolving: np.ndarray, own: np.ndarray
) -> InitialStates:
    """The states at the ends of windows that begin with `states`."""
    after = None if states.own is None else np.array(states.own, float)
    if after is not None:
        after[:, evolving] = own
    return InitialStates(R, omega, after)


def _chain(ends: np.ndarray, first: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The states at the starts of segments, and at the ends of windows, in those of windows."""
    m = ends.shape[1]
    starts, of_end = np.zeros_like(ends), np.empty((len(first), *ends.shape[1:]))
    starts[first, :, :m] = np.eye(m)
    for k in range(int(count.max())):
        some = np.flatnonzero(count > k)
        here = first[some] + k
        after = ends[here, :, :m] @ starts[here]
        after[:, :, m:] += ends[here, :, m:]
        last = count[some] == k + 1
        of_end[some[last]] = after[last]
        starts[here[~last] + 1] = after[~last]
    return starts, of_end


def _triangles(rows: np.ndarray) -> np.ndarray:
    """The triangles of QR decompositions of tables (n, rows, columns), with rows of zeros."""
    found = np.asarray(np.linalg.qr(rows, mode="r"))
    missing = rows.shape[2] - found.shape[1]
    return np.pad(found, [(0, 0), (0, missing), (0, 0)]) if missing else found


def _merge(triangles: np.ndarray, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One triangle for all neighbours with one key, and the keys."""
    while True:
        first = np.append(True, np.diff(keys) != 0)
        if first.all():
            return triangles, keys
        begin = np.flatnonzero(first)
        number = np.arange(len(keys)) - begin[np.cumsum(first) - 1]
        even = np.flatnonzero(number % 2 == 0)
        after = np.minimum(even + 1, len(keys) - 1)
        paired = (after > even) & (keys[after] == keys[even])
        both = np.concatenate([triangles[even[paired]], triangles[after[paired]]], axis=1)
        left = triangles[even]
        left[paired] = _triangles(both)
        triangles, keys = left, keys[even]


def _weigh(
    model: Model, segments: Segment, advanced: Advanced, rows: Rows, least_curvature: float
) -> tuple[np.ndarray, np.ndarray]:
    r"""Rows (segments, nodes, axes of all sensors, columns+1) with residuals, and their spread.

    With the rows $A$ and the side $b$ of a robust loss, $A^Tb$ is half the gradient, and $A^TA$
    half the second derivative: $\rho'$ across a residual, and $\rho' + 2\rho''s$, or the least
    curvature, along the residual.
    """
    tables, spread = [], np.zeros((len(advanced.cost), 3))
    for channel, of_channel in rows.residuals.items():
        r, mask = advanced.residuals[channel].astype(float), segments.mask[channel]
        squares, axes = np.sum(r * r, axis=2), r.shape[2]
        weight, slope = np.ones_like(squares), np.zeros_like(squares)
        side = r
        if channel in advanced.weights:
            weight, slope = np.moveaxis(advanced.weights[channel].astype(float), -1, 0)
            along = np.sqrt(np.maximum(1 + 2 * squares * slope / weight, least_curvature))
            unit = r / np.sqrt(np.where(squares > 0, squares, 1))[..., None]
            root = np.sqrt(weight)[..., None]
            radial = unit[..., None, :] @ of_channel
            change = ((1 - along)[..., None] * unit)[..., None] * radial
            of_channel = root[..., None] * (of_channel - change)
            side = root / along[..., None] * r
        tables.append(np.concatenate([of_channel, side[..., None]], axis=3))
        across, lengthwise = (axes - 1) * weight, weight + 2 * slope * squares
        in_problem = across + np.maximum(lengthwise, LEAST_CURVATURE * weight)
        each = np.stack([weight**2 * squares, across + lengthwise, in_problem], axis=-1)
        spread += np.sum(np.where(mask[..., None], each, 0), axis=1)
    return np.concatenate(tables, axis=2), spread
