"""Multiple shooting: segments with states of their own, and gaps between them that close.

H. G. Bock & K. J. Plitt, "A multiple shooting algorithm for direct solution of optimal control
problems", IFAC World Congress (1984). The gaps are residuals whose standard deviation is lowered
until the cost of the gaps does not matter; so each problem is one of ordinary least squares.
"""

from collections.abc import Callable

import jax
import numpy as np

from ..model.states import InitialStates
from .levenberg_marquardt import Minimum
from .linearise import Linearised

CLOSED = 1e-4  # cost of the gaps, and gain of a next step, at most, in variances of a residual
NARROWER = 3.0, 300.0  # least and largest factor by which the width is lowered at a time
MOST_WIDTHS = 12


def first_width(problem: Linearised) -> np.ndarray:
    """The root mean square at the gaps of turns, of changes of angular velocity, and of others."""
    m, count = problem.system.unknowns, 0
    squares = np.zeros(m)
    for part in problem.parts:
        if part.factors.gap is not None:
            gaps = np.asarray(part.factors.gap, float)[part.layout.joined, :, -1]
            squares, count = squares + np.sum(gaps**2, axis=0), count + len(gaps)
    *squares, count = problem.system.together.sum([*squares, count])
    widths = np.sqrt(np.array(squares) / count)
    for group in (slice(0, 3), slice(3, 6)):
        widths[group] = np.sqrt(np.mean(widths[group] ** 2))
    # Where states agree from the start, as own leaves do: no narrower than rounding allows.
    return np.maximum(widths, float(np.finfo(jax.dtypes.canonicalize_dtype(float)).eps) ** 0.5)


def close_gaps(
    minimum: Callable[[np.ndarray, InitialStates, np.ndarray], Minimum],
    theta: np.ndarray,
    states: InitialStates,
    width: np.ndarray,
    least: Callable[[Linearised], float],
) -> tuple[Minimum, np.ndarray]:
    """The minimum with narrow gaps, and their width.

    The fit has not converged if the gaps still cost more than `least` of the cost.
    """
    done, narrowed = 0, 0
    while True:
        found = minimum(theta, states, width)
        theta, states, done = found.theta, found.states, done + found.iterations
        ratio = found.problem.gap_cost / least(found.problem)
        if ratio <= 1 or narrowed == MOST_WIDTHS:
            converged = found.converged and bool(ratio <= 1)
            return found._replace(converged=converged, iterations=done), width
        width, narrowed = width / np.clip(2 * np.sqrt(ratio), *NARROWER), narrowed + 1
