"""Usual mistakes of a log, tried on the recordings: units, frames, signs, rotors and inputs."""

from collections.abc import Container, Iterator, Sequence
from itertools import combinations, islice, permutations, product
from typing import NamedTuple

import equinox as eqx
import numpy as np
from scipy.linalg import eigh
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from ...modules.sensors.accelerometer import Accelerometer
from ...modules.units import STANDARD_GRAVITY
from ..data.formats import INPUTS
from ..data.recordings import Recordings
from ..model.model import Model
from .momentum import (
    TURN,
    Motion,
    Term,
    momentum_by_entries,
    motions,
    terms_of,
    turn_between,
    with_rates,
    within,
)

BETTER = 10.0  # ratio of squares, at least, from the log as it is to another reading
ALIKE = 1.001  # ratio of squares, at most, of readings between which nothing decides
RIGHT = 1e-4  # squares that a log leaves, at most, if it is right as it is
ROUNDING = 1e-12  # squares that are rounding
FITS = 0.1  # squares that another reading leaves, at most, as a part of those of the rates
MOST_TURN = 1.5  # rad, from sample to sample
STEADY = 10.0  # rad, a turn in which the angular momentum is about constant
MOST_PAIRS = 2000  # of each trajectory
MOST_TRAJECTORIES = 20  # with `MOST_PAIRS` pairs; more if trajectories are short
AXES = "xyz"
MOST_NAMED = 4  # readings that fit alike
NO_UNIT = 1.5  # ratio of rates, at most, that an error of their scale explains
SAME_UNIT = 0.02  # error of the logarithm of a ratio of units, at most
# Ratio of a number in another unit to the number in rad/s, or in s.
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
# Ratio of the numbers of a log to those of the right unit, by the right reading.
UNITS = {f"the rates as {unit}": size for unit, size in UNITS_OF_RATES.items()} | {
    f"the times as {unit}": size for unit, size in UNITS_OF_TIMES.items()
}
TAKEN_FOR = {
    f"the rates, taken for {unit}, as radians per second": 1 / size
    for unit, size in UNITS_OF_RATES.items()
    if not unit.startswith("counts")
} | {f"the times, taken for {unit}, as seconds": 1 / size for unit, size in UNITS_OF_TIMES.items()}
# Ratio of a reading, in another unit or of a body with another mass, to the reading in m/s².
UNITS_OF_FORCES = {
    "the specific forces in g": 1 / STANDARD_GRAVITY,
    "the specific forces in mg": 1e3 / STANDARD_GRAVITY,
    "the specific forces with opposite signs": -1.0,
    "the specific forces in g and with opposite signs": -1 / STANDARD_GRAVITY,
    "the mass in grams": 1e3,
}
NEAR = 2.5  # ratio of readings, at most, that an error of the mass explains
ALONG = 0.8  # cosine of the angle, at least, between readings and thrust in all
MOST_PERMUTED = 6  # rotors in any order; of more rotors only pairs are exchanged
# Factors on the lag of the model, for all readings; then on the best lag, for the shortlist.
LAGS = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8), (0.8, 0.9, 1.0, 1.1, 1.25)
SHORTLIST = 10  # readings that fit best
ROUNDING_OF_COLUMN = 1e-6  # part of a column that is rounding
SUSPECT = 0.02  # part of the squares that the log leaves, above which other units are tried
# Directions (13, 3) of the first parts of mass of an inertia.
DIRECTIONS = np.array([d for d in product((0, 1, -1), repeat=3) if d > (0, 0, 0)], float)
MOST_ROUNDS, ENOUGH = 10, 0.9  # rounds that add directions; ratio of squares at which they end
BETTER_INPUT = 2.0  # as `BETTER`, for inputs
ALIKE_INPUTS = 2.0  # as `ALIKE`, for inputs, between which little decides
# As above for rates alone: a bias or a torque is no mistake, and rates that are too large are those
# of another body.
BETTER_RATES, ALIKE_RATES, RIGHT_RATES = 300.0, 3.0, 3e-3


class Mistake(NamedTuple):
    """Another reading of a log, which fits better than the log as it is."""

    reading: str  # in words
    better: float  # ratio of the squares

    def __str__(self) -> str:
        return f"reading {self.reading} fits {self.better:.3g} times better"


class _Pairs(NamedTuple):
    """Pairs of attitudes of one trajectory, and the mean rates between them."""

    first: np.ndarray  # (n, 3, 3)
    second: np.ndarray  # (n, 3, 3)
    duration: np.ndarray  # (n,)
    rates: np.ndarray | None  # (n, 3), as read
    turn: float  # rad, from one pair to the next


def find_mistake(model: Model, recordings: Recordings) -> Mistake | None:
    """The reading that fits best, if it fits much better than the log as it is."""
    pairs = [pair for pair in _pairs(model, recordings) if len(pair.duration) > 6]
    if pairs:
        # Attitudes alone do not tell quaternions with the scalar last from space to body.
        return best_reading(_costs(pairs), BETTER, ALIKE)
    if model.torque is None and not any(name in recordings.quantities for name in INPUTS):
        moving = [motion for _, motion in motions(model, recordings)]
        if moving and all(motion.is_integrated for motion in moving):
            costs = {"": _change_with_unit(moving, 1.0)}
            if costs[""] > RIGHT_RATES:
                units = {**UNITS, **TAKEN_FOR}.items()
                costs |= {
                    words: _change_with_unit(moving, size) for words, size in units if size < 1
                }
                return best_reading(costs, BETTER_RATES, ALIKE_RATES)
    return None


def best_reading(costs: dict[str, float], better: float, alike: float) -> Mistake | None:
    """The best of other readings, by the squares that each leaves, if much better than the log.

    Readings that leave at most `alike` times the squares of the best are named too.
    """
    others = {words: cost for words, cost in costs.items() if words}
    as_is, least = costs[""], max(min(others.values()), ROUNDING)
    if as_is <= max(better * least, RIGHT) or least >= FITS or not np.isfinite(as_is):
        return None
    best = [words for words in others if others[words] <= alike * least]
    best.sort(key=lambda words: others[words])
    if len(best) > MOST_NAMED:
        best[MOST_NAMED:] = ["another"]
    return Mistake(" or ".join(best), as_is / least)


def _pairs(model: Model, recordings: Recordings) -> Iterator[_Pairs]:
    attitudes = rates = None
    for channel, sensor in model.sensors.items():
        samples = recordings.channels[channel]
        if not samples.count.any():
            continue
        attitude, omega = sensor.guess_state(samples.of(int(np.argmax(samples.count > 0)))[1])
        if attitude is not None and attitudes is None:
            attitudes = samples, sensor
        if omega is not None and rates is None:
            rates = samples, sensor
    if attitudes is None:
        return
    samples, sensor = attitudes
    pairs = np.sum(np.minimum(samples.count, MOST_PAIRS))
    spacing = -(-int(pairs) // (MOST_TRAJECTORIES * MOST_PAIRS)) or 1
    # Methods of modules are bound once, which takes longer than their work.
    samples_of, guess = samples.of, sensor.guess_state
    for i in range(0, len(recordings), spacing):
        t, readings = samples_of(i)
        if len(t) < 3:
            continue
        R, _ = guess(readings)
        step = max(1, len(t) // MOST_PAIRS)
        turns = turn_between(R[:-1:step], R[1::step])
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
        step = max(1, len(first) // MOST_PAIRS)
        first = first[::step]
        yield _Pairs(
            R[first],
            R[first + stride],
            (t[first + stride] - t[first]) * float(model.time_scale),
            None if mean is None else mean[::step],
            step * turn,
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
    """Attitudes of quaternions whose scalar is last, but was read as first."""
    return Rotation.from_quat(Rotation.from_matrix(R).as_quat(scalar_first=True)).as_matrix()


def _scalar_first(R: np.ndarray) -> np.ndarray:
    """Attitudes of quaternions whose scalar is first, but was read as last."""
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


def _costs(pairs: list[_Pairs]) -> dict[str, float]:
    """The squares that each reading leaves, as parts of the squares of the rates.

    Two mistakes at once are tried where no single one explains the log.
    """
    has_rates = pairs[0].rates is not None
    first, second = (np.concatenate(ends) for ends in zip(*(p[:2] for p in pairs), strict=True))
    duration = np.concatenate([pair.duration for pair in pairs])[:, None]
    costs, seen = {}, {}
    for words, reading in READINGS_OF_ATTITUDES.items():
        begin, end = reading(first), reading(second)
        turn = turn_between(begin, end)
        seen[words] = turn / duration
        if not has_rates:
            middle = begin @ Rotation.from_rotvec(turn / 2).as_matrix()
            momentum = momentum_by_entries(middle, seen[words])
            costs[words] = _change_of_momentum(pairs, momentum)
    if not has_rates:
        return costs
    read = np.concatenate([pair.rates for pair in pairs if pair.rates is not None])
    costs = {words: _difference(read, rates) for words, rates in seen.items()}
    one, two = _other_rates(read, seen.pop(""))
    costs |= one
    if min(costs.values()) > FITS:
        costs |= two
        for words, rates in seen.items():
            one, _ = _other_rates(read, rates)
            costs |= {f"{words} and {of_rates}": cost for of_rates, cost in one.items()}
    return costs


def _difference(read: np.ndarray, seen: np.ndarray) -> float:
    return float(np.sum((read - seen) ** 2) / np.sum(seen**2))


def _other_rates(read: np.ndarray, seen: np.ndarray) -> tuple[dict[str, float], dict[str, float]]:
    """The squares that the rates leave with other axes or in another unit, and with both."""

    def in_unit(rates: np.ndarray, before: str = "") -> dict[str, float]:
        factor = float(np.sum(rates**2) / max(np.sum(rates * seen), 1e-300))
        if 1 / NO_UNIT < factor < NO_UNIT:
            return {}
        return {before + _unit_words(factor): _difference(rates / factor, seen)}

    axes, signs = _best_axes(read.T @ seen)
    exchanged = np.array(signs) * read[:, axes]
    words = f"the axes of the rates as {name_axes(axes, signs)}"
    one = in_unit(read) | {words: _difference(exchanged, seen)}
    return one, in_unit(exchanged, f"{words} and ")


def _change_with_unit(moving: list[Motion], size: float) -> float:
    """The part of the angular momentum that changes, where the rates are `size` times too large."""
    scaled = [with_rates(motion, 1 / size) for motion in moving]
    momenta = [motion.momentum() for motion in scaled]
    changes = [within(motion.parts(), m) for motion, m in zip(scaled, momenta, strict=True)]
    return _least_part(np.concatenate(changes), np.concatenate(momenta))


def _unit_words(factor: float) -> str:
    """The units that may explain the ratio of the rates to those of attitudes and times."""
    pairs = {
        f"the rates as {a} and the times as {b}": x * y
        for a, x in UNITS_OF_RATES.items()
        for b, y in UNITS_OF_TIMES.items()
    }
    for units in (UNITS, TAKEN_FOR, pairs):  # one mistake is more likely than two
        off = {words: abs(np.log(factor / size)) for words, size in units.items()}
        nearest = min(off.values())
        if nearest < SAME_UNIT:
            return " or ".join(words for words, ratio in off.items() if ratio == nearest)
    return f"the rates, or the times, {factor:.3g} times too large"


def _best_axes(products: np.ndarray) -> tuple[list[int], tuple[int, ...]]:
    """The signed exchange of axes, other than the identity, that fits the `products` (3, 3)."""
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
    """The part of the angular momentum (pairs, 3, 6) that changes, least of all inertias."""
    parts, begin = [], 0
    for pair in pairs:
        number, length = len(pair.duration), max(4, int(STEADY / pair.turn))
        pieces = max(1, number // length)
        parts += [begin + number * k // pieces for k in range(pieces)]
        begin += number
    counts = np.diff([*parts, begin])
    mean = np.add.reduceat(momentum, parts) / counts[:, None, None]
    return _least_part(momentum - np.repeat(mean, counts, axis=0), momentum)


def _least_part(change: np.ndarray, momentum: np.ndarray) -> float:
    """The part of the squares of the momentum (n, 3, 6) that changes, least of all inertias."""
    change, total = (np.einsum("nik,nil->kl", momenta, momenta) for momenta in (change, momentum))
    size = np.trace(total) / 6
    return float(eigh(change, total + 1e-9 * size * np.eye(6), eigvals_only=True)[0])


def find_other_force(model: Model, recordings: Recordings) -> Mistake | None:
    """The unit, or the sign, with which an accelerometer feels the thrust of the rotors.

    The mass may be a guess, so that only factors far from one are mistakes.
    """
    if model.rotors is None or model.mass is None or recordings.rotor_speed is None:
        return None
    rotors, mass = model.rotors, float(model.mass)
    axes = np.asarray(rotors.axes, float)
    axes = axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    directions = np.broadcast_to(axes, (len(rotors.arms), 3)) / mass
    thrust, products = np.asarray(rotors.thrust, float), np.zeros(3)
    for channel, sensor in model.sensors.items():
        if not isinstance(sensor, Accelerometer) or sensor.gravity is not None:
            continue
        for trajectory in islice(recordings, MOST_TRAJECTORIES):
            (t, read), (times, speeds) = trajectory[channel], trajectory["rotor_speed"]
            at = np.stack([np.interp(t, times, column) for column in speeds.T], axis=1)
            felt, read = (thrust * at**2) @ directions, sensor.correct(read)
            products += np.sum(felt * felt), np.sum(felt * read), np.sum(read * read)
    of_thrust, of_both, of_readings = products
    if not abs(of_both) > ALONG * np.sqrt(of_thrust * of_readings):
        return None
    factor = of_both / of_thrust

    def squares(unit: float) -> float:
        return float((of_thrust - 2 * of_both / unit + of_readings / unit**2) / of_thrust)

    for words, unit in UNITS_OF_FORCES.items():
        if 1 / NEAR < factor / unit < NEAR:
            return Mistake(words, squares(1.0) / squares(unit))
    return None


def entries_of(directions: np.ndarray) -> np.ndarray:
    """The entries xx, yy, zz, xy, xz, yz of the inertia (6, n) of mass in directions (n, 3)."""
    x, y, z = directions.T
    return np.stack([y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z])


class _Exchange(NamedTuple):
    """Numbers in another order and with other signs: number i was at place `order[i]`."""

    order: tuple[int, ...]
    signs: tuple[int, ...]

    @property
    def matrix(self) -> np.ndarray:
        """The matrix that multiplies the numbers."""
        return np.array(self.signs)[:, None] * np.eye(len(self.order))[list(self.order)]


EXCHANGES_OF_AXES = [
    _Exchange(order, signs)
    for order in permutations(range(3))
    for signs in product((1, -1), repeat=3)
]


class _Other(NamedTuple):
    """Another reading of an input."""

    words: str  # empty for the input as it is
    term: str  # name of the input
    turn: np.ndarray  # (3, 3), rotation of the input's effect in the body
    columns: np.ndarray  # (columns, columns), factor on the columns of the input
    rates: float = 1.0  # factor on the rates that were read; -1 where axes are mirrored
    spin: int = 1  # -1 where the senses of rotation are opposite


class _Balance(NamedTuple):
    """The balance of all trajectories, with columns for entries of the inertia and for terms."""

    terms: list[Term]
    rows: np.ndarray  # (rows, columns), a triangle with the scalar products of the columns

    def cost(self, other: _Other, rounds: int) -> float:
        """The squares that the best inertia leaves, as a part of the squares of known inputs.

        An inertia is made of parts of mass in some directions. Each round adds the directions that
        lower the squares most.
        """
        known, factors = self._in_columns(other)
        squares, masses = max(float(known @ known), 1e-300), DIRECTIONS
        cost = np.inf
        for _ in range(rounds):
            columns = np.hstack([self.rows[:, :6] @ entries_of(masses), *factors])
            columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
            try:
                amounts, left = nnls(columns, known)
            except RuntimeError:  # it does not converge
                return cost
            before, cost = cost, float(left**2 / squares)
            if cost > ENOUGH * before:
                break
            xx, yy, zz, xy, xz, yz = (known - columns @ amounts) @ self.rows[:, :6]
            gain = np.array([[yy + zz, -xy, -xz], [0, xx + zz, -yz], [0, 0, xx + yy]])
            in_use = masses[amounts[: len(masses)] > 0]
            masses = np.concatenate([in_use, np.linalg.eigh((gain + gain.T) / 2)[1].T])
        return cost

    def _in_columns(self, other: _Other) -> tuple[np.ndarray, list[np.ndarray]]:
        """The effects of known inputs (rows,), and minus that of each other input (rows, 1)."""
        known, factors, first = np.zeros(len(self.rows)), [], 6
        for term in self.terms:
            weights, sense = term.weights, 1
            if term.name == other.term:
                weights, sense = other.turn @ weights @ other.columns, other.spin
            brought = self.rows[:, first : first + weights.size] @ weights.ravel()
            first += weights.size
            if term.is_known:
                known = known + brought
            else:
                factors.append(-sense * brought[:, None])
        return known, factors


def find_other_input(model: Model, recordings: Recordings) -> Mistake | None:
    """The reading of a recorded input that fits best, if much better than the log as it is.

    There is none where a torque law acts, which would have to be fitted too.
    """
    inputs = [name for name in INPUTS if getattr(recordings, name) is not None]
    if not inputs or model.torque is not None:
        return None
    if "rotor_speed" in inputs and model.rotors is None:
        return None
    moving = list(motions(model, recordings))
    if not moving:
        return None
    by_factor = {1.0: moving}  # by their factor
    are_read = all(motion.is_integrated for _, motion in moving)
    if "rotor_speed" in inputs and are_read:
        by_factor[-1.0] = _with_rates(moving, -1.0)
    readings = list(_others(terms_of(model, recordings[moving[0][0]], moving[0][1]), by_factor))
    model, lag, costs = _without_zeros(model), 1.0, {}
    for lags, rounds in zip(LAGS, (1, MOST_ROUNDS), strict=True):
        costs = dict.fromkeys((other.words for other in readings), np.inf)
        least, around = np.inf, lag
        for times in lags if model.rotors is not None and model.rotors.lag is not None else (1.0,):
            lagged = _with_lag(model, around * times)
            balances = {
                factor: _balance(lagged, recordings, scaled) for factor, scaled in by_factor.items()
            }
            for other in readings:
                cost = balances[other.rates].cost(other, rounds)
                costs[other.words] = min(cost, costs[other.words])
            if min(costs.values()) < least:
                lag, least = around * times, min(costs.values())
        as_it_is, *others = readings
        readings = [as_it_is, *sorted(others, key=lambda other: costs[other.words])[:SHORTLIST]]
        if rounds == 1 and costs[""] > SUSPECT and are_read:
            units = _units()
            readings += units
            by_factor |= {unit.rates: _with_rates(moving, unit.rates) for unit in units}
    return best_reading(costs, BETTER_INPUT, ALIKE_INPUTS)


def _with_rates(moving: Sequence[tuple[int, Motion]], factor: float) -> list[tuple[int, Motion]]:
    return [(i, with_rates(motion, factor)) for i, motion in moving]


def _units() -> list[_Other]:
    """Rates, or times, in other units, which change the motion by the size of the inertia alone."""
    as_it_is = "", np.eye(3), np.eye(1)
    return [_Other(words, *as_it_is, rates=1 / size) for words, size in UNITS.items() if size > 1]


def _without_zeros(model: Model) -> Model:
    """The model with rotors whose drag and inertia are one where they are zero."""
    if model.rotors is None:
        return model
    coefficients = model.rotors.drag, model.rotors.inertia
    coefficients = [value if np.any(value) else np.ones_like(value) for value in coefficients]
    return eqx.tree_at(lambda m: (m.rotors.drag, m.rotors.inertia), model, coefficients)


def _with_lag(model: Model, times: float) -> Model:
    if model.rotors is None or model.rotors.lag is None:
        return model
    return eqx.tree_at(lambda m: m.rotors.lag, model, times * model.rotors.lag)


def _balance(
    model: Model, recordings: Recordings, moving: Sequence[tuple[int, Motion]]
) -> _Balance:
    """The balance without a steady torque, such as that of rotors that differ a little."""
    columns: list[np.ndarray] = []
    terms: list[Term] = []
    for i, motion in moving:
        terms = terms_of(model, recordings[i], motion)
        fields = [motion.steady(), motion.momentum(), *(term.field for term in terms)]
        flat = [field.reshape(*field.shape[:2], -1) for field in fields]
        changes = within(motion.parts(), np.concatenate(flat, axis=2))
        columns.append(changes.reshape(-1, changes.shape[2]))
    steady, rows = np.split(np.concatenate(columns), [3], axis=1)
    sizes = np.linalg.norm(rows, axis=0)
    rows = rows - steady @ np.linalg.lstsq(steady, rows, rcond=None)[0]
    rows[:, np.linalg.norm(rows, axis=0) <= ROUNDING_OF_COLUMN * sizes] = 0  # a steady input
    return _Balance(terms, np.asarray(np.linalg.qr(rows, "r")))


def _others(terms: Sequence[Term], factors: Container[float]) -> Iterator[_Other]:
    """All readings; the first is the log as it is."""
    shapes = {term.name: term.weights.shape[1] for term in terms}
    yield _Other("", "", np.eye(3), np.eye(1))
    for name, count in shapes.items():
        as_it_is = np.eye(count)
        if count == 1 and name != "rotor_speed":
            yield _Other(f"`{name}` with the other sign", name, np.eye(3), -as_it_is)
            continue
        if name != "rotor_speed":
            for exchange in EXCHANGES_OF_AXES:
                words = f"the axes of `{name}` as {name_axes(*exchange)}"
                if not np.array_equal(exchange.matrix, as_it_is):
                    yield _Other(words, name, np.eye(3), exchange.matrix)
            continue
        yield _Other("the `spin` reversed", name, np.eye(3), as_it_is, spin=-1)
        for order in _orders(count):
            words = f"`{name}` as `{name}[:, {list(order)}]`"
            yield _Other(words, name, np.eye(3), as_it_is[list(order)])
        for exchange in EXCHANGES_OF_AXES:
            S = exchange.matrix
            rates = float(np.sign(np.linalg.det(S)))
            words = f"the axes of the sensors as {name_axes(*exchange)}"
            if not np.array_equal(S, np.eye(3)) and rates in factors:
                turn = rates * S.T
                yield _Other(words, name, turn, as_it_is, rates)


def _orders(count: int) -> Iterator[tuple[int, ...]]:
    as_it_is = tuple(range(count))
    if count <= MOST_PERMUTED:
        yield from (order for order in permutations(as_it_is) if order != as_it_is)
        return
    for i, j in combinations(as_it_is, 2):
        yield tuple({i: j, j: i}.get(k, k) for k in as_it_is)
