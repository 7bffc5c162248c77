"""How bodies turned, as recorded and as fitted, for a view of them."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..identification import FittedPart
from .view import Motion

TURN = 0.05  # rad from frame to frame, about
RECORDED, FITTED = "recorded", "fitted"


def motions_of(
    part: FittedPart, trajectories: list[int], names: list[str], body: int, most: int
) -> list[Motion]:
    """Motions of some trajectories of a part, where a sensor tells attitudes or rates.

    Where no sensor tells attitudes, there is the fitted motion alone, from the fitted rates.

    Parameters
    ----------
    part
        The part.
    trajectories, names
        Numbers of the trajectories, and their names in the view.
    body
        The number of the part's body in the view.
    most
        Frames of a motion, at most.
    """
    predicted = {
        channel: part.recordings.channels[channel].split(values)
        for channel, values in part.predicted.items()
    }
    motions = []
    for i, name in zip(trajectories, names, strict=True):
        sensors = _sensors_of(part, i)
        found = None
        for channel, sensor in sensors.items():
            t, readings = part.recordings.channels[channel].of(i)
            fitted = predicted[channel][i]
            if len(t) < 2 or not np.all(np.isfinite(fitted)):
                continue
            (R, _), (R_fitted, rates) = sensor.guess_state(readings), sensor.guess_state(fitted)
            if R is not None and R_fitted is not None:
                found = t, {RECORDED: np.asarray(R), FITTED: np.asarray(R_fitted)}
                break
            if rates is not None and found is None:
                intervals = float(part.model.time_scale) * np.diff(t)[:, None]
                turns = intervals * (rates[:-1] + rates[1:]) / 2
                start = np.asarray(part.states.R[i], float)
                found = t, {FITTED: follow_rates(start, turns)}
        if found is not None:
            motions.append(_with_few_frames(name, body, *found, most))
    return motions


def evenly(count: int, most: int) -> np.ndarray:
    """The numbers of some of `count` things, evenly chosen, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _sensors_of(part: FittedPart, i: int) -> dict:
    """The sensors of a part with the leaves that a trajectory has of its own."""
    if part.own is None:
        return part.model.sensors
    own = jax.tree.map(lambda leaf: np.asarray(leaf[i]), part.own)
    return eqx.combine(own, part.model).sensors


def follow_rates(
    start: Float[np.ndarray, "3 3"], turns: Float[np.ndarray, "steps 3"]
) -> Float[np.ndarray, "times 3 3"]:
    """Attitudes from the first one, and small turns one after another, body frame, rad."""
    R = np.concatenate([start[None], Rotation.from_rotvec(turns).as_matrix()])
    step = 1
    while step < len(R):  # products of twice as many in each round
        R[step:] = R[:-step] @ R[step:]
        step *= 2
    return R


def _with_few_frames(
    name: str, body: int, t: np.ndarray, attitudes: dict[str, np.ndarray], most: int
) -> Motion:
    """A motion with as many frames as its turns need."""
    R = attitudes[FITTED]
    turn = np.sum(Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).magnitude())
    shown = evenly(len(t), int(min(max(turn / TURN, 30), most)))
    chosen = {label: R[shown] for label, R in attitudes.items()}
    return Motion(name, body, t[shown] - t[0], np.arange(len(shown)), chosen)
