"""A torque that the model does not know: whether one must act, and what it looks like."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from scipy.linalg import eigh

from ...modules.torques.base import AbstractTorque, as_law, call
from ..data.recordings import Recordings
from ..model.model import Model
from ..windows.schedule import SHORTEST_TURN
from .momentum import Motion, motions, stride_of, terms_of, within

MOST_CHANGE = 0.05  # of the squares of the momentum in a short window, without a cause
SMOOTH = 0.3  # squares of successive differences over those of the values; 2 for white noise
NOTED, FAR_ABOVE = 0.1, 1000.0  # times the gyroscopic torque


def why_no_body_moves_so(model: Model, recordings: Recordings) -> str:
    """Why no rigid body moves as recorded, even in the shortest windows; empty if one may.

    It is the part of the angular momentum that changes there, for the best of all inertias, with
    any steady torque, and with recorded inputs of any size about any axes. Where the change is not
    smooth it may be noise, and nothing is said; nor with a torque law, which a fit may change.
    """
    moving = [] if model.torque is not None else list(motions(model, recordings))
    if not moving:
        return ""
    momenta, changes, causes = [], [], []
    for i, motion in moving:
        momentum, parts = motion.momentum(), motion.parts()
        momenta.append(momentum.reshape(-1, 6))
        changes.append(within(parts, momentum).reshape(-1, 6))
        fields = [term.field for term in terms_of(model, recordings.of(i), motion)]
        fields = np.concatenate([motion.steady(), *fields], axis=3)
        causes.append(within(parts, fields).reshape(len(changes[-1]), -1))
    whole = np.sum([each.T @ each for each in momenta], axis=0)
    change, cause = np.concatenate(changes), np.concatenate(causes)
    change -= cause @ np.linalg.lstsq(cause, change, rcond=None)[0]
    inertia = eigh(change.T @ change, whole + 1e-9 * np.trace(whole) * np.eye(6))[1][:, 0]
    ends = np.cumsum([len(each) for each in changes])[:-1]
    left = [each.reshape(-1, 3) for each in np.split(change @ inertia, ends)]
    parts_left = [
        np.sum(each**2) / max(np.sum((momentum @ inertia) ** 2), 1e-300)
        for each, momentum in zip(left, momenta, strict=True)
    ]
    # One of many trajectories may be no flight.
    usual = float(np.median(parts_left))
    if usual < MOST_CHANGE or not _is_smooth(left):
        return ""
    return (
        "no rigid body moves so unless an unknown torque acts, such as that of a hand: while it "
        f"turns by {SHORTEST_TURN} rad, {np.sqrt(usual):.0%} of its angular momentum changes "
        "without a recorded cause, for any inertia"
    )


def _is_smooth(values: Sequence[np.ndarray]) -> bool:
    """Whether values (n, ...) of trajectories are no noise."""
    differences = sum(np.sum(np.diff(each, axis=0) ** 2) for each in values)
    return bool(differences < SMOOTH * sum(np.sum(each**2) for each in values))


class _Torques(NamedTuple):
    """Torques (n, 3) of one trajectory, N m, body frame, and what they may depend on."""

    residual: np.ndarray
    gyroscopic: np.ndarray
    causes: dict[str, np.ndarray]  # (n, 3, numbers), linear in the numbers


def describe_residual_torque(
    model: Model, recordings: Recordings, inertia: np.ndarray | None = None
) -> str:
    """The size of the torque that a model does not know, and what it goes with; empty if small.

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
        for term in terms_of(model, recordings.of(i), motion):
            momentum = momentum - term.brought()
        left.append(within(motion.parts(), momentum))
        torques.append(_torques(law, motion, momentum, J))
    if not torques or not _is_smooth(left):
        return ""
    residual, gyroscopic = (np.concatenate([each[i] for each in torques]) for i in range(2))
    squares = np.sum(residual**2)
    size = np.sqrt(squares / max(np.sum(gyroscopic**2), 1e-300))
    if size < NOTED:
        return ""
    goes_with = []
    for cause in torques[0].causes:
        columns = np.concatenate([each.causes[cause] for each in torques])
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
    t, R, omega = (each[middle] for each in motion[:3])
    duration = motion.t[stride:] - motion.t[:-stride]
    rate_of_change = (momentum[stride:] - momentum[:-stride]) / duration[:, None]
    residual = np.einsum("nji,nj->ni", R, rate_of_change)
    if law is not None:
        residual = residual - np.asarray(jax.vmap(partial(call, law))(t, R, omega))
    one = np.broadcast_to(np.eye(3), (len(t), 3, 3))
    rates = one[..., None] * omega[:, None, None, :]
    causes = {
        "a constant torque in the body": one,
        "one in space": np.swapaxes(R, 1, 2),
        "the rates": rates.reshape(len(t), 3, 9),
        "time": one * (t - np.mean(t))[:, None, None],
    }
    return _Torques(residual, np.cross(omega, omega @ J), causes)
