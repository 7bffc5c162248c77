"""Multiple shooting: segments with states of their own, and gaps between them that close.

H. G. Bock & K. J. Plitt, "A multiple shooting algorithm for direct solution of optimal control
problems", IFAC World Congress (1984). The gaps are residuals whose standard deviation falls until
what they cost does not matter; so each step is one of an ordinary least-squares problem.
"""

from collections.abc import Callable

import numpy as np

from ..model.states import InitialStates
from ..windows.layout import Layout
from .levenberg_marquardt import Minimum
from .linearise import Linearised

CLOSED = 1e-4  # what gaps may cost, and a next step might gain, in variances of a residual
NARROWER = 3.0, 300.0  # the width at a time, at least and at most
MOST_WIDTHS = 12


def first_width(problem: Linearised, layout: Layout) -> np.ndarray:
    """The root mean square of turns and of changes of angular velocity at the gaps (6,)."""
    gaps = np.asarray(problem.factors.gap, float)[layout.joined, :, -1]
    widths = [np.sqrt(np.mean(part**2)) for part in np.split(gaps, 2, axis=1)]
    return np.repeat(np.maximum(widths, 1e-12), 3)


def close_gaps(
    minimum: Callable[[np.ndarray, InitialStates, np.ndarray], Minimum],
    theta: np.ndarray,
    states: InitialStates,
    width: np.ndarray,
    least: Callable[[float], float],
) -> tuple[Minimum, np.ndarray]:
    """The minimum with narrow gaps, and how narrow.

    It has not converged where gaps still cost more than `least` of the cost.
    """
    done, narrowed = 0, 0
    while True:
        found = minimum(theta, states, width)
        theta, states, done = found.theta, found.states, done + found.iterations
        ratio = found.problem.gap_cost / least(found.problem.cost)
        if ratio <= 1 or narrowed == MOST_WIDTHS:
            converged = found.converged and bool(ratio <= 1)
            return found._replace(converged=converged, iterations=done), width
        width, narrowed = width / np.clip(2 * np.sqrt(ratio), *NARROWER), narrowed + 1
