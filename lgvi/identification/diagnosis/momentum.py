"""The balance of the angular momentum on recordings, and torques that the model does not know."""

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import jax
import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from ...modules.multirotor import Multirotor
from ...modules.torques.law import AbstractTorque, as_law, call
from ..data.formats import INPUTS
from ..data.recordings import Recordings
from ..data.samples import OfTrajectory
from ..model.model import Model
from ..segments.levels import FEWEST_SAMPLES, SHORTEST_TURN
from ..start.measured import measurer_of

MOST_SAMPLES = 4000  # of each trajectory, from its middle
MOST_TRAJECTORIES = 20  # whose motion is looked at
TURN = 0.3  # rad, between attitudes that are compared, or whose difference is a rate
NO_BODY = "no rigid body moves so"  # how the reason begins
MOST_CHANGE = 0.05  # of the squares of the momentum in a short window, without a cause
SMOOTH = 0.3  # squares of successive differences over those of the values; 2 for white noise
NOTED, FAR_ABOVE = 0.1, 1000.0  # times the gyroscopic torque


class Motion(NamedTuple):
    """Attitudes, which begin anywhere, and rates of one trajectory at the same times."""

    t: np.ndarray  # (n,), s
    R: np.ndarray  # (n, 3, 3)
    omega: np.ndarray  # (n, 3), rad/s, body frame
    is_integrated: bool  # whether the attitudes are the integral of rates that were read

    def parts(self) -> list[slice]:
        """Parts in which the body turns about as far as in the shortest windows of a fit."""
        speed = np.linalg.norm(self.omega, axis=1)
        turn = cumulative_trapezoid(speed, self.t, initial=0)
        count = int(np.clip(turn[-1] / SHORTEST_TURN, 1, len(self.t) / FEWEST_SAMPLES))
        ends = np.searchsorted(turn, turn[-1] * np.arange(1, count) / count)
        bounds = [0, *ends.tolist(), len(self.t)]
        return [slice(a, b) for a, b in pairwise(bounds) if b - a >= FEWEST_SAMPLES // 2]

    def momentum(self) -> np.ndarray:
        """The momentum in space for each entry xx, yy, zz, xy, xz, yz of the inertia (n, 3, 6)."""
        return momentum_by_entries(self.R, self.omega)

    def carried(self, vectors: np.ndarray) -> np.ndarray:
        """Vectors in the body (n, 3), in space."""
        return np.einsum("nij,nj->ni", self.R, vectors)

    def columns(self, values: np.ndarray) -> np.ndarray:
        """Values (n, columns) about each axis of the body, in space (n, 3, 3, columns)."""
        return self.R[..., None] * values[:, None, None, :]

    def impulse(self, values: np.ndarray) -> np.ndarray:
        """The integral of `columns` over time, from the first sample."""
        return cumulative_trapezoid(self.columns(values), self.t, axis=0, initial=0)

    def steady(self) -> np.ndarray:
        """The integral of a steady torque about each axis of the body (n, 3, 3, 1)."""
        return self.impulse(np.ones((len(self.t), 1)))


class Term(NamedTuple):
    """The momentum that a recorded input brings: a field, contracted with weights."""

    name: str  # of the recorded input
    field: np.ndarray  # (n, 3 in space, 3 in the body, columns)
    weights: np.ndarray  # (3 in the body, columns)
    is_known: bool  # else the term has an unknown factor that is not below zero

    def brought(self) -> np.ndarray:
        """The momentum that the term brings (n, 3), in space."""
        return np.tensordot(self.field, self.weights, 2)


def motions(model: Model, recordings: Recordings) -> Iterator[tuple[int, Motion]]:
    """Indices of some trajectories, and their motions by the sensor with the most readings."""
    time_scale, measure, read = float(model.time_scale), measurer_of(model), recordings.reader()
    for i in range(0, len(recordings), -(-len(recordings) // MOST_TRAJECTORIES)):
        measured = measure(read(i))
        rates = max(measured.rates, key=lambda samples: len(samples[0]), default=None)
        attitudes = max(measured.attitudes, key=lambda samples: len(samples[0]), default=None)
        if rates is not None and (attitudes is None or len(rates[0]) >= len(attitudes[0])):
            t, omega = map(_middle, rates)
            t = t * time_scale
            motion = Motion(t, _integrate(t, omega), omega, True)
        elif attitudes is not None and len(attitudes[0]) > 2:
            t, R = map(_middle, attitudes)
            motion = Motion(*_rates_of(t * time_scale, R), False)
        else:
            continue
        if len(motion.t) >= FEWEST_SAMPLES and np.any(motion.omega):
            yield i, motion


def _middle(values: np.ndarray) -> np.ndarray:
    begin = max(0, len(values) - MOST_SAMPLES) // 2
    return values[begin : begin + MOST_SAMPLES]


def turn_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The rotation vectors (n, 3) from one attitude to another, body frame."""
    return Rotation.from_matrix(np.swapaxes(first, 1, 2) @ second).as_rotvec()


def momentum_by_entries(R: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """The momentum R J omega for each entry xx, yy, zz, xy, xz, yz of the inertia (n, 3, 6)."""
    x, y, z = omega.T
    o = np.zeros_like(x)
    table = np.stack([[x, o, o, y, z, o], [o, y, o, x, o, z], [o, o, z, o, x, y]])
    return np.einsum("nij,jkn->nik", R, table)


def with_rates(motion: Motion, factor: float) -> Motion:
    """The motion with its rates times a factor."""
    omega = factor * motion.omega
    return motion._replace(R=_integrate(motion.t, omega), omega=omega)


def _integrate(t: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Attitudes (n, 3, 3) from the identity, with rates (n, 3) that are linear between times."""
    step = np.diff(t)[:, None]
    turn = step * (omega[:-1] + omega[1:]) / 2 + step**2 * np.cross(omega[:-1], omega[1:]) / 12
    R = np.concatenate([np.eye(3)[None], Rotation.from_rotvec(turn).as_matrix()])
    reach = 1
    while reach < len(R):  # each is the product of twice as many as before
        R[reach:] = R[:-reach] @ R[reach:]
        reach *= 2
    return R


def _rates_of(t: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, attitudes and rates in the middles between attitudes."""
    stride = stride_of(R)
    first, last = slice(None, -stride), slice(stride, None)
    turn = turn_between(R[first], R[last])
    middle = R[first] @ Rotation.from_rotvec(turn / 2).as_matrix()
    return (t[first] + t[last]) / 2, middle, turn / (t[last] - t[first])[:, None]


def stride_of(R: np.ndarray) -> int:
    """The number of samples between two attitudes from which a rate is computed."""
    turn = np.median(np.linalg.norm(turn_between(R[:-1], R[1:]), axis=1))
    return int(np.clip(TURN / max(turn, 1e-300), 1, len(R) // 2))


def within(parts: Sequence[slice], values: np.ndarray) -> np.ndarray:
    """Values (n, ...) less their mean in each part."""
    return np.concatenate([values[part] - values[part].mean(axis=0) for part in parts])


def terms_of(model: Model, samples: OfTrajectory, motion: Motion) -> list[Term]:
    """The terms of the recorded inputs that act on the body."""
    delay = 0.0 if model.rotor_delay is None else float(model.rotor_delay)
    terms = []
    for name in INPUTS:
        if name not in samples:
            continue
        t, values = samples[name]
        late = delay if name == "rotor_momentum" else 0.0
        columns, t = values.reshape(len(t), -1).T, t * float(model.time_scale) + late
        at = np.stack([np.interp(motion.t, t, column) for column in columns], axis=1)
        if name == "body_torque":
            terms.append(Term(name, motion.impulse(at), np.eye(3), True))
        elif name == "rotor_momentum":
            inertia = np.asarray(model.rotor_inertia, float)
            weights = inertia * np.eye(3) if at.shape[1] == 3 else inertia[:, None]
            is_known = "body_torque" not in samples
            terms.append(Term(name, -motion.columns(at), weights, is_known))
        elif model.rotors is not None:
            terms += _of_rotors(model.rotors, motion, at, name)
    return terms


def _of_rotors(rotors: Multirotor, motion: Motion, speeds: np.ndarray, name: str) -> list[Term]:
    count = len(rotors.arms)
    if rotors.lag is not None and float(rotors.lag) > 0:  # a fitted lag may be below
        speeds = _follow(motion.t, speeds, float(rotors.lag))
    arms, centre, axes = (
        np.asarray(value, float) for value in (rotors.arms, rotors.centre, rotors.axes)
    )
    axes = np.broadcast_to(axes / np.linalg.norm(axes, axis=-1, keepdims=True), (count, 3))
    sense = np.array(rotors.spin)

    def weighed(coefficient: np.ndarray, directions: np.ndarray) -> np.ndarray:
        return (np.broadcast_to(coefficient, count)[:, None] * directions).T

    thrust, drag, inertia = (
        np.asarray(value, float) for value in (rotors.thrust, rotors.drag, rotors.inertia)
    )
    impulse = motion.impulse(speeds**2)
    return [
        Term(name, impulse, weighed(thrust, np.cross(arms - centre, axes)), True),
        Term(name, impulse, weighed(-drag * sense, axes), False),
        Term(name, -motion.columns(speeds), weighed(inertia * sense, axes), False),
    ]


def _follow(t: np.ndarray, commands: np.ndarray, lag: float) -> np.ndarray:
    """Speeds that begin with the commands, as `Multirotor.follow` gives, in plain NumPy."""
    speeds, ratio = commands.copy(), np.diff(t) / lag
    kept, mean = np.exp(-ratio), -np.expm1(-ratio) / ratio
    for i, change in enumerate(np.diff(commands, axis=0)):
        behind = kept[i] * (speeds[i] - commands[i]) - mean[i] * change
        speeds[i + 1] = commands[i + 1] + behind
    return speeds


def why_no_body_moves_so(model: Model, recordings: Recordings) -> str:
    """Why no rigid body moves as recorded, even in the shortest windows; empty if one may.

    The reason is the part of the angular momentum that changes in a window, for the best of all
    inertias, with any steady torque, and with recorded inputs of any size about any axes. Nothing
    is said where the change is not smooth and may be noise, nor with a torque law, which a fit may
    change.
    """
    trajectories = [] if model.torque is not None else list(motions(model, recordings))
    if not trajectories:
        return ""
    momenta, changes, causes = [], [], []
    for i, motion in trajectories:
        momentum, parts = motion.momentum(), motion.parts()
        momenta.append(momentum.reshape(-1, 6))
        changes.append(within(parts, momentum).reshape(-1, 6))
        fields = [term.field for term in terms_of(model, recordings[i], motion)]
        fields = np.concatenate([motion.steady(), *fields], axis=3)
        causes.append(within(parts, fields).reshape(len(changes[-1]), -1))
    total = np.sum([momentum.T @ momentum for momentum in momenta], axis=0)
    change, cause = np.concatenate(changes), np.concatenate(causes)
    change -= cause @ np.linalg.lstsq(cause, change, rcond=None)[0]
    inertia = eigh(change.T @ change, total + 1e-9 * np.trace(total) * np.eye(6))[1][:, 0]
    ends = np.cumsum([len(part) for part in changes])[:-1]
    left = [part.reshape(-1, 3) for part in np.split(change @ inertia, ends)]
    parts_left = [
        np.sum(part**2) / max(np.sum((momentum @ inertia) ** 2), 1e-300)
        for part, momentum in zip(left, momenta, strict=True)
    ]
    # One of many trajectories may be no flight.
    usual = float(np.median(parts_left))
    if usual < MOST_CHANGE or not _is_smooth(left):
        return ""
    return (
        f"{NO_BODY} unless an unknown torque acts, such as that of a hand: while it "
        f"turns by {SHORTEST_TURN} rad, {np.sqrt(usual):.0%} of its angular momentum changes "
        "without a recorded cause, for any inertia"
    )


def _is_smooth(values: Sequence[np.ndarray]) -> bool:
    """Whether values (n, ...) of trajectories are smooth, unlike noise."""
    differences = sum(np.sum(np.diff(value, axis=0) ** 2) for value in values)
    return bool(differences < SMOOTH * sum(np.sum(value**2) for value in values))


class _Torques(NamedTuple):
    """Torques (n, 3) of one trajectory, N m, body frame, and their possible causes."""

    residual: np.ndarray
    gyroscopic: np.ndarray
    causes: dict[str, np.ndarray]  # (n, 3, numbers), linear in the numbers


def describe_residual_torque(
    model: Model, recordings: Recordings, inertia: np.ndarray | None = None
) -> str:
    """The size of the torque that a model leaves out, and its possible causes; empty if small.

    The inertia (3, 3) of the model's body may be given, so that no program computes it again.
    """
    J = np.asarray(model.body.inertia if inertia is None else inertia, float)
    left, torques, law = [], [], None
    if model.torque is not None:
        law = as_law("torque", model.torque).of_body(model.body)
    for i, motion in motions(model, recordings):
        if law is not None and motion.is_integrated and law.depends_on_attitude:
            return ""
        momentum = motion.carried(motion.omega @ J)
        for term in terms_of(model, recordings[i], motion):
            momentum = momentum - term.brought()
        left.append(within(motion.parts(), momentum))
        torques.append(_torques(law, motion, momentum, J))
    if not torques or not _is_smooth(left):
        return ""
    residual, gyroscopic = (np.concatenate([torque[i] for torque in torques]) for i in range(2))
    squares = np.sum(residual**2)
    size = np.sqrt(squares / max(np.sum(gyroscopic**2), 1e-300))
    if size < NOTED:
        return ""
    goes_with = []
    for cause in torques[0].causes:
        columns = np.concatenate([torque.causes[cause] for torque in torques])
        columns, read = columns.reshape(len(residual) * 3, -1), residual.reshape(-1)
        rest = read - columns @ np.linalg.lstsq(columns, read, rcond=None)[0]
        goes_with.append(f"{1 - np.sum(rest**2) / squares:.0%} with {cause}")
    times = f"{size:.2g} times the gyroscopic torque (root mean squares)"
    if size > FAR_ABOVE:
        times = "there is one, and no gyroscopic torque"
    return f"residual torque: {times}; of its squares go {', '.join(goes_with)}"


def _torques(
    law: AbstractTorque | None, motion: Motion, momentum: np.ndarray, J: np.ndarray
) -> _Torques:
    stride = stride_of(motion.R)
    middle = slice(stride // 2, stride // 2 - stride)
    t, R, omega = (values[middle] for values in motion[:3])
    duration = motion.t[stride:] - motion.t[:-stride]
    rate_of_change = (momentum[stride:] - momentum[:-stride]) / duration[:, None]
    residual = np.einsum("nji,nj->ni", R, rate_of_change)
    if law is not None:
        residual = residual - np.asarray(jax.vmap(partial(call, law))(t, R, omega))
    identity = np.broadcast_to(np.eye(3), (len(t), 3, 3))
    rates = identity[..., None] * omega[:, None, None, :]
    causes = {
        "a constant torque in the body": identity,
        "one in space": np.swapaxes(R, 1, 2),
        "the rates": rates.reshape(len(t), 3, 9),
        "time": identity * (t - np.mean(t))[:, None, None],
    }
    return _Torques(residual, np.cross(omega, omega @ J), causes)
