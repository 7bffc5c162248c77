"""Levenberg and Marquardt's method on windows with states of their own."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from .elimination import BlockArrow, Increment, solve
from .linearise import Linearised

LEAST_DAMPING_FACTOR = 1 / 3  # least factor on the damping after a step (Nielsen 1999)
ROBUST_DAMPING_FACTOR = 0.6  # of a robust loss, after a step
LARGEST_DAMPING = 1e4  # damping, relative to a column, at which steps are too small to matter
FIRST_DAMPING = 1e-3  # damping where nothing is known
MOST_NAMED = 5  # trajectories in an error message


class NotSimulatedError(RuntimeError):
    """The start cannot be simulated: so all processes of a fit find, and no error of one alone."""


class LeastGain(NamedTuple):
    """How much a next step must lower the cost to matter: as a cost, or in a unit of the cost."""

    in_all: float
    by_common: float = np.inf  # of which by the common unknowns, with own ones that follow them

    def includes(self, step: Increment) -> bool:
        """Whether a step does not matter."""
        return step.reduction <= self.in_all and step.reduction_by_common <= self.by_common


class Point(NamedTuple):
    """Where an iteration begins; the method goes on from it as if it had not been stopped."""

    theta: np.ndarray
    states: Any
    damping: float = FIRST_DAMPING
    # (p,), units in which common unknowns are damped: the largest lengths of columns so far.
    scale: np.ndarray | float = 0.0
    robust_damping: float = 1.0
    iteration: int = 0


def minimise(
    linearise: Callable[[np.ndarray, Any, float], Linearised],
    move: Callable[[Any, np.ndarray], Any],
    start: Point,
    lower: np.ndarray,
    upper: np.ndarray,
    max_step: np.ndarray,
    names: Sequence[str],
    least_gain: Callable[[Linearised], LeastGain],
    iterations: int,
    began: Callable[[Point, float], None],
) -> tuple[Point, Linearised, bool]:
    """Minimise the cost, until no step, damped or not, would lower it by more than `least_gain`.

    A step is damped until the cost falls, and until the step of the common unknowns is at most
    `max_step` (p,). `linearise(theta, states, robust_damping)` gives the problem about a point. The
    damping of robust losses is 1 where a step reweights the residuals, and 0 for a step of Newton's
    method. `names` are the names of the trajectories of the windows. `began(point, cost)` is called
    when an iteration begins.

    Returns
    -------
    Point, Linearised, bool
        The point where the method ended, with a damping for a minimisation nearby, the problem
        about it, and whether the method converged.

    Raises
    ------
    NotSimulatedError
        If the start cannot be simulated.
    """
    point = start
    problem = linearise(point.theta, point.states, point.robust_damping)
    if not np.isfinite(problem.cost):
        failed = [names[int(i)] for i in np.flatnonzero(~np.isfinite(problem.costs))]
        processes = problem.system.processes
        every, failed = (processes.names(dict.fromkeys(some)) for some in (names, failed))
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
        theta, states, damping, scale, robust_damping, iteration = point
        least, growth = least_gain(problem), 2.0
        # The largest lengths so far (Moré 1978): an unknown whose column gets shorter and shorter
        # would otherwise be damped less and less, and diverge.
        scale = np.maximum(scale, problem.system.lengths())
        while True:
            at_bound = at_bounds(problem.system, theta, lower, upper)
            step = solve(problem.system, damping, at_bound, scale)
            if least.includes(step) and least.includes(solve(problem.system, 0, at_bound)):
                return point._replace(damping=min(damping, FIRST_DAMPING)), problem, True
            if np.any(abs(step.theta) > max_step) and damping < LARGEST_DAMPING:
                damping = max(2 * damping, step.smallest_singular_value)
                continue
            new_theta = np.clip(theta + step.theta, lower, upper)
            new_states = move(states, step.own)
            trial = linearise(new_theta, new_states, ROBUST_DAMPING_FACTOR * robust_damping)
            gain = problem.cost - trial.cost
            if np.isfinite(trial.cost) and gain > 1e-4 * step.reduction:
                break
            if least.includes(step) or damping > LARGEST_DAMPING:
                return point._replace(damping=FIRST_DAMPING), problem, False
            damping, growth = max(damping * growth, step.smallest_singular_value), 2 * growth
        ratio = gain / step.reduction
        damping = max(damping * max(LEAST_DAMPING_FACTOR, 1 - (2 * ratio - 1) ** 3), 1e-12)
        problem = trial
        point = Point(
            new_theta,
            new_states,
            damping,
            scale,
            ROBUST_DAMPING_FACTOR * robust_damping,
            iteration + 1,
        )
    return point._replace(damping=FIRST_DAMPING), problem, False


def at_bounds(
    system: BlockArrow, theta: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """True where a common unknown is at a bound that the gradient would make it cross (p,).

    And where bounds are equal: the unknown is held.
    """
    gradient = system.gradient()
    at_lower, at_upper = theta <= lower, theta >= upper
    return (at_lower & (gradient > 0)) | (at_upper & (gradient < 0)) | (at_lower & at_upper)
