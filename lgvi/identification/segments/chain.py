r"""Segments chained to windows: derivatives of residuals by initial states and leaves.

Along a segment the small change of the state $x_k$ follows $x_{k+1} = A_k x_k + B_k$, with a column
for each unknown; the local derivatives are those of `programs`. What is left of the rows of a
segment is their triangle, and of a chain of segments that of its window.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from functools import partial
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh
from scipy.spatial.transform import Rotation

from ...modules.integrator import MoserVeselovIntegrator
from ..model.configuration import ModelAt
from ..model.free_leaves import ravel
from ..model.model import Model
from ..model.states import InitialStates, state_leaves
from .programs import SIX, Advanced, Changes, Local, Programs, Segment
from .segment import Chains, Table

SMALL_TURN = 1e-3  # rad, for which a series replaces a quotient
LEAST_CURVATURE = 0.05  # of a robust loss along a residual, over the curvature across it


OPTIONAL = "time_offset", "drag"  # leaves of a sensor for which None is zero


def with_all_leaves(at: ModelAt) -> ModelAt:
    """The model with zero for what is None and could be a number.

    So that one program serves models with and without it.
    """
    zero = np.zeros((), jax.dtypes.canonicalize_dtype(float))
    own = None if at.own is None else _filled(at.own, False)
    return at._replace(model=_filled(at.model, zero), selected=_filled(at.selected, False), own=own)


def _filled(tree: Any, value: Any) -> Any:
    """A model, or one of True and False, with a value for leaves that may be None."""
    if tree.rotor_delay is None:
        tree = _put(tree, lambda model: model.rotor_delay, value)
    for channel, sensor in tree.sensors.items():
        for name in {field.name for field in fields(sensor)} & set(OPTIONAL):
            number, where = getattr(sensor, name), partial(_leaf, channel, name)
            if number is None:
                tree = _put(tree, where, value)
            elif type(number) in (int, float):  # of a sensor of the user
                tree = _put(tree, where, np.asarray(number, np.asarray(value).dtype))
    return tree


def _leaf(channel: str, name: str, tree: Any) -> Any:
    return getattr(tree.sensors[channel], name)


def _put(tree: Any, where: Callable[[Any], Any], value: Any) -> Any:
    return eqx.tree_at(where, tree, value, is_leaf=lambda node: node is None)


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
        places = cls(int(ends[-1]), index, none)
        return places if states is None else places._replace(states=places.of(states))

    def of(self, selected: Any) -> np.ndarray:
        """The places of the leaves that are selected in a model of True and False."""
        return ravel(eqx.filter(self.index, selected)).astype(int)

    def part(self, name: str) -> np.ndarray:
        """The places of a part of the model, such as its body."""
        return ravel(getattr(self.index, name)).astype(int)

    def sensor(self, channel: str) -> np.ndarray:
        """The places of a sensor."""
        return ravel(self.index.sensors[channel]).astype(int)

    def leaf(self, channel: str, name: str) -> np.ndarray:
        """The places of a leaf of a sensor, which may have none."""
        return ravel(getattr(self.index.sensors[channel], name, None)).astype(int)

    @property
    def rotor_delay(self) -> np.ndarray:
        """The place of the delay of rotors, if there is one."""
        return self.part("rotor_delay")

    @property
    def time_offsets(self) -> dict[str, np.ndarray]:
        """The place of the time offset of each sensor, if it has one."""
        return {channel: self.leaf(channel, "time_offset") for channel in self.index.sensors}


class Rows(NamedTuple):
    """Derivatives along segments (segments, ...), with a column for each direction."""

    residuals: dict[str, np.ndarray]  # (nodes, axes, columns), by channel
    end: np.ndarray  # (6 + states, columns), of the turn, omega and leaves that are a state


def times_six(v: np.ndarray) -> np.ndarray:
    """The matrix (..., 3, 6) of the six numbers of a symmetric matrix in its product with `v`."""
    matrices = np.zeros((*v.shape[:-1], 3, 6))
    for k, (i, j) in enumerate(zip(*SIX, strict=True)):
        matrices[..., i, k] = v[..., j]
        matrices[..., j, k] = v[..., i]
    return matrices


class Directions(NamedTuple):
    """In which directions what a motion depends on may change, one for each column."""

    leaves: np.ndarray  # (leaves, columns), of all floating-point leaves of the model
    # (2, columns), of a torque -(d + q |omega|) omega times a third of the trace of the inertia.
    drag: np.ndarray

    @classmethod
    def of_leaves(cls, leaves: np.ndarray) -> "Directions":
        """Without a torque beside that of the model."""
        return cls(leaves, np.zeros((2, leaves.shape[1])))

    def followed_by(self, others: "Directions") -> "Directions":
        """With more columns."""
        pairs = zip(self, others, strict=True)
        return Directions(*(np.concatenate(pair, axis=1) for pair in pairs))


class InputChanges(NamedTuple):
    """Changes of what goes into segments (segments, ..., columns), one column for each direction.

    Of leaves that are not the body's, `leaves` has them as they are.
    """

    inertia: np.ndarray  # (6, columns), of xx, yy, zz, xy, xz, yz
    scale: np.ndarray  # (1, columns), relative, of all times
    # (nodes, 9 or 18, columns), of rho, tau, the rate of rho, and forces of rotors.
    acting: np.ndarray | None
    leaves: np.ndarray  # (leaves, columns), for all segments

    def part(self, name: str) -> np.ndarray | None:
        """Changes of what acts at the nodes."""
        first = {"rho": 0, "tau": 3, "rho_rate": 6, "rotor_force": 9}[name]
        size = 9 if name == "rotor_force" else 3
        return None if self.acting is None else self.acting[:, :, first : first + size]


def derive(
    local: Local,
    segments: Segment,
    leaves: np.ndarray,
    places: Places,
    directions: Directions,
    fractions: tuple[np.ndarray, np.ndarray],
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
        The directions. The first columns belong to the state, and their directions are zero.
    fractions
        The fractions of a step at which its stages begin and end.
    """
    leaf_directions, drag = directions
    inputs = _input_changes(local, segments, leaves, places, leaf_directions)
    states = _states(local, inputs, places, fractions, drag)
    turn, momentum = states[:, :, :3], states[:, :, 3:]
    # The rates at the nodes that are needed, or at the end alone.
    of_rates = [*local.readings.values(), {} if local.force is None else local.force.changes]
    some = slice(None if any("omega" in changes for changes in of_rates) else -1, None)
    change = momentum[:, some] - times_six(local.omega[:, some]) @ inputs.inertia[:, None]
    if inputs.acting is not None:
        change -= inputs.acting[:, some, :3]
    omega = np.linalg.inv(local.J.astype(float))[:, None] @ change
    times = np.stack([local.t, local.t - local.t[:, :1]], axis=-1)[..., None]
    times = times * inputs.scale[:, None]
    alpha, shape = None, (*local.t.shape, 3, leaf_directions.shape[1])
    if local.acceleration is not None:
        names = {name: inputs.part(name) for name in ("rho", "tau", "rho_rate")}
        of_law = leaf_directions[places.part("torque")]
        rest = {"inertia": inputs.inertia[:, None], "t": times[:, :, :1], "law": of_law}
        alpha = _sum(
            local.acceleration, {"turn": turn, "momentum": momentum, **rest, **names}, shape
        )
    of_state = {"turn": turn, "omega": omega, "t": times[:, :, :1]}
    path, force = _of_centre(local, inputs, places, of_state)
    residuals, offsets = {}, places.time_offsets
    for channel, changes in local.readings.items():
        of_sensor, offset = places.sensor(channel), offsets[channel]
        axes = *segments.mask[channel].shape, _axes(changes)
        of = {"turn": turn, "omega": omega, "alpha": alpha, "times": times, "force": force}
        if path is not None:
            of |= {"x": path[:, :, :3], "v": path[:, :, 3:]}
        rows = _sum(
            changes, of | {"leaves": leaf_directions[of_sensor]}, (*axes, leaf_directions.shape[1])
        )
        if len(offset) and leaf_directions[[*offset, *places.part("time_scale")]].any():
            # The sensor reads the motion later. A clock that is slower does not delay it more.
            later = leaf_directions[offset] - leaves[:, offset, None] * inputs.scale
            rows += _sum(changes, _flow(local), (*axes, 1)) * later[:, None]
        residuals[channel] = rows
    end = np.concatenate([turn[:, -1], omega[:, -1]], axis=1)
    if local.own is not None:
        of = {
            name: leaf_directions[places.part(name)]
            for name in ("rotor_inertia", "rotors", "sensors")
        }
        own = len(places.states), leaf_directions.shape[1]
        own = _sum(local.own, of | {"scale": inputs.scale}, (len(end), *own))
        if path is not None:
            at = np.concatenate([places.part("x0"), places.part("v0")])
            own[:, np.searchsorted(places.states, at)] = path[:, -1]
        end = np.concatenate([end, own], axis=1)
    return Rows(residuals, end)


def _axes(changes: Changes) -> int:
    """Number of axes of the residual of a sensor."""
    return next(iter(changes.values())).shape[2]


def _of_centre(
    local: Local, inputs: InputChanges, places: Places, of_state: dict[str, np.ndarray]
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Changes at the nodes of position and velocity (..., 6, columns), and of the specific force.

    None where the model has no such thing. The derivative of `translation.translate`.
    """
    changes, force = {}, None
    columns, shape = inputs.leaves.shape[1], (*local.t.shape, 3, inputs.leaves.shape[1])
    if local.force is not None:
        of_leaves = {name: inputs.leaves[places.part(name)] for name in ("mass", "force", "torque")}
        of_rotors = {"rotor_force": inputs.part("rotor_force")}
        changes, of = local.force.changes, of_state | of_leaves | of_rotors
        force = _sum(changes, of, shape)
    if local.path is None:
        return None, force
    R, v, a = (array.astype(float) for array in local.path)
    rest = np.broadcast_to(inputs.leaves[places.part("gravity")], shape)
    by_v = np.zeros((*local.t.shape, 3, 3))
    if local.force is not None:
        turned = _hat(local.force.value.astype(float)) @ of_state["turn"]
        rest = rest + R @ (force - turned)
        if "v" in changes:
            by_v = R @ changes["v"]
    h = np.diff(local.t.astype(float), axis=1)[..., None, None]
    of_h, half = h * inputs.scale[:, None], h / 2
    after = np.linalg.inv(np.eye(3) - half * by_v[:, 1:])
    path = np.empty((*local.t.shape, 6, columns))
    path[:, 0, :3], path[:, 0, 3:] = (inputs.leaves[places.part(name)] for name in ("x0", "v0"))
    for k in range(h.shape[1]):
        x, dv = path[:, k, :3], path[:, k, 3:]
        change = half[:, k] * (rest[:, k] + by_v[:, k] @ dv) + of_h[:, k] / 2 * a[:, k, :, None]
        middle = (v[:, k] + h[:, k, :, 0] / 2 * a[:, k])[..., None]
        path[:, k + 1, :3] = x + h[:, k] * (dv + change) + of_h[:, k] * middle
        ends = half[:, k] * rest[:, k + 1] + of_h[:, k] / 2 * a[:, k + 1, :, None]
        path[:, k + 1, 3:] = after[:, k] @ (dv + change + ends)
    if "v" in changes and force is not None:
        force = force + changes["v"] @ path[:, :, 3:]
    return path, force


def _flow(local: Local) -> dict[str, Any]:
    """What changes with time at the nodes (segments, nodes, ..., 1)."""
    path, force = local.path, local.force
    return {
        "x": None if path is None else path.v[..., None],
        "v": None if path is None else path.acceleration[..., None],
        "force": None if force is None else force.rate[..., None],
        "turn": local.omega[..., None],
        "omega": local.alpha[..., None],
        "alpha": None if local.alpha_rate is None else local.alpha_rate[..., None],
        "times": np.ones((*local.t.shape, 2, 1)),
    }


def _input_changes(
    local: Local, segments: Segment, leaves: np.ndarray, places: Places, directions: np.ndarray
) -> InputChanges:
    body, clock = directions[places.part("body")], directions[places.part("time_scale")]
    inertia = local.of_leaves.astype(float) @ body
    scale = clock / leaves[:, places.part("time_scale"), None].astype(float)
    acting = None
    if local.acting is not None:
        of = {name: directions[places.part(name)] for name in ("rotor_inertia", "rotors")}
        size = next((changes.shape[2] for changes in local.acting.values()), 9)
        acting = (*local.t.shape, size, directions.shape[1])
        acting = _sum(local.acting, of | {"scale": scale[:, None]}, acting)
        delay = directions[places.rotor_delay]
        if (
            delay.any() and "rotor_momentum" in segments.rates
        ):  # rotors have later what is recorded: less by the slope
            factor = leaves[:, None, places.part("rotor_inertia")]
            acting[:, :, :3] -= (factor * segments.rates["rotor_momentum"])[..., None] * delay
    return InputChanges(inertia, scale, acting, directions)


def _states(
    local: Local,
    inputs: InputChanges,
    places: Places,
    fractions: tuple[np.ndarray, np.ndarray],
    drag: np.ndarray,
) -> np.ndarray:
    """Changes of turn and momentum at the nodes (segments, nodes, 6, columns)."""
    (number, drifts), nodes = local.turn.shape[:2], local.t.shape[1]
    columns, stages = inputs.inertia.shape[2], drifts // (nodes - 1)
    x = np.zeros((number, 6, columns))
    x[:, range(3), range(3)] = 1
    x[:, 3:, 3:6] = local.J
    x[:, 3:] += times_six(local.omega[:, 0]) @ inputs.inertia
    if inputs.acting is not None:
        x[:, 3:] += inputs.acting[:, 0, :3]
    # The turn of each drift changes by matrices (segments, drifts, 3, ...) times what changes.
    matrices, change = [local.by_momentum, local.by_inertia], [inputs.inertia[:, None]]
    if local.by_start is not None:
        matrices.append(local.by_start)
        change.append(x[:, None, 3:])
    if inputs.scale.any():
        matrices.append(local.by_scale[..., None])
        change.append(inputs.scale[:, None])
    if inputs.acting is not None:
        rho = inputs.acting[:, :, :3]
        matrices.append(local.by_rotors)
        change.append(np.repeat((rho[:, :-1] + rho[:, 1:]) / 2, stages, axis=1))
    varying = max(fraction.shape[1] for fraction in change)
    change = np.concatenate(
        [np.broadcast_to(part, (number, varying, *part.shape[2:])) for part in change], axis=2
    )
    # Of the state, a turn and a momentum (6), and of what else changes.
    after = np.zeros((number, drifts, 6, 6 + change.shape[2]))
    np.concatenate(matrices, axis=3, out=after[..., :3, 3:])
    # The momentum is turned back as the body turns.
    np.matmul(_hat(local.momentum), after[..., :3, 3:], out=after[..., 3:, 3:])
    after[..., :3, :3] = local.turn
    after[..., 3:, 3:6] += local.turn
    kicks = [
        None if changes is None else _kick(changes, local, inputs, places, fraction)
        for changes, fraction in zip((local.before, local.after), fractions, strict=True)
    ]
    torque = _drag_torque(local, drag)
    half = np.diff(local.t, axis=1)[..., None, None] / 2
    states = np.empty((number, nodes, 6, columns))
    states[:, 0] = x
    for k in range(drifts):
        if torque is not None and k % stages == 0:
            x[:, 3:] += half[:, k // stages] * torque[:, k // stages]
        for kick, is_before in zip(kicks, (True, False), strict=True):
            if not is_before:
                both = np.concatenate([x, change[:, min(k, varying - 1)]], axis=1)
                x = after[:, k] @ both
            if kick is not None:
                matrix, of_kick = kick
                x[:, 3:] += matrix[:, k] @ x + of_kick[:, k]
        if (k + 1) % stages == 0:
            if torque is not None:
                x[:, 3:] += half[:, k // stages] * torque[:, k // stages + 1]
            states[:, (k + 1) // stages] = x
    return states


def _drag_torque(local: Local, drag: np.ndarray) -> np.ndarray | None:
    """The torque of drag at the nodes (segments, nodes, 3, columns), None without any."""
    if not drag.any():
        return None
    omega = local.omega.astype(float)
    speed = np.linalg.norm(omega, axis=-1)[..., None, None]
    size = np.trace(local.J, axis1=1, axis2=2)[:, None, None, None] / 3
    return -size * (drag[0] + speed * drag[1]) * omega[..., None]


def _kick(
    changes: Changes, local: Local, inputs: InputChanges, places: Places, fractions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Changes of momentum by kicks (segments, drifts, 3, ...), by the state and along columns."""
    (number, drifts), columns = local.turn.shape[:2], inputs.inertia.shape[2]
    matrix = np.zeros((number, drifts, 3, 6))
    for name, part in (("turn", slice(0, 3)), ("momentum", slice(3, 6))):
        if name in changes:
            matrix[..., part] = changes[name]

    def at(values: np.ndarray | None, fractions: np.ndarray) -> np.ndarray | None:
        if values is None:
            return None
        fractions = fractions.reshape(1, 1, -1, *[1] * (values.ndim - 2))
        between = values[:, :-1, None] + fractions * np.diff(values, axis=1)[:, :, None]
        return between.reshape(number, drifts, *values.shape[2:])

    scale = inputs.scale[:, None]
    of = {
        "inertia": inputs.inertia[:, None],
        "rho": at(inputs.part("rho"), np.full(len(fractions), 0.5)),
        "tau": at(inputs.part("tau"), fractions),
        "scale": scale,
        "t": at(local.t[..., None, None], fractions) * scale,
        "law": inputs.leaves[places.part("torque")],
    }
    return matrix, _sum(changes, of, (number, drifts, 3, columns))


def _sum(changes: Changes, of: Mapping[str, Any], shape: tuple[int, ...]) -> np.ndarray:
    """The sum of local derivatives times what changes, of what is known to change."""
    total = np.zeros(shape)
    for name, matrix in changes.items():
        if (change := of.get(name)) is not None and change.any():
            total += matrix @ change
    return total


def _hat(v: np.ndarray) -> np.ndarray:
    """Matrices (..., 3, 3) of the cross product with vectors."""
    matrices = np.zeros((*v.shape, 3))
    matrices[..., 2, 1] = v[..., 0]
    matrices[..., 0, 2] = v[..., 1]
    matrices[..., 1, 0] = v[..., 2]
    return matrices - np.swapaxes(matrices, -1, -2)


class Windows(NamedTuple):
    """What is left of the rows of windows (windows, ...), and their ends."""

    triangles: np.ndarray  # (1+m+p, 1+m+p), of m own unknowns
    blocks: np.ndarray | None  # (blocks, 1+m+p, 1+m+p), what the triangle is made of
    cost: np.ndarray  # sum of the losses; infinite if a drift was not solved
    loss_sums: np.ndarray  # (3,), sums from which `variance_factor` follows
    end: InitialStates
    of_end: np.ndarray  # (m, m+p), its derivative


class Group(NamedTuple):
    """Windows side by side, the model for each, and the states at their starts."""

    at: ModelAt
    places: Places
    programs: Programs
    chains: Chains
    numbers: np.ndarray  # (windows,), among those of the chains
    states: InitialStates

    @property
    def leaves(self) -> np.ndarray:
        """All floating-point leaves of the model of each window (windows, leaves)."""
        at, places = self.at, self.places
        leaves = np.tile(ravel(eqx.filter(at.model, eqx.is_inexact_array)), (len(self.numbers), 1))
        leaves[:, places.of(at.selected)] = (
            at.leaves if at.leaves.ndim == 1 else at.leaves[self.numbers]
        )
        if at.own is not None and self.states.own is not None:
            own = places.of(at.own)
            leaves[:, own] = self.states.own[:, : len(own)]
        return leaves


def _groups(
    at: ModelAt,
    states: InitialStates,
    chains: Chains,
    method: MoserVeselovIntegrator,
    mesh: Mesh | None,
) -> Iterator[Group]:
    """Windows from states at their starts, as many side by side as are in memory."""
    at = with_all_leaves(at)
    places, sizes = Places.of_model(at.model), chains.sizes
    lanes = sizes.lanes if chains.optimised else sizes.quick_lanes
    programs = Programs(at.model, method, chains.optimised, lanes, mesh)
    for numbers in chains.groups(programs.width):
        yield Group(at, places, programs, chains, numbers, states.at(numbers))


class SimulatedPart(NamedTuple):
    """Parts of windows as segments, which are simulated from the states at their starts."""

    table: Table
    windows: np.ndarray  # numbers of the windows of which there is a part
    window: np.ndarray  # (segments,), the number of the window of each segment
    leaves: np.ndarray  # (segments, leaves), of the model
    R: np.ndarray  # (segments, 3, 3)
    advanced: Advanced

    @property
    def last(self) -> np.ndarray:
        """Numbers of the last segments of the parts."""
        return self.table.first + self.table.counts - 1


def simulate(group: Group) -> Iterator[SimulatedPart]:
    """Windows from the states at their starts, a part of time after another."""
    _, places, programs, chains, numbers, states = group
    leaves = group.leaves
    scale = leaves[:, places.part("time_scale")[0]]  # offsets are true seconds
    late = np.zeros((len(numbers), 1 + len(chains.channels)))
    offsets = places.time_offsets
    for channel, k in chains.clocks.items():
        late[:, k] = leaves[:, offsets[channel][0]] / scale
    delays, dtype = leaves[:, places.rotor_delay[0]].astype(float), states.omega.dtype
    leaves, R_now, omega_now = leaves.astype(dtype), np.array(states.R), np.array(states.omega)
    for some, table in chains.parts(numbers, late, delays):
        window, first, segments = np.repeat(some, table.counts), table.first, table.segments
        if len(some) <= chains.sizes.least_lanes and np.max(table.counts) > chains.sizes.long:
            programs_now = programs._replace(lanes=chains.sizes.least_lanes)
        else:
            programs_now = programs
        total = len(window)
        of_segments, R, omega = (
            leaves[window], np.empty((total, 3, 3), dtype), np.empty((total, 3), dtype)
        )  # fmt: skip
        R[first], omega[first] = R_now[some], omega_now[some]
        advanced: Any = None
        here = first
        for k in range(int(table.counts.max())):
            if k > 0:
                here = first[table.counts > k] + k
                R[here], omega[here] = advanced.R[here - 1], advanced.omega[here - 1]
                of_segments[here[:, None], places.states] = advanced.own[here - 1]
            arguments = of_segments[here], R[here], omega[here]
            batch = programs_now.advance(
                *arguments, jax.tree.map(lambda x, at=here: x[at], segments)
            )
            if len(here) == total:
                advanced = batch
                break
            if advanced is None:
                advanced = jax.tree.map(partial(_empty, total), batch)
            for array, values in zip(*map(jax.tree.leaves, (advanced, batch)), strict=True):
                array[here] = values
        result = SimulatedPart(table, some, window, of_segments, R, advanced)
        R_now[some], omega_now[some] = advanced.R[result.last], advanced.omega[result.last]
        leaves[some[:, None], places.states] = advanced.own[result.last]
        yield result


def _empty(number: int, like: np.ndarray) -> np.ndarray:
    return np.empty((number, *like.shape[1:]), like.dtype)


Which = Literal["residuals", "predicted"]
ReadingArrays = dict[str, np.ndarray]  # something of each reading (readings, ...), by channel


class Followed(NamedTuple):
    """Simulated windows, without derivatives."""

    residuals: ReadingArrays  # whitened
    predicted: ReadingArrays
    speed: np.ndarray  # (windows,), rad/s, the largest at the nodes
    usable: np.ndarray  # (windows,), whether all steps converged


def follow(
    at: ModelAt,
    states: InitialStates,
    chains: Chains,
    method: MoserVeselovIntegrator,
    mesh: Mesh | None = None,
) -> Followed:
    """Windows from states at their starts."""
    groups = []
    for group in _groups(at, states, chains, method, mesh):
        number = len(group.numbers)
        speed, usable = np.zeros(number), np.ones(number, bool)
        residuals, predicted = _ReadingsInOrder(at.model), _ReadingsInOrder(at.model)
        for part in simulate(group):
            some, first, advanced = part.windows, part.table.first, part.advanced
            speed[some] = np.maximum(speed[some], np.maximum.reduceat(advanced.speed, first))
            usable[some] &= np.logical_and.reduceat(advanced.usable, first)
            residuals.add(advanced.residuals, part)
            predicted.add(advanced.predicted, part)
        groups.append(Followed(residuals.in_order(), predicted.in_order(), speed, usable))
    return _concatenated(groups)


def compute_costs(
    at: ModelAt,
    states: InitialStates,
    chains: Chains,
    method: MoserVeselovIntegrator,
    mesh: Mesh | None = None,
) -> np.ndarray:
    """Sums of the losses of windows (windows,); infinite where a drift is not solved."""
    costs = np.zeros(chains.number)
    with np.errstate(over="ignore", invalid="ignore"):  # where a motion gets lost
        for group in _groups(at, states, chains, method, mesh):
            for part in simulate(group):
                window = group.numbers[part.windows]
                costs[window] += np.add.reduceat(part.advanced.cost, part.table.first)
    return np.where(np.isnan(costs), np.inf, costs)


class _ReadingsInOrder:
    """What is kept of all readings of some windows, of one part of time after another."""

    def __init__(self, model: Model):
        self.parts = {channel: [] for channel in model.sensors}

    def add(self, of_segments: Mapping[str, np.ndarray], part: SimulatedPart) -> None:
        """What is of the segments of a part of time."""
        for channel, parts in self.parts.items():
            mask = part.table.segments.mask[channel]
            parts.append((np.repeat(part.window, mask.sum(axis=1)), of_segments[channel][mask]))

    def in_order(self) -> ReadingArrays:
        """One window after another."""
        return {channel: self._in_order(parts) for channel, parts in self.parts.items()}

    @staticmethod
    def _in_order(parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        window, values = (np.concatenate(column) for column in zip(*parts, strict=True))
        return values if len(parts) == 1 else values[np.argsort(window, kind="stable")]


def _concatenated(groups: Sequence[Any]) -> Any:
    """Results of windows, one group after another."""
    return groups[0] if len(groups) == 1 else jax.tree.map(lambda *x: np.concatenate(x), *groups)


def linearise(
    at: ModelAt,
    states: InitialStates,
    chains: Chains,
    method: MoserVeselovIntegrator,
    least_curvature: float,
    blocks: int,
    mesh: Mesh | None,
    more: Directions | None = None,
) -> Windows:
    """Residuals of windows and their derivatives by their initial states and selected leaves.

    And in `more` directions, behind these.

    The curvature of a robust loss along a residual is at least `least_curvature` times the
    curvature across the residual. Each window is made of so many `blocks` of time.
    """
    groups = []
    for group in _groups(at, states, chains, method, mesh):
        with np.errstate(over="ignore", invalid="ignore"):  # where a motion gets lost
            groups.append(_linearise(group, more, least_curvature, blocks))
    return _concatenated(groups)


def _linearise(
    group: Group, more: Directions | None, least_curvature: float, blocks: int
) -> Windows:
    """The windows of a group."""
    at, places, programs, chains, numbers, states = group
    m, p, total = states.unknowns, at.leaves.shape[-1], len(numbers)
    own = np.zeros(0, int) if at.own is None else places.of(at.own)
    of_leaves = np.zeros((places.number, m + p))
    of_leaves[own, 6 + np.arange(len(own))] = 1
    of_leaves[places.of(at.selected), m + np.arange(p)] = 1
    directions = Directions.of_leaves(of_leaves)
    if more is not None:
        directions = directions.followed_by(more)
    unknowns = directions.leaves.shape[1]
    evolving = 6 + np.flatnonzero(np.isin(own, places.states))
    by_start, end_states = np.zeros((total, m, unknowns)), _writeable(states)
    by_start[:, :, :m] = np.eye(m)
    cost, loss_sums, tables, keys = np.zeros(total), np.zeros((total, 3)), [], []
    time_blocks = _TimeBlocks(chains, numbers, blocks)
    for part in simulate(group):
        segments, advanced, window = part.table.segments, part.advanced, part.window
        of_rows = time_blocks.blocks_of_rows(at.model, part) if blocks > 1 else None
        transitions = np.zeros((len(window), m, unknowns))
        transitions[:, range(6, m), range(6, m)] = 1
        triangles, of_triangles, done = [], [], 0
        for local in programs.differentiate(part.leaves, part.R, segments, advanced.motion):
            here = slice(done, done + len(local.t))
            done = here.stop
            segments_here, advanced_here, leaves = jax.tree.map(
                lambda x, here=here: x[here], (segments, advanced, part.leaves)
            )
            arguments = local, segments_here, leaves, places, directions
            rows = derive(*arguments, programs.fractions(segments))
            transitions[here, :6] = rows.end[:, :6]
            transitions[here, evolving] = rows.end[:, 6:]
            table, squares = _weigh(at.model, segments_here, advanced_here, rows, least_curvature)
            np.add.at(loss_sums, window[here], squares)
            for some, block, of_block in _split(table, None if of_rows is None else of_rows[here]):
                triangles.append(_triangles(of_block.reshape(len(some), -1, unknowns + 1)))
                of_triangles.append(np.stack([here.start + some, block]))
        segment, block = np.concatenate(of_triangles, axis=1)
        segment_by_start, by_start[part.windows] = _chain(
            transitions, part.table, by_start[part.windows]
        )
        triangles = np.concatenate(triangles)
        common = triangles[:, :, :m] @ segment_by_start[segment]
        common[:, :, m:] += triangles[:, :, m:-1]
        triangles = np.concatenate([common, triangles[:, :, -1:]], axis=2)
        order = np.lexsort((segment, block, window[segment]))
        merged = _merge(triangles[order], (window[segment] * blocks + block)[order])
        tables.append(merged[0])
        keys.append(merged[1])
        cost[part.windows] += np.add.reduceat(advanced.cost, part.table.first)
        end_states.R[part.windows], end_states.omega[part.windows] = (
            array[part.last] for array in (advanced.R, advanced.omega)
        )
        if end_states.own is not None:
            end_states.own[part.windows[:, None], evolving - 6] = advanced.own[part.last]
    table, key = np.concatenate(tables), np.concatenate(keys)
    order = np.argsort(key, kind="stable")
    table, key = _merge(table[order], key[order])
    of_blocks, columns = None, unknowns + 1
    if blocks > 1:
        of_blocks = np.zeros((total * blocks, columns, columns))
        of_blocks[key] = table
        of_blocks = of_blocks.reshape(total, blocks, columns, columns)
    triangles, _ = _merge(table, key // blocks)
    return Windows(triangles, of_blocks, cost, loss_sums, end_states, by_start)


def _split(
    table: np.ndarray, block: np.ndarray | None
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Segments with rows of a block of time, the block of each, and its rows, others being zero.

    `table` (segments, nodes, axes, ...) are rows, and `block` the block of each; None if all rows
    are of the first.
    """
    if block is None:
        yield np.arange(len(table)), np.zeros(len(table), int), table
        return
    least, most = np.min(block, axis=(1, 2)), np.max(block, axis=(1, 2))
    for k in range(int(np.max(most - least)) + 1):
        some = np.flatnonzero(least + k <= most)
        inside = block[some] == (least[some] + k)[:, None, None]
        yield some, least[some] + k, table[some] * inside[..., None]


class _TimeBlocks:
    """Blocks of time of windows, each with as many readings of each channel."""

    def __init__(self, chains: Chains, numbers: np.ndarray, blocks: int):
        channels = chains.recordings.channels
        self.blocks, self.done = blocks, {channel: np.zeros(len(numbers)) for channel in channels}
        self.total = {channel: chains.count_readings(channel)[numbers] for channel in channels}

    def blocks_of_rows(self, model: Model, part: SimulatedPart) -> np.ndarray:
        """The block of each row (segments, nodes, axes of all sensors) of a part of time."""
        blocks, window, table = [], part.window, part.table
        for channel, sensor in model.sensors.items():
            mask, done = table.segments.mask[channel], self.done[channel]
            of_segment = np.sum(mask, axis=1)
            before = np.cumsum(of_segment) - of_segment
            before += np.repeat(done[part.windows] - before[table.first], table.counts).astype(int)
            number = before[:, None] + np.cumsum(mask, axis=1)
            total = np.maximum(self.total[channel], 1)[window, None]
            block = np.clip(-(-number * self.blocks // total) - 1, 0, self.blocks - 1)
            blocks.append(np.repeat(block[..., None], len(sensor.axes), axis=2))
            done[part.windows] += np.add.reduceat(of_segment, table.first)
        return np.concatenate(blocks, axis=2)


def gaps(windows: Windows, following: InitialStates, joined: np.ndarray) -> np.ndarray:
    """The rows of gaps between windows and the next ones (windows, m, 2m+p+1), as in `BlockArrow`.

    Zero where a window is not joined to the next one, which begins with the `following` state.
    """
    m = windows.of_end.shape[1]
    between = np.swapaxes(windows.end.R, 1, 2).astype(float) @ following.R
    turn = Rotation.from_matrix(between).as_rotvec()
    rows = np.zeros((len(turn), m, m + windows.of_end.shape[2] + 1))
    rows[:, :, :m] = np.eye(m)
    rows[:, :, m:-1] = -windows.of_end
    left = _inverse_jacobian(turn)
    rows[:, :3, :3] = np.swapaxes(left, 1, 2)
    rows[:, :3, m:-1] = -left @ windows.of_end[:, :3]
    rows[:, :3, -1], rows[:, 3:6, -1] = turn, following.omega - windows.end.omega
    if following.own is not None and windows.end.own is not None:
        rows[:, 6:, -1] = following.own - windows.end.own
    rows[~joined] = 0
    return rows


def _inverse_jacobian(turn: np.ndarray) -> np.ndarray:
    r"""The inverse left Jacobian (n, 3, 3) of rotation vectors (n, 3)."""
    angle = np.linalg.norm(turn, axis=1)[:, None, None]
    half = np.where(angle > SMALL_TURN, angle, 1) / 2
    factor = np.where(angle > SMALL_TURN, (1 - half / np.tan(half)) / (4 * half**2), 1 / 12)
    hat = _hat(turn)
    return np.eye(3) - hat / 2 + factor * (hat @ hat)


def _writeable(states: InitialStates) -> InitialStates:
    """A copy in double precision."""
    return jax.tree.map(lambda x: np.array(x, float), states)


def _chain(
    transitions: np.ndarray, table: Table, begin: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives by the states at the starts of windows: at starts of segments, and ends of parts.

    `transitions` are those of the end of each segment by its start, `begin` (parts, m, ...) those
    of the starts of the parts by the starts of the windows.
    """
    m, first, count = transitions.shape[1], table.first, table.counts
    by_start, of_end = np.zeros_like(transitions), np.empty((len(first), *transitions.shape[1:]))
    by_start[first] = begin
    for k in range(int(count.max())):
        some = np.flatnonzero(count > k)
        here = first[some] + k
        after = transitions[here, :, :m] @ by_start[here]
        after[:, :, m:] += transitions[here, :, m:]
        last = count[some] == k + 1
        of_end[some[last]] = after[last]
        by_start[here[~last] + 1] = after[~last]
    return by_start, of_end


def _triangles(rows: np.ndarray) -> np.ndarray:
    """The triangles of QR decompositions of tables (n, rows, columns), with rows of zeros."""
    triangles = np.asarray(np.linalg.qr(rows, mode="r"))
    missing = rows.shape[2] - triangles.shape[1]
    return np.pad(triangles, [(0, 0), (0, missing), (0, 0)]) if missing else triangles


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
    tables, loss_sums = [], np.zeros((len(advanced.cost), 3))
    for channel in model.sensors:  # the order of their names is that of a tree
        of_channel = rows.residuals[channel]
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
        sums = np.stack([weight**2 * squares, across + lengthwise, in_problem], axis=-1)
        loss_sums += np.sum(np.where(mask[..., None], sums, 0), axis=1)
    return np.concatenate(tables, axis=2), loss_sums
