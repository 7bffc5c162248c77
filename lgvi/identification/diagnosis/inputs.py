r"""Recorded inputs in another order or with other axes, tried on the balance of the momentum.

Where axes of the rates are mirrored, $\omega = -S\,\omega_{\text{read}}$ with a rotation $S$. A
rotation of the body keeps the set of all inertias, so that it may as well be one of the inputs.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations, permutations, product
from typing import NamedTuple

import equinox as eqx
import numpy as np
from scipy.optimize import nnls

from ..data.formats import INPUTS
from ..data.recordings import Recordings
from ..model.model import Model
from .mistakes import Mistake, best_reading, name_axes
from .momentum import ENTRIES_OF, Motion, Term, mirrored, motions, terms_of, within

MOST_PERMUTED = 6  # rotors; of more each two are exchanged
LAGS = 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8  # times that of the model
BETTER = 3.0  # times, in squares, that another reading fits
ALIKE = 2.0  # times, that readings fit between which little decides


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
    is_mirrored: bool = False  # whether the rates are opposite
    spin: int = 1  # -1 where the senses of rotation are opposite


class _Balance(NamedTuple):
    """The balance of all trajectories, in as few rows as columns."""

    inertia: np.ndarray  # (rows, 6), of the entries of an inertia
    terms: list[Term]  # with fields (rows, 3, columns)

    def cost(self, other: _Other) -> float:
        """The squares that are left, for the best inertia, as a part of those of known inputs."""
        known, factors = [], [self.inertia @ ENTRIES_OF]
        for term in self.terms:
            if term.name == other.term:
                weights = other.turn @ term.weights @ other.columns
                term = term._replace(weights=weights)
            if term.is_known:
                known.append(term.brought())
            else:
                factors.append(-other.spin * term.brought()[:, None])
        of_known = np.sum(known, axis=0)
        squares = np.sum(of_known**2)
        _, left = nnls(np.hstack(factors), of_known)
        return float(left**2 / squares) if squares > 0 else 0.0


def find_other_input(model: Model, recordings: Recordings) -> Mistake | None:
    """The reading of a recorded input that fits best, if much better than the log as it is."""
    inputs = [name for name in INPUTS if getattr(recordings, name) is not None]
    if not inputs or ("rotor_speed" in inputs and model.rotors is None):
        return None
    moving = list(motions(model, recordings))
    if not moving:
        return None
    models = _with_rotors(model)
    balances = {False: [_balance(each, recordings, moving) for each in models]}
    if "rotor_speed" in inputs and all(motion.is_integrated for _, motion in moving):
        moving = [(i, mirrored(motion)) for i, motion in moving]
        balances[True] = [_balance(each, recordings, moving) for each in models]
    costs: dict[str, float] = {}
    for other in _others(balances[False][0].terms, True in balances):
        costs[other.words] = min(each.cost(other) for each in balances[other.is_mirrored])
    return best_reading(costs, BETTER, ALIKE)


def _with_rotors(model: Model) -> list[Model]:
    """With several lags of the rotors, and one of a drag and an inertia that are zero."""
    if model.rotors is None:
        return [model]
    coefficients = model.rotors.drag, model.rotors.inertia
    coefficients = [each if np.any(each) else np.ones_like(each) for each in coefficients]
    model = eqx.tree_at(lambda m: (m.rotors.drag, m.rotors.inertia), model, coefficients)
    if model.rotors.lag is None:
        return [model]
    return [eqx.tree_at(lambda m: m.rotors.lag, model, times * model.rotors.lag) for times in LAGS]


def _balance(
    model: Model, recordings: Recordings, moving: Sequence[tuple[int, Motion]]
) -> _Balance:
    """The balance but for a steady torque, such as of rotors that are not quite alike."""
    columns, terms = [], []
    for i, motion in moving:
        terms = terms_of(model, recordings.of(i), motion)
        fields = [motion.steady(), motion.momentum(), *(term.field for term in terms)]
        flat = [each.reshape(*each.shape[:2], -1) for each in fields]
        of_trajectory = within(motion.parts(), np.concatenate(flat, axis=2))
        columns.append(of_trajectory.reshape(-1, of_trajectory.shape[2]))
    # The first rows are what a steady torque can make good.
    rows = np.linalg.qr(np.concatenate(columns), "r")[3:, 3:]
    ends = np.cumsum([6, *(term.weights.size for term in terms)])
    inertia, *fields = np.split(rows, ends[:-1], axis=1)
    return _Balance(
        inertia,
        [
            term._replace(field=field.reshape(-1, *term.weights.shape))
            for term, field in zip(terms, fields, strict=True)
        ],
    )


def _others(terms: Sequence[Term], may_be_mirrored: bool) -> Iterator[_Other]:
    """All readings; the first is the log as it is."""
    shapes = {term.name: term.weights.shape[1] for term in terms}
    yield _Other("", "", np.eye(3), np.eye(1))
    for name, count in shapes.items():
        as_it_is = np.eye(count)
        if name != "rotor_speed":
            for exchange in AXES if count == 3 else [_Exchange((0,), (-1,))]:
                words = f"the axes of `{name}` as {name_axes(*exchange)}"
                if count == 1:
                    words = f"`{name}` with the other sign"
                if not np.array_equal(exchange.matrix, as_it_is):
                    yield _Other(words, name, np.eye(3), exchange.matrix)
            continue
        yield _Other("the `spin` reversed", name, np.eye(3), as_it_is, spin=-1)
        for order in _orders(count):
            words = f"`{name}` as `{name}[:, {list(order)}]`"
            yield _Other(words, name, np.eye(3), as_it_is[list(order)])
        for exchange in AXES:
            S = exchange.matrix
            is_mirrored = np.linalg.det(S) < 0
            words = f"the axes of the sensors, beside those of `rotors`, as {name_axes(*exchange)}"
            if not np.array_equal(S, np.eye(3)) and (may_be_mirrored or not is_mirrored):
                turn = -S.T if is_mirrored else S.T
                yield _Other(words, name, turn, as_it_is, bool(is_mirrored))


def _orders(count: int) -> Iterator[tuple[int, ...]]:
    as_it_is = tuple(range(count))
    if count <= MOST_PERMUTED:
        yield from (order for order in permutations(as_it_is) if order != as_it_is)
        return
    for i, j in combinations(as_it_is, 2):
        yield tuple({i: j, j: i}.get(k, k) for k in as_it_is)
