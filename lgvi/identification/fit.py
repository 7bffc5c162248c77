"""The fit of all windows, from short ones to whole trajectories, with a step small enough."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..modules.forcing import needs_order_two
from ..modules.integrator import MoserVeselovIntegrator
from .block_arrow import solve
from .factor import Factors, factors
from .levels import levels, starts_within
from .levenberg_marquardt import Linearised, Minimum, at_bounds, minimise
from .model import Free, Model
from .noise import degrees_of_freedom, variance_factor
from .observability import Information, information
from .recordings import Recordings
from .residuals import InitialStates
from .starts import largest_rates, states_of
from .windows import Window, Windows, coarsened, lay_out

TURN_OF_STEP = 0.2  # rad, at most at the first trial
LARGEST_BIAS = 0.1  # of the step, in standard errors
MOST_REFINEMENTS = 3
MEMORY = 2**28  # bytes for what is linearised at a time
FINAL, COARSE = 1e-7, 1e-2  # what a last step may gain, in variances of a residual


class Fitted(NamedTuple):
    """A minimum of whole trajectories."""

    theta: np.ndarray
    states: InitialStates
    windows: Windows
    factors: Factors
    cost: float
    converged: bool
    iterations: int
    held: np.ndarray  # (p,), at a bound
    information: Information
    variance: float
    step_bias: float
    worse: float  # how much larger the variance is than in the shortest windows


def best_order(model: Model, recordings: Recordings) -> int:
    """The order that costs least for an accuracy, of those that what acts allows."""
    if recordings.body_torque is not None or recordings.rotor_momentum is not None:
        return 2
    if model.torque is None:
        return 6
    return 2 if needs_order_two(model.torque) else 4


def fit(
    model: Model,
    free: Free,
    recordings: Recordings,
    integrator: MoserVeselovIntegrator | None,
    start: InitialStates | None,
    iterations: int,
    report: Callable[[float], None],
) -> Fitted:
    """Fit; with an integrator its `dt` is the longest step, else the step is found.

    Raises
    ------
    RuntimeError
        If the start cannot be simulated.
    """
    speeds = largest_rates(recordings)
    if integrator is None:
        method = MoserVeselovIntegrator(1.0, order=best_order(model, recordings), throw=False)
        longest_step = TURN_OF_STEP / np.maximum(speeds, 1e-300)
    else:
        method = replace(integrator, throw=False)
        longest_step = np.full(len(recordings), float(integrator.dt))

    def linearise(windows: Windows, theta: np.ndarray, states: InitialStates) -> Linearised:
        numbers = 60 * (len(theta) + 7) * (windows.dt.shape[1] + 1)  # for each window, about
        batch = max(1, MEMORY // (8 * numbers))
        found = factors(model, free, jnp.asarray(theta), states, windows, method, batch)
        return Linearised(np.asarray(found.triangle), float(np.sum(found.cost)), found)

    def minimum(windows: Windows, theta, states, tolerance: float) -> Minimum:
        freedom = degrees_of_freedom(windows, len(theta))
        rounding = 30 * float(jnp.finfo(windows.dt.dtype).eps) ** 0.5
        return minimise(
            lambda theta, states: linearise(windows, theta, states),
            lambda states, own: states.moved(jnp.asarray(own)),
            theta,
            states.padded(len(windows.start)),
            free.lower,
            free.upper,
            lambda cost: max(tolerance, rounding) * cost / freedom,
            iterations,
            report,
        )

    ladder = levels(recordings, speeds)
    layouts = lay_out(recordings, ladder, longest_step)
    states = states_of(recordings, ladder[0])
    if start is not None:
        states = _with_start(states, start, ladder[0])
    *short, last = layouts
    theta, done, variances = free.theta, 0, []
    for level, windows in enumerate(short):
        found = minimum(windows, theta, states, COARSE)
        theta, done = found.theta, done + found.iterations
        variances.append(found.problem.cost / degrees_of_freedom(windows, len(theta)))
        kept = starts_within(ladder[level], ladder[level + 1])
        states = jax.tree.map(lambda x, kept=kept: x[kept], found.states)
    for refinement in range(MOST_REFINEMENTS + 1):
        found = minimum(last, theta, states, FINAL)
        theta, states, done = found.theta, found.states, done + found.iterations
        triangles, freedom = found.problem.triangles, degrees_of_freedom(last, len(theta))
        held = at_bounds(triangles, theta, free.lower, free.upper)
        known = information(triangles, held)
        variance = variance_factor(model, found.problem.details.residuals, last, freedom)
        # What a step of twice the size would change; of an order p it is 2^p times as wrong.
        coarse = linearise(coarsened(last), theta, states).triangles
        shift = solve(coarse, 0, held).theta - solve(triangles, 0, held).theta
        bias = known.length(shift) / np.sqrt(variance) / (2**method.order - 1)
        if bias <= LARGEST_BIAS or integrator is not None or refinement == MOST_REFINEMENTS:
            variances.append(found.problem.cost / freedom)
            return Fitted(
                theta,
                states,
                last,
                found.problem.details,
                found.problem.cost,
                found.converged,
                done,
                held,
                known,
                variance,
                bias,
                variances[-1] / variances[0],
            )
        longest_step = longest_step / np.ceil((2 * bias / LARGEST_BIAS) ** (1 / method.order))
        (last,) = lay_out(recordings, ladder[-1:], longest_step)
    raise AssertionError("unreachable")


def _with_start(
    states: InitialStates, start: InitialStates, windows: list[Window]
) -> InitialStates:
    """Initial states, those of the first window of each trajectory as given."""
    trajectory = np.array([window.trajectory for window in windows])
    first = np.append(True, trajectory[1:] != trajectory[:-1])
    return InitialStates(
        states.R.at[first].set(start.R.astype(states.R.dtype)),
        states.omega.at[first].set(start.omega.astype(states.omega.dtype)),
    )
