r"""The usual mistakes of a log, tried on the recordings themselves.

Attitudes and rates go together by kinematics: $\operatorname{Log}(R_i^TR_j)/(t_j - t_i)$ is about
the mean rate. Attitudes alone go together by the angular momentum, $R J\omega$, which is about
constant for a while for some inertia $J$.
"""

from collections.abc import Iterator, Sequence
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from ..data.recordings import Recordings
from ..model.model import Model
from .momentum import TURN, momentum_by_entries, turn_between

BETTER = 10.0  # times, in squares, that another reading fits
ALIKE = 1.001  # times, that readings fit between which nothing decides
RIGHT = 1e-4  # squares up to which a log is right as it is
ROUNDING = 1e-12  # squares that are rounding
FITS = 0.1  # squares that it leaves at most, of those of the rates
MOST_TURN = 1.5  # rad, from sample to sample
STEADY = 10.0  # rad, in which the angular momentum is about constant
MOST_PAIRS = 2000  # of each trajectory
MOST_TRAJECTORIES = 20  # with so many pairs; more if they are short
AXES = "xyz"
MOST_NAMED = 4  # readings that fit alike
NO_UNIT = 1.5  # times, up to which rates are too large by an error of their scale
SAME_UNIT = 0.02  # of its logarithm, for the error of the scale
# How many times as large numbers are that have another unit than rad/s and s.
UNITS_OF_RATES = {
    "degrees per second": 180 / np.pi,
    "revolutions per minute": 30 / np.pi,
    "revolutions per second": 0.5 / np.pi,
    "milliradians per second": 1e3,
} | {  # of usual gyroscopes, whose ranges are 250 to 2000 degrees per second
    f"counts of {counts:g} for each degree per second": counts * 180 / np.pi
    for counts in (131, 65.5, 32.8, 16.4)
}
UNITS_OF_TIMES = {
    "milliseconds": 1e3,
    "microseconds": 1e6,
    "nanoseconds": 1e9,
    "minutes": 1 / 60,
}


class Mistake(NamedTuple):
    """Another reading of a log, which fits better."""

    reading: str  # in words
    better: float  # times


class _Pairs(NamedTuple):
    """Pairs of attitudes of one trajectory, and the mean rates between them."""

    first: np.ndarray  # (n, 3, 3)
    second: np.ndarray  # (n, 3, 3)
    duration: np.ndarray  # (n,)
    rates: np.ndarray | None  # (n, 3), as read
    turn: float  # rad, from one pair to the next


def find_mistake(model: Model, recordings: Recordings) -> Mistake | None:
    """The reading that fits best, if it fits much better than the log as it is."""
    pairs = [each for each in _pairs(model, recordings) if len(each.duration) > 6]
    if not pairs:
        return None
    # Attitudes alone do not tell quaternions with the scalar last from space to body.
    return best_reading(dict(_costs(pairs)), BETTER, ALIKE)


def best_reading(costs: dict[str, float], better: float, alike: float) -> Mistake | None:
    """The best of other readings, by the squares that each leaves, if much better than as it is.

    Those that leave so many times as much as the best at most are told too.
    """
    others = {words: cost for words, cost in costs.items() if words}
    as_is, least = costs[""], max(min(others.values()), ROUNDING)
    if as_is <= max(better * least, RIGHT) or least >= FITS or not np.isfinite(as_is):
        return None
    best = [words for words in others if others[words] <= alike * least]
    best.sort(key=lambda words: others[words])
    if len(best) > MOST_NAMED:
        best[MOST_NAMED:] = [f"one of {len(best) - MOST_NAMED} others"]
    return Mistake(" or ".join(best), as_is / least)


def _pairs(model: Model, recordings: Recordings) -> Iterator[_Pairs]:
    attitudes = rates = None
    for channel, sensor in model.sensors.items():
        samples = recordings.channels[channel]
        if not samples.count.any():
            continue
        R, omega = sensor.guess_state(samples.of(int(np.argmax(samples.count > 0)))[1])
        if R is not None and attitudes is None:
            attitudes = samples, sensor
        if omega is not None and rates is None:
            rates = samples, sensor
    if attitudes is None:
        return
    samples, sensor = attitudes
    pairs = np.sum(np.minimum(samples.count, MOST_PAIRS))
    spacing = -(-int(pairs) // (MOST_TRAJECTORIES * MOST_PAIRS)) or 1
    # Methods of modules are bound once: that takes longer than what they do.
    of, guess = samples.of, sensor.guess_state
    for i in range(0, len(recordings), spacing):
        t, readings = of(i)
        if len(t) < 3:
            continue
        of_trajectory, _ = guess(readings)
        every = max(1, len(t) // MOST_PAIRS)
        turns = turn_between(of_trajectory[:-1:every], of_trajectory[1::every])
        turn = np.median(np.linalg.norm(turns, axis=1))
        if not 0 < turn < MOST_TURN:
            continue
        stride = max(1, min(int(TURN / turn), len(t) // 2))
        first = np.arange(len(t) - stride)
        mean = None
        if rates is not None:
            when, readings = rates[0].of(i)
            if len(when) < 2:
                continue
            _, read = rates[1].guess_state(readings)
            first = first[(t[first] >= when[0]) & (t[first + stride] <= when[-1])]
            mean = _means(when, read, t[first], t[first + stride])
        every = max(1, len(first) // MOST_PAIRS)
        first = first[::every]
        yield _Pairs(
            of_trajectory[first],
            of_trajectory[first + stride],
            (t[first + stride] - t[first]) * float(model.time_scale),
            None if mean is None else mean[::every],
            every * turn,
        )


def _means(t: np.ndarray, values: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The means of values (samples, 3), linear between the samples, from times to times."""
    steps = np.diff(t)[:, None] * (values[1:] + values[:-1]) / 2
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def at(times: np.ndarray) -> np.ndarray:
        i = np.clip(np.searchsorted(t, times, "right") - 1, 0, len(t) - 2)
        since = (times - t[i])[:, None]
        slope = (values[i + 1] - values[i]) / np.diff(t)[i, None]
        return integral[i] + since * (values[i] + since * slope / 2)

    return (at(end) - at(begin)) / (end - begin)[:, None]


def _scalar_last(R: np.ndarray) -> np.ndarray:
    """Attitudes of quaternions whose scalar is last, though it was read as first."""
    return Rotation.from_quat(Rotation.from_matrix(R).as_quat(scalar_first=True)).as_matrix()


def _scalar_first(R: np.ndarray) -> np.ndarray:
    """Attitudes of quaternions whose scalar is first, though it was read as last."""
    return Rotation.from_quat(Rotation.from_matrix(R).as_quat(), scalar_first=True).as_matrix()


READINGS_OF_ATTITUDES = {
    "": lambda R: R,
    "the quaternions scalar-last": _scalar_last,
    "the quaternions scalar-first": _scalar_first,
    "the attitudes as space to body": lambda R: np.swapaxes(R, 1, 2),
    "the quaternions scalar-last and as space to body": lambda R: np.swapaxes(
        _scalar_last(R), 1, 2
    ),
}


def _costs(pairs: list[_Pairs]) -> Iterator[tuple[str, float]]:
    """The squares that each reading leaves, as parts of those of the rates."""
    together = pairs[0].rates is not None
    first, second = (np.concatenate(ends) for ends in zip(*(p[:2] for p in pairs), strict=True))
    duration = np.concatenate([each.duration for each in pairs])[:, None]
    for words, reading in READINGS_OF_ATTITUDES.items():
        begin, end = reading(first), reading(second)
        turn = turn_between(begin, end)
        seen = turn / duration
        if not together:
            middle = begin @ Rotation.from_rotvec(turn / 2).as_matrix()
            yield words, _change_of_momentum(pairs, momentum_by_entries(middle, seen))
            continue
        read = np.concatenate([each.rates for each in pairs if each.rates is not None])

        def cost(read: np.ndarray, seen: np.ndarray) -> float:
            return float(np.sum((read - seen) ** 2) / np.sum(seen**2))

        yield words, cost(read, seen)
        if not words:
            factor = float(np.sum(read**2) / max(np.sum(read * seen), 1e-300))
            if not 1 / NO_UNIT < factor < NO_UNIT:
                yield _unit_words(factor), cost(read / factor, seen)
            axes, signs = _best_axes(read.T @ seen)
            yield (
                f"the axes of the rates as {name_axes(axes, signs)}",
                cost(np.array(signs) * read[:, axes], seen),
            )


def _unit_words(factor: float) -> str:
    """What could be why rates are so many times as large as attitudes and times say."""
    rates = {f"the rates as {unit}": size for unit, size in UNITS_OF_RATES.items()}
    times = {f"the times as {unit}": size for unit, size in UNITS_OF_TIMES.items()}
    both = {f"{a} and {b}": x * y for a, x in rates.items() for b, y in times.items()}
    for units in (rates | times, both):  # one mistake is more likely than two
        off = {words: abs(np.log(factor / size)) for words, size in units.items()}
        nearest = min(off.values())
        if nearest < SAME_UNIT:
            return " or ".join(words for words, by in off.items() if by == nearest)
    return f"the rates, or the times, {factor:.3g} times too large"


def _best_axes(products: np.ndarray) -> tuple[list[int], tuple[int, ...]]:
    """The signed exchange of axes that fits best, but for none; `products` are of axes (3, 3)."""
    exchanges = [
        (list(axes), signs)
        for axes in permutations(range(3))
        for signs in product((1, -1), repeat=3)
        if (axes, signs) != ((0, 1, 2), (1, 1, 1))
    ]

    def fit(exchange: tuple[list[int], tuple[int, ...]]) -> float:
        axes, signs = exchange
        return float(np.sum(np.array(signs) * products[axes, range(3)]))

    return max(exchanges, key=fit)


def name_axes(axes: Sequence[int], signs: Sequence[int]) -> str:
    """Such as `(x, -y, z)`."""
    named = [("-" if sign < 0 else "") + AXES[axis] for axis, sign in zip(axes, signs, strict=True)]
    return f"({', '.join(named)})"


def _change_of_momentum(pairs: list[_Pairs], momentum: np.ndarray) -> float:
    """The least part of the angular momentum (pairs, 3, 6) that changes, for any inertia."""
    parts, begin = [], 0
    for pair in pairs:
        number, length = len(pair.duration), max(4, int(STEADY / pair.turn))
        pieces = max(1, number // length)
        parts += [begin + number * k // pieces for k in range(pieces)]
        begin += number
    counts = np.diff([*parts, begin])
    mean = np.add.reduceat(momentum, parts) / counts[:, None, None]
    off = momentum - np.repeat(mean, counts, axis=0)
    change, whole = (np.einsum("nik,nil->kl", each, each) for each in (off, momentum))
    size = np.trace(whole) / 6
    return float(eigh(change, whole + 1e-9 * size * np.eye(6), eigvals_only=True)[0])
