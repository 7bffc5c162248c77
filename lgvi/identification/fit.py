"""The fit of all windows, from short ones to whole trajectories, with a step small enough."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from ..modules.integrator import MoserVeselovIntegrator
from .data.recordings import Recordings
from .least_squares.block_arrow import solve
from .least_squares.levenberg_marquardt import Minimum, at_bounds, minimise
from .least_squares.linearise import Linearised, linearised, unseen_size
from .least_squares.multiple_shooting import CLOSED, close_gaps, first_width
from .model.free import Free
from .model.model import Model
from .model.states import InitialStates
from .progress import Progress
from .uncertainty.information import Information, information
from .uncertainty.noise import NO_NOISE, degrees_of_freedom, number_of_readings, variance_factor
from .windows.grid import Window
from .windows.initial_guess import largest_rates, states_of
from .windows.layout import Layout, lay_out, refined
from .windows.residuals import Residuals
from .windows.schedule import first_of_trajectories, levels, starts_within
from .windows.step_size import intervals, method_for

TURN_OF_STEP = 0.2  # rad, at most at the first trial
LARGEST_BIAS = 0.1  # of the step, in standard errors
MOST_REFINEMENTS, MOST_FINER = 3, 30
LEAST_ORDER = 0.5  # by which a bias is taken to fall
MOST_POWERS = 9  # of ten, in a start that is of the wrong size
FINAL, COARSE = 1e-6, 1e-2  # what a next step might gain, in variances of a residual


class Fitted(NamedTuple):
    """A minimum of whole trajectories."""

    theta: np.ndarray
    states: InitialStates
    residuals: Residuals  # of all readings
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
    segment: float | None,
    noise_is_given: bool,
    iterations: int,
    report: Progress,
) -> Fitted:
    """Fit; with an integrator its `dt` is the longest step, else the step is found.

    Raises
    ------
    RuntimeError
        If the start cannot be simulated.
    """
    time_scale = float(model.time_scale)
    speeds = largest_rates(recordings, time_scale)
    method, longest_step = method_for(model, recordings, integrator, speeds, TURN_OF_STEP)
    compiled: set[tuple[int, ...]] = set()  # shapes

    def linearise(layout, theta, states, width=None, caution=0.0) -> Linearised:
        return linearised(model, free, theta, states, layout, method, width, caution)

    def least(layout: Layout, tolerance: float, cost: float) -> float:
        """A part of a cost that does not matter: some of the variance of a residual."""
        rounding = 30 * float(np.finfo(jax.dtypes.canonicalize_dtype(float)).eps) ** 0.5
        variance = cost / (3 * number_of_readings(layout))
        return max(tolerance, rounding) * max(variance, NO_NOISE)

    def minimum(
        layout: Layout, level: list[Window], tolerance: float, theta, states, width=None
    ) -> Minimum:
        shapes = {x.shape[1:] for _, windows in layout.parts for x in jax.tree.leaves(windows)}
        if not shapes <= compiled:
            compiled.update(shapes)
            report.compiling()
        return minimise(
            lambda theta, states, caution: linearise(layout, theta, states, width, caution),
            lambda states, own: states.moved(own),
            theta,
            states,
            free.lower,
            free.upper,
            free.farthest,
            [recordings.names[window.trajectory] for window in level],
            partial(least, layout, tolerance),
            iterations,
            report,
        )

    ladder = levels(recordings, speeds, segment)
    layouts = lay_out(recordings, ladder, longest_step)
    states = states_of(recordings, ladder[0], speeds, time_scale)
    if start is not None:
        states = _with_start(states, start, ladder[0])
    *short, last = layouts
    theta, done, variances = free.theta, 0, []
    if not unseen_size(model, free, recordings).any():
        theta = _of_a_size(lambda theta: linearise(layouts[0], theta, states).cost, free)
    for level, layout in enumerate(short):
        found = minimum(layout, ladder[level], COARSE, theta, states)
        theta, done = found.theta, done + found.iterations
        known = information(found.problem.rows, np.zeros(len(theta), bool))
        variances.append(found.problem.cost / max(1, degrees_of_freedom(layout, known)))
        states = found.states.at(starts_within(ladder[level], ladder[level + 1]))
    width = None
    if last.position is not None:
        width = first_width(linearise(last, theta, states), last)
    refinements, before, finer = 0, np.inf, 2.0
    while True:
        if width is None:
            found = minimum(last, ladder[-1], FINAL, theta, states)
        else:
            found, width = close_gaps(
                partial(minimum, last, ladder[-1], CLOSED),
                theta,
                states,
                width,
                partial(least, last, CLOSED),
            )
        theta, states, done = found.theta, found.states, done + found.iterations
        if model.is_robust:  # without caution
            found = found._replace(problem=linearise(last, theta, states, width))
        rows = found.problem.rows
        held = at_bounds(rows, theta, free.lower, free.upper)
        known = information(rows, held)
        freedom = degrees_of_freedom(last, known)
        spread = np.asarray(found.problem.factors.spread)
        variance = variance_factor(spread, number_of_readings(last), freedom)
        # What a step of half the size would change.
        fine = linearise(refined(last), theta, states, width).rows
        shift = solve(fine, 0, held).theta - solve(rows, 0, held).theta
        unit = 1.0 if noise_is_given else np.fmax(variance, NO_NOISE)
        moved = known.length(shift) / np.sqrt(unit)
        # Of an order p it is 2^p times less wrong; where a torque law jumps, p is a lower one.
        order = np.log(before / max(moved, 1e-300)) / np.log(finer)
        order = np.clip(order, LEAST_ORDER, method.order)
        bias = moved / (1 - 0.5**order)
        enough = not bias > LARGEST_BIAS or moved >= before
        if enough or integrator is not None or refinements == MOST_REFINEMENTS:
            break
        refinements += 1
        before, finer = moved, min(np.ceil((2 * bias / LARGEST_BIAS) ** (1 / order)), MOST_FINER)
        longest_step = np.minimum(longest_step, intervals(recordings)) / finer
        (last,) = lay_out(recordings, ladder[-1:], longest_step)
    variances.append(found.problem.cost / max(1, freedom))
    return Fitted(
        theta,
        states.at(first_of_trajectories(ladder[-1])),
        found.problem.factors.residuals,
        found.problem.cost,
        freedom,
        found.converged,
        done,
        held,
        known,
        variance,
        bias,
        variances[-1] / max(variances[0], NO_NOISE),
    )


def _of_a_size(cost: Callable[[np.ndarray], float], free: Free) -> np.ndarray:
    """The start, its inertia so many times ten as fits best what acts."""
    if not free.size.any():
        return free.theta
    found = {}
    for power in sorted(range(-MOST_POWERS, MOST_POWERS + 1), key=abs):
        theta = free.theta + power * np.log(10) * free.size
        if np.all((free.lower <= theta) & (theta <= free.upper)):
            found[power] = cost(theta), theta
    least = min(found, key=lambda power: found[power][0])
    return found[least if found[least][0] < 0.9 * found[0][0] else 0][1]


def _with_start(
    states: InitialStates, start: InitialStates, windows: list[Window]
) -> InitialStates:
    """Initial states, those of the first window of each trajectory as given."""
    first = first_of_trajectories(windows)
    R, omega = states.R.copy(), states.omega.copy()
    R[first], omega[first] = np.asarray(start.R), np.asarray(start.omega)
    return InitialStates(R, omega)
