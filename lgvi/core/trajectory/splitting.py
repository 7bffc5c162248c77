"""Steps as sequences of kicks, which change the momentum, and drifts, which are free motion."""

from itertools import pairwise
from typing import NamedTuple

from jaxtyping import Array

COMPOSITION_ORDERS = 2, 4, 6, 8

# Suzuki 1990 for order 4, Kahan & Li 1997 for orders 6 and 8: the first half and the middle.
_SUZUKI = 1 / (4 - 4 ** (1 / 3))
_HALVES = {
    2: (1.0,),
    4: (_SUZUKI, _SUZUKI, 1 - 4 * _SUZUKI),
    6: (
        0.39216144400731413928,
        0.33259913678935943860,
        -0.70624617255763935981,
        0.08221359629355080023,
        0.79854399093482996340,
    ),
    8: (
        0.13020248308889008088,
        0.56116298177510838456,
        -0.38947496264484728641,
        0.15884190655515560090,
        -0.39590389413323757734,
        0.18453964097831570709,
        0.25837438768632204729,
        0.29501172360931029887,
        -0.60550853383003451170,
    ),
}


class Inputs(NamedTuple):
    """What is given for each step."""

    t: Array  # time at its start
    h: Array  # size
    rotor: Array | None  # momentum (3,) of rotors


class Stage(NamedTuple):
    """A drift and the kick after it, in parts of the step."""

    drift: float | Array
    kick: float | Array
    gradient: float | None = None  # of h^3, by which the kick takes the torque's own variation


class Splitting(NamedTuple):
    """One step: a kick, and then stages."""

    kick: float
    stages: tuple[Stage, ...]
    drift_order: int = 2


def composition_weights(order: int) -> tuple[float, ...]:
    """Parts of a step, a palindrome, that make a symmetric method of order 2 one of `order`."""
    half = _HALVES[order]
    return *half, *half[-2::-1]


def composition(order: int) -> Splitting:
    """Symmetric composition of half kick, drift, half kick."""
    weights = composition_weights(order)
    kicks = [(a + b) / 2 for a, b in pairwise((*weights, 0.0))]
    return Splitting(weights[0] / 2, tuple(map(Stage, weights, kicks)))


# Chin 1997; the drifts must be of order 6 or more for energy not to drift.
FORCE_GRADIENT = Splitting(1 / 6, (Stage(1 / 2, 2 / 3, 1 / 72), Stage(1 / 2, 1 / 6)), drift_order=6)


def splitting_of(order: int, force_gradient: bool) -> Splitting:
    """The composition of an order; of order 4 the force gradient instead, if wanted."""
    return FORCE_GRADIENT if order == 4 and force_gradient else composition(order)
