"""Levenberg and Marquardt's method on windows with states of their own."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from ..model.states import InitialStates
from .elimination import BlockArrow, solve
from .linearise import Linearised

SMALLER = 1 / 3  # least factor on the damping after a step (Nielsen 1999)
BOLDER = 0.6  # factor on the caution after a step
LARGEST = 1e4  # damping, relative to a column, at which steps are too small to matter
FIRST = 1e-3  # damping where nothing is known
MOST_NAMED = 5  # trajectories in an error message

CLOSED = 1e-4  # cost of the gaps, and gain of a next step, at most, in variances of a residual
NARROWER = 3.0, 300.0  # least and largest factor by which the width is lowered at a time
MOST_WIDTHS = 12


class NotSimulatedError(RuntimeError):
    """The start cannot be simulated: so all processes of a fit find, and no error of one alone."""


class Point(NamedTuple):
    """Where an iteration begins; the method goes on from it as if it had not been stopped."""

    theta: np.ndarray
    states: Any
    scale: np.ndarray  # (p,), units in which common unknowns are damped
    damping: float
    caution: float = 1.0
    iteration: int = 0


class Minimum(NamedTuple):
    """The point where the method ended."""

    theta: np.ndarray
    states: Any
    problem: Linearised
    converged: bool
    iterations: int
    damping: float  # with which a minimisation nearby may begin


def minimise(
    linearise: Callable[[np.ndarray, Any, float], Linearised],
    move: Callable[[Any, np.ndarray], Any],
    start: Point,
    lower: np.ndarray,
    upper: np.ndarray,
    max_step: np.ndarray,
    names: Sequence[str],
    threshold: Callable[[Linearised], float],
    iterations: int,
    began: Callable[[Point, float], None],
) -> Minimum:
    """Minimise the cost, until no step, damped or not, would lower it by more than `threshold`.

    A step is damped until the cost falls, and until the step of the common unknowns is at most
    `max_step` (p,). `linearise(theta, states, caution)` gives the problem about a point; `caution`
    is for robust losses: at 1 a step reweights the residuals, at 0 it is a step of Newton's method.
    `names` are the names of the trajectories of the windows. `began(point, cost)` is called when an
    iteration begins.

    Raises
    ------
    NotSimulatedError
        If the start cannot be simulated.
    """
    point = start
    problem = linearise(point.theta, point.states, point.caution)
    if not np.isfinite(problem.cost):
        failed = [names[int(i)] for i in np.flatnonzero(~np.isfinite(problem.costs))]
        together = problem.system.together
        every, failed = (together.names(dict.fromkeys(some)) for some in (names, failed))
        failed = failed or every
        first = ", ".join(map(repr, failed[:MOST_NAMED])) + ", ..." * (len(failed) > MOST_NAMED)
        raise NotSimulatedError(
            f"The start cannot be simulated in {len(failed)} of {len(every)} trajectories "
            f"({first}): the step of the integrator is too long, the initial rates are wrong, "
            "which `start` can give, or the inertia of the body is far too small for what acts on "
            "it."
        )
    while point.iteration < iterations:
        began(point, problem.cost)
        theta, states, scale, damping, caution, iteration = point
        least, growth = threshold(problem), 2.0
        # The largest lengths so far (Moré 1978): an unknown whose column gets shorter and shorter
        # would otherwise be damped less and less, and diverge.
        scale = np.maximum(scale, problem.system.lengths())
        while True:
            at_bound = at_bounds(problem.system, theta, lower, upper)
            step = solve(problem.system, damping, at_bound, scale)
            if step.reduction <= least and solve(problem.system, 0, at_bound).reduction <= least:
                return Minimum(theta, states, problem, True, iteration, min(damping, FIRST))
            if np.any(abs(step.theta) > max_step) and damping < LARGEST:
                damping = max(2 * damping, step.smallest_singular_value)
                continue
            new_theta = np.clip(theta + step.theta, lower, upper)
            new_states = move(states, step.own)
            trial = linearise(new_theta, new_states, BOLDER * caution)
            gain = problem.cost - trial.cost
            if np.isfinite(trial.cost) and gain > 1e-4 * step.reduction:
                break
            if step.reduction <= least or damping > LARGEST:
                return Minimum(theta, states, problem, False, iteration, FIRST)
            damping, growth = max(damping * growth, step.smallest_singular_value), 2 * growth
        ratio = gain / step.reduction
        damping = max(damping * max(SMALLER, 1 - (2 * ratio - 1) ** 3), 1e-12)
        problem = trial
        point = Point(new_theta, new_states, scale, damping, BOLDER * caution, iteration + 1)
    return Minimum(point.theta, point.states, problem, False, iterations, FIRST)


def at_bounds(
    system: BlockArrow, theta: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """True where a common unknown is at a bound that the gradient would make it cross (p,)."""
    gradient = system.gradient()
    return ((theta <= lower) & (gradient > 0)) | ((theta >= upper) & (gradient < 0))


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
