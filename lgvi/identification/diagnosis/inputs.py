r"""Recorded inputs in another order or with other axes, tried on the balance of the momentum.

Where axes of the rates are mirrored, $\omega = -S\,\omega_{\text{read}}$ with a rotation $S$. A
rotation of the body keeps the set of all inertias, so that it may as well be one of the inputs.
"""

from collections.abc import Container, Iterator, Sequence
from itertools import combinations, permutations, product
from typing import NamedTuple

import equinox as eqx
import numpy as np
from scipy.optimize import nnls

from ..data.formats import INPUTS
from ..data.recordings import Recordings
from ..model.model import Model
from .mistakes import UNITS_OF_RATES, UNITS_OF_TIMES, Mistake, best_reading, name_axes
from .momentum import Motion, Term, motions, terms_of, with_rates, within

MOST_PERMUTED = 6  # rotors; of more each two are exchanged
# Times the lag of the model, of all readings; and then times the best one, of those that fit best.
LAGS = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8), (0.8, 0.9, 1.0, 1.1, 1.25)
SHORTLIST = 10
ROUNDING = 1e-6  # of a column, that is left by rounding
SUSPECT = 0.02  # of the squares, left by the log as it is, so that other units are tried
# Directions (13, 3) of parts of mass with which an inertia begins.
DIRECTIONS = np.array([d for d in product((0, 1, -1), repeat=3) if d > (0, 0, 0)], float)
MOST_ROUNDS, ENOUGH = 10, 0.9  # of more directions; times the squares before, to go on
BETTER = 2.0  # times, in squares, that another reading fits
ALIKE = 2.0  # times, that readings fit between which little decides


def entries_of(directions: np.ndarray) -> np.ndarray:
    """The entries xx, yy, zz, xy, xz, yz of the inertia (6, n) of mass in directions (n, 3)."""
    x, y, z = directions.T
    return np.stack([y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z])


class _Exchange(NamedTuple):
    """Numbers in another order and with other signs: number i is that of place `order[i]`."""

    order: tuple[int, ...]
    signs: tuple[int, ...]

    @property
    def matrix(self) -> np.ndarray:
        """The matrix that multiplies the numbers."""
        return np.array(self.signs)[:, None] * np.eye(len(self.order))[list(self.order)]


AXES = [
    _Exchange(order, signs)
    for order in permutations(range(3))
    for signs in product((1, -1), repeat=3)
]


class _Other(NamedTuple):
    """Another reading of an input."""

    words: str  # empty for the input as it is
    term: str  # name of the input
    turn: np.ndarray  # (3, 3), of what it brings, in the body
    columns: np.ndarray  # (columns, columns), by which its columns are multiplied
    rates: float = 1.0  # times the rates that were read; -1 where axes are mirrored
    spin: int = 1  # -1 where the senses of rotation are opposite


class _Balance(NamedTuple):
    """The balance of all trajectories, in columns: of the entries of the inertia and of terms."""

    terms: list[Term]
    rows: np.ndarray  # (rows, columns), with the scalar products of the columns

    def cost(self, other: _Other, rounds: int) -> float:
        """The squares that are left, for the best inertia, as a part of those of known inputs.

        An inertia is made of parts of mass in some directions. In each of the rounds those are
        added that would lower the squares most.
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
        """What known inputs bring (rows,), and each of the others (rows, 1), on the other side."""
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

    None where a torque law acts, which would have to be fitted too.
    """
    inputs = [name for name in INPUTS if getattr(recordings, name) is not None]
    if not inputs or model.torque is not None:
        return None
    if "rotor_speed" in inputs and model.rotors is None:
        return None
    motion = list(motions(model, recordings))
    if not motion:
        return None
    of_rates = {1.0: motion}  # by their factor
    are_read = all(of_one.is_integrated for _, of_one in motion)
    if "rotor_speed" in inputs and are_read:
        of_rates[-1.0] = _with_rates(motion, -1.0)
    readings = list(_others(terms_of(model, recordings.of(motion[0][0]), motion[0][1]), of_rates))
    model, lag, costs = _without_zeros(model), 1.0, {}
    for lags, rounds in zip(LAGS, (1, MOST_ROUNDS), strict=True):
        costs = dict.fromkeys((other.words for other in readings), np.inf)
        least, around = np.inf, lag
        for times in lags if model.rotors is not None and model.rotors.lag is not None else (1.0,):
            lagged = _with_lag(model, around * times)
            balances = {
                factor: _balance(lagged, recordings, moving) for factor, moving in of_rates.items()
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
            of_rates |= {unit.rates: _with_rates(motion, unit.rates) for unit in units}
    return best_reading(costs, BETTER, ALIKE)


def _with_rates(motion: Sequence[tuple[int, Motion]], factor: float) -> list[tuple[int, Motion]]:
    return [(i, with_rates(of_one, factor)) for i, of_one in motion]


def _units() -> list[_Other]:
    """Rates, or times, in other units: the motion is the same but for the size of the inertia."""
    as_it_is = "", np.eye(3), np.eye(1)
    units = {f"the rates as {unit}": size for unit, size in UNITS_OF_RATES.items()}
    units |= {f"the times as {unit}": size for unit, size in UNITS_OF_TIMES.items()}
    return [_Other(words, *as_it_is, rates=1 / size) for words, size in units.items() if size > 1]


def _without_zeros(model: Model) -> Model:
    """With a drag and an inertia of the rotors of one where they are zero."""
    if model.rotors is None:
        return model
    coefficients = model.rotors.drag, model.rotors.inertia
    coefficients = [each if np.any(each) else np.ones_like(each) for each in coefficients]
    return eqx.tree_at(lambda m: (m.rotors.drag, m.rotors.inertia), model, coefficients)


def _with_lag(model: Model, times: float) -> Model:
    if model.rotors is None or model.rotors.lag is None:
        return model
    return eqx.tree_at(lambda m: m.rotors.lag, model, times * model.rotors.lag)


def _balance(
    model: Model, recordings: Recordings, moving: Sequence[tuple[int, Motion]]
) -> _Balance:
    """The balance but for a steady torque, such as of rotors that are not quite alike."""
    columns: list[np.ndarray] = []
    terms: list[Term] = []
    for i, motion in moving:
        terms = terms_of(model, recordings.of(i), motion)
        fields = [motion.steady(), motion.momentum(), *(term.field for term in terms)]
        flat = [each.reshape(*each.shape[:2], -1) for each in fields]
        of_trajectory = within(motion.parts(), np.concatenate(flat, axis=2))
        columns.append(of_trajectory.reshape(-1, of_trajectory.shape[2]))
    steady, rows = np.split(np.concatenate(columns), [3], axis=1)
    sizes = np.linalg.norm(rows, axis=0)
    rows = rows - steady @ np.linalg.lstsq(steady, rows, rcond=None)[0]
    rows[:, np.linalg.norm(rows, axis=0) <= ROUNDING * sizes] = 0  # an input that is steady
    return _Balance(terms, np.asarray(np.linalg.qr(rows, "r")))


def _others(terms: Sequence[Term], of_rates: Container[float]) -> Iterator[_Other]:
    """All readings; the first is the log as it is."""
    shapes = {term.name: term.weights.shape[1] for term in terms}
    yield _Other("", "", np.eye(3), np.eye(1))
    for name, count in shapes.items():
        as_it_is = np.eye(count)
        if count == 1 and name != "rotor_speed":
            yield _Other(f"`{name}` with the other sign", name, np.eye(3), -as_it_is)
            continue
        if name != "rotor_speed":
            for exchange in AXES:
                words = f"the axes of `{name}` as {name_axes(*exchange)}"
                if not np.array_equal(exchange.matrix, as_it_is):
                    yield _Other(words, name, np.eye(3), exchange.matrix)
            continue
        yield _Other("the `spin` reversed", name, np.eye(3), as_it_is, spin=-1)
        for order in _orders(count):
            words = f"`{name}` as `{name}[:, {list(order)}]`"
            yield _Other(words, name, np.eye(3), as_it_is[list(order)])
        for exchange in AXES:
            S = exchange.matrix
            rates = float(np.sign(np.linalg.det(S)))
            words = f"the axes of the sensors as {name_axes(*exchange)}"
            if not np.array_equal(S, np.eye(3)) and rates in of_rates:
                turn = rates * S.T
                yield _Other(words, name, turn, as_it_is, rates)


def _orders(count: int) -> Iterator[tuple[int, ...]]:
    as_it_is = tuple(range(count))
    if count <= MOST_PERMUTED:
        yield from (order for order in permutations(as_it_is) if order != as_it_is)
        return
    for i, j in combinations(as_it_is, 2):
        yield tuple({i: j, j: i}.get(k, k) for k in as_it_is)
