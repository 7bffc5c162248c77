"""The fit of all windows, from short ones to whole trajectories, with a step small enough."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..modules.integrator import MoserVeselovIntegrator
from .block_arrow import solve
from .factor import Factors
from .levels import levels, starts_within
from .levenberg_marquardt import Minimum, at_bounds, minimise
from .linearised import Linearised, linearised, method_for
from .model import Free, Model
from .noise import degrees_of_freedom, number_of_readings, variance_factor
from .observability import Information, information
from .recordings import Recordings
from .residuals import InitialStates
from .starts import largest_rates, states_of
from .windows import Window, Windows, coarsened, lay_out

TURN_OF_STEP = 0.2  # rad, at most at the first trial
LARGEST_BIAS = 0.1  # of the step, in standard errors
MOST_REFINEMENTS = 3
FINAL, COARSE = 1e-7, 1e-2  # what a last step may gain, in variances of a residual


class Fitted(NamedTuple):
    """A minimum of whole trajectories."""

    theta: np.ndarray
    states: InitialStates
    factors: Factors
    cost: float
    freedom: int
    converged: bool
    iterations: int
    held: np.ndarray  # (p,), at a bound
    information: Information
    variance: float
    step_bias: float
    worse: float  # how much larger the variance is than in the shortest windows


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
    method, longest_step = method_for(model, recordings, integrator, speeds, TURN_OF_STEP)

    def linearise(windows: Windows, theta: np.ndarray, states: InitialStates) -> Linearised:
        return linearised(model, free, theta, states, windows, method)

    def minimum(windows: Windows, theta, states, tolerance: float) -> Minimum:
        count = 3 * number_of_readings(windows)  # of residuals
        rounding = 30 * float(jnp.finfo(windows.dt.dtype).eps) ** 0.5
        return minimise(
            lambda theta, states: linearise(windows, theta, states),
            lambda states, own: states.moved(jnp.asarray(own)),
            theta,
            states.padded(len(windows.start)),
            free.lower,
            free.upper,
            lambda cost: max(tolerance, rounding) * cost / count,
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
        none = np.zeros(len(theta), bool)
        freedom = degrees_of_freedom(windows, found.problem.triangles, none)
        variances.append(found.problem.cost / freedom)
        kept = starts_within(ladder[level], ladder[level + 1])
        states = jax.tree.map(lambda x, kept=kept: x[kept], found.states)
    for refinement in range(MOST_REFINEMENTS + 1):
        found = minimum(last, theta, states, FINAL)
        theta, states, done = found.theta, found.states, done + found.iterations
        triangles = found.problem.triangles
        held = at_bounds(triangles, theta, free.lower, free.upper)
        freedom = degrees_of_freedom(last, triangles, held)
        known = information(triangles, held)
        variance = variance_factor(model, found.problem.factors.residuals, last, freedom)
        # What a step of twice the size would change; of an order p it is 2^p times as wrong.
        coarse = linearise(coarsened(last), theta, states).triangles
        shift = solve(coarse, 0, held).theta - solve(triangles, 0, held).theta
        bias = known.length(shift) / np.sqrt(variance) / (2**method.order - 1)
        if bias <= LARGEST_BIAS or integrator is not None or refinement == MOST_REFINEMENTS:
            variances.append(found.problem.cost / freedom)
            return Fitted(
                theta,
                states,
                found.problem.factors,
                found.problem.cost,
                freedom,
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
