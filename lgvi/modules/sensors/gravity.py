"""Whether positions in flight fall as gravity says, or another reading of them does."""

from collections.abc import Iterable, Iterator
from itertools import permutations, product

import numpy as np

MOST_TRAJECTORIES = 200
FEWEST = 4  # positions of a trajectory
CERTAIN = 10.0  # standard errors of an acceleration that is none by chance
WRONG, RIGHT = 0.5, 0.3  # error over gravity, from which a reading is wrong, and up to which right
NO_UNIT = 1.5  # times, up to which positions fall too fast by what the model leaves out
SAME_UNIT = 0.3  # of its logarithm, as air brakes too
# How many times as large the acceleration is in another unit than m and s.
UNITS = {
    "the positions as millimetres": 1e3,
    "the positions as centimetres": 1e2,
    "the positions as inches": 1 / 0.0254,
    "the positions as feet": 1 / 0.3048,
    "the times as milliseconds": 1e-6,
    "the times as microseconds": 1e-12,
    "the times as nanoseconds": 1e-18,
    "the times as minutes": 3600.0,
}


def find_other_reading(
    trajectories: Iterable[tuple[np.ndarray, np.ndarray]], gravity: np.ndarray
) -> tuple[str, float] | None:
    """The reading of times and positions with which they fall as gravity says, if they do not.

    In words, and how many times better it fits, in squares. None if they do, or none fits.
    """
    size, mean = np.linalg.norm(gravity), _mean_acceleration(trajectories)
    if mean is None or not size > 0:
        return None
    fall, spread = mean
    moves = bool(np.linalg.norm(fall) > CERTAIN * spread)  # else positions tell no unit

    def error(fall: np.ndarray, gravity: np.ndarray) -> float:
        return float(np.linalg.norm(fall - gravity) / size)

    costs = {words: error(*each) for words, each in _readings(fall, gravity, moves)}
    as_is, words = error(fall, gravity), min(costs, key=lambda each: costs[each])
    if as_is < WRONG or costs[words] > RIGHT:
        return None
    return words, (as_is / max(costs[words], 1e-6)) ** 2


def _mean_acceleration(
    trajectories: Iterable[tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, float] | None:
    """By parabolas, with its standard error; long flights count most, as they tell most."""
    total, weights, squares = np.zeros(3), 0.0, 0.0
    for i, (t, position) in enumerate(trajectories):
        if i == MOST_TRAJECTORIES:
            break
        if len(t) < FEWEST:
            continue
        duration = t[-1] - t[0]
        powers = np.vander((t - t[0]) / duration, 3)
        weight = len(t) * duration**4
        parabola = np.linalg.lstsq(powers, position, rcond=None)[0]
        left = np.sum((position - powers @ parabola) ** 2) / (len(t) - 3)
        total += weight * 2 * parabola[0] / duration**2
        weights += weight
        squares += (weight * 2 / duration**2) ** 2 * left * np.linalg.inv(powers.T @ powers)[0, 0]
    return (total / weights, float(np.sqrt(squares)) / weights) if weights > 0 else None


def _readings(
    fall: np.ndarray, gravity: np.ndarray, moves: bool
) -> Iterator[tuple[str, tuple[np.ndarray, np.ndarray]]]:
    """Other readings in words, with the acceleration and the gravity that they would have."""
    factor = float(fall @ gravity) / float(gravity @ gravity)
    if moves and factor > 0 and not 1 / NO_UNIT < factor < NO_UNIT:
        off = {words: abs(np.log(factor / size)) for words, size in UNITS.items()}
        words = min(off, key=lambda unit: off[unit])
        if off[words] > SAME_UNIT:
            words = (
                f"the positions {factor:.3g} times too large, or the times {factor**-0.5:.3g} "
                "times too large"
            )
        yield words, (fall / factor, gravity)
    for axes in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            other = np.array(signs) * gravity[list(axes)]
            text = ", ".join(f"{x + 0:.4g}" for x in other)
            yield f"`gravity` as ({text})", (fall, other)
