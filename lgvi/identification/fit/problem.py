"""The least-squares problem of all configurations, and the result of a fit.

Trajectories may be cut into segments with states of their own, between which gaps close as a fit
goes on: H. G. Bock & K. J. Plitt, "A multiple shooting algorithm for direct solution of optimal
control problems", IFAC World Congress (1984). The gaps are residuals whose standard deviation is
lowered until their cost does not matter, so that each problem is one of ordinary least squares.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from ...modules.integrator import MoserVeselovIntegrator
from ..data.recordings import Recordings
from ..model.configuration import Configuration
from ..model.free_leaves import Free
from ..model.prior import Prior
from ..model.states import InitialStates
from ..running.processes import SINGLE_PROCESS, ProcessGroup
from ..running.progress import Progress
from ..segments.chain import Followed, ReadingArrays, Which, compute_costs, follow
from ..segments.levels import Level
from ..solver.checkpoint import Checkpoint
from ..solver.levenberg_marquardt import LeastGain, Point, at_bounds, minimise
from ..solver.linearise import Linearised, join_parts, linearise_part
from ..uncertainty.information import (
    NO_NOISE,
    Information,
    compute_information,
    degrees_of_freedom,
    variance_factor,
)
from ..uncertainty.observability import LinearPosterior

# Gain of a next step, at most, for each unknown, in variances of a residual. A gain of 1 moves one
# unknown by about a standard error.
COARSE, FINAL = 1e-2, 1e-6
CLOSED_GAPS = 1e-4  # cost of the gaps, and gain of a next step, at most, in variances of a residual
GAP_FACTORS = 3.0, 300.0  # least and largest factor by which the gaps are narrowed at a time
MOST_NARROWINGS = 12


@dataclass(eq=False)
class Problem:
    """Configurations to be fitted to their recordings, and how.

    The methods take a level: the windows of all configurations.
    """

    parameters: Any
    free: Free
    configurations: Sequence[Configuration]
    starts: Sequence[InitialStates | None] = ()  # initial states of each configuration
    prior: Sequence[Prior] = ()
    noise_is_given: bool = False
    methods: Sequence[MoserVeselovIntegrator] = ()  # of each configuration
    iterations: int = 100
    turn_of_step: float = 0.2  # rad, at most at the first trial
    is_in_vain: bool = False  # whether the recordings tell beforehand that no fit is good
    prior_noise_variance: float = 1.0  # by which a prior is weighed against residuals
    blocks: int = 1  # of time, in each window
    report: Progress = field(default_factory=Progress)
    checkpoint: Checkpoint | None = None
    mesh: Mesh | None = None
    processes: ProcessGroup = SINGLE_PROCESS  # each with recordings of its own

    def linearise(
        self,
        level: Level,
        theta: np.ndarray,
        states: InitialStates,
        gap_sigma: np.ndarray | None = None,
        robust_damping: float = 0.0,
    ) -> Linearised:
        """The problem about a point; gaps have a standard deviation `gap_sigma` (m,)."""
        parts = []
        for configuration, method, chains, part in zip(
            self.configurations, self.methods, level.chains, level.parts, strict=True
        ):
            at = configuration.at(self.parameters, self.free, theta)
            options = gap_sigma, robust_damping, self.blocks, self.mesh
            parts.append(linearise_part(at, states.at(part), chains, method, *options))
        return join_parts(parts, theta, self.prior_rows(theta), self.processes)

    def costs(self, level: Level, k: int, theta: np.ndarray, states: InitialStates) -> np.ndarray:
        """The costs of the windows of a configuration."""
        at = self.configurations[k].at(self.parameters, self.free, theta)
        return compute_costs(at, states, level.chains[k], self.methods[k], self.mesh)

    def cost(self, level: Level, theta: np.ndarray, states: InitialStates) -> float:
        """The cost of all windows and of the prior."""
        with np.errstate(over="ignore"):
            costs = [
                np.sum(self.costs(level, k, theta, states.at(part)))
                for k, part in enumerate(level.parts)
            ]
        of_prior = float(np.sum(self.prior_rows(theta)[:, -1] ** 2))
        return float(self.processes.sum(sum(costs))) + of_prior

    def prior_rows(self, theta: np.ndarray) -> np.ndarray:
        """The rows of all priors (..., rows, p+1) at `theta` (..., p), in the residuals' units."""
        rows = [prior.rows(self.parameters, self.free, theta) for prior in self.prior]
        none = np.zeros((*theta.shape[:-1], 0, theta.shape[-1] + 1))
        return np.concatenate([none, *rows], axis=-2) * np.sqrt(self.prior_noise_variance)

    @property
    def weighs_prior(self) -> bool:
        """Whether a prior is weighed by the variance that the residuals tell."""
        return bool(self.prior) and not self.noise_is_given

    def minimise(
        self,
        level: Level,
        tolerance: LeastGain,
        start: Point,
        gap_sigma: np.ndarray | None = None,
    ) -> "FitResult":
        """The minimum, from a start, to a `tolerance` in variances of a residual."""
        if self.checkpoint is not None:
            start = self.checkpoint.begin(start)
        point, linearised, converged = minimise(
            lambda theta, states, robust_damping: self.linearise(
                level, theta, states, gap_sigma, robust_damping
            ),
            lambda states, own: states.moved(own),
            start,
            self.free.lower,
            self.free.upper,
            self.free.max_step,
            self._names(level),
            lambda linearised: LeastGain(*(least_gain(gain, linearised) for gain in tolerance)),
            self.iterations,
            self._began,
        )
        return FitResult(self, level, point, linearised, gap_sigma, converged, point.iteration)

    def _began(self, point: Point, cost: float) -> None:
        """An iteration begins."""
        self.report.iteration(cost, point.theta)
        if self.checkpoint is not None:
            self.checkpoint.keep(point)

    def _names(self, level: Level) -> list[str]:
        """The name of the trajectory of each window; with the configuration, if there are some."""
        configurations, names = self.configurations, []
        for k, window in level.keys:
            name = configurations[k].recordings.names[window.trajectory]
            several = len(configurations) > 1
            names.append(f"{configurations[k].name}: {name}" if several else name)
        return names

    def count_unknowns(self, level: Level, start: Point) -> float:
        """Number of all unknowns: the common ones, and the own ones of each window."""
        own = start.states.unknowns * level.number
        return len(start.theta) + self.processes.sum(own).item()

    def minimise_whole(
        self, level: Level, start: Point, gap_sigma: np.ndarray | None
    ) -> "FitResult":
        """The minimum of whole trajectories, with closed gaps between their segments."""
        if gap_sigma is None:
            # In all no more than what does not matter where costs are compared.
            in_all = min(FINAL * self.count_unknowns(level, start), COARSE)
            enough = LeastGain(in_all, FINAL * len(start.theta))
            result = self.minimise(level, enough, start)
        else:
            result = self._close_gaps(level, start, gap_sigma)
        result.linearised = result.linearise_undamped()
        return result

    def _close_gaps(self, level: Level, start: Point, gap_sigma: np.ndarray) -> "FitResult":
        """The minimum with narrow gaps; not converged if these still cost too much."""
        iterations, narrowings = 0, 0
        while True:
            result = self.minimise(level, LeastGain(CLOSED_GAPS), start, gap_sigma)
            iterations += result.iterations
            linearised = result.linearised
            ratio = linearised.gap_cost / least_gain(CLOSED_GAPS, linearised)
            if ratio <= 1 or narrowings == MOST_NARROWINGS or not result.converged:
                result.converged = result.converged and bool(ratio <= 1)
                result.iterations = iterations
                return result
            start = Point(result.theta, result.states, start.damping)
            gap_sigma = gap_sigma / np.clip(2 * np.sqrt(ratio), *GAP_FACTORS)
            narrowings += 1


@dataclass(eq=False)
class FitResult:
    """The minimum of some windows, and what a fit learns of it; a fit ends in one."""

    problem: Problem  # with the prior weighed
    level: Level
    point: Point
    linearised: Linearised  # about the point
    gap_sigma: np.ndarray | None  # standard deviation of gaps between segments
    converged: bool
    iterations: int  # of the minimisations that led here
    # Variance of the residuals of whole trajectories over that of the shortest windows, which begin
    # with the shortest states.
    misfit_ratio: float = 1.0
    shortest_states: InitialStates | None = None
    step_bias: float = 0.0  # shift of the estimate by the step, in standard errors
    starts: int = 1  # from which it was fitted
    starts_that_agree: int = 1  # from which the fit ends in this minimum
    tried_states: bool = False  # whether initial states were tried, as no sensor tells them
    # What is known about the inertia of the start, if that fits as well.
    start_as_good: LinearPosterior | None = None

    def continue_from(self, before: "FitResult") -> None:
        """Take over the iterations of a fit before this one, and what that learned of starts."""
        self.iterations += before.iterations
        self.starts, self.starts_that_agree = before.starts, before.starts_that_agree
        self.tried_states = before.tried_states

    @property
    def theta(self) -> np.ndarray:
        """The free leaves."""
        return self.point.theta

    @property
    def states(self) -> InitialStates:
        """The states at the start of all windows."""
        return self.point.states

    @property
    def start_nearby(self) -> Point:
        """Where a minimisation of a similar problem may begin."""
        return Point(*self.point[:3])

    @property
    def stopped_early(self) -> bool:
        """Whether the fit was stopped as no fit can be good."""
        return self.problem.is_in_vain and not self.converged

    def linearise_undamped(self) -> Linearised:
        """The problem about the minimum, without the damping of robust losses."""
        problem = self.problem
        if not any(configuration.model.is_robust for configuration in problem.configurations):
            return self.linearised
        return problem.linearise(self.level, self.theta, self.states, self.gap_sigma)

    def cost_with(self, prior_noise_variance: float) -> float:
        """The whole cost, with a prior weighed by another variance of the noise."""
        weight = prior_noise_variance / self.problem.prior_noise_variance
        return self.linearised.cost + self.linearised.prior_cost * (weight - 1)

    @cached_property
    def information(self) -> Information:
        """What the minimum tells of the free leaves."""
        system, free = self.linearised.system, self.problem.free
        return compute_information(system, at_bounds(system, self.theta, free.lower, free.upper))

    @cached_property
    def freedom(self) -> int:
        """The degrees of freedom that the minimum leaves."""
        return round(self._freedom)

    @cached_property
    def _freedom(self) -> float:
        prior = self.linearised.system.of_prior()
        return degrees_of_freedom(self.linearised.number, self.information, prior)

    @property
    def variance(self) -> float:
        """The factor on the covariance for unit noise; rounding is no noise to weigh a prior by."""
        sums, number = self.linearised.loss_sums, self.linearised.number
        # Not rounded, or a prior and the noise that weighs the prior would alternate.
        variance = variance_factor(sums, number, self._freedom if self.freedom else 0)
        return max(variance, NO_NOISE) if self.problem.weighs_prior else variance

    @property
    def noise_variance(self) -> float:
        """The variance of the noise in units of the sensors' `sigma`: 1 if the noise is given."""
        return 1.0 if self.problem.noise_is_given else self.variance

    @property
    def noise_deviation(self) -> float:
        """The standard deviation of the noise, or of rounding, in units of the sensors' `sigma`."""
        variance = self.problem.processes.of_first(self.noise_variance)
        return float(np.sqrt(np.fmax(variance, NO_NOISE)))

    def length(self, shift: np.ndarray) -> float:
        """The length of a shift of the free leaves (p,), in standard errors for unit noise."""
        return float(self.problem.processes.of_first(self.information.length(shift)))

    def power_of_steps(self, order: float) -> float:
        """The integral over time, in all windows, of a power of the step."""
        return float(self.problem.processes.sum(self.level.power_of_steps(order)))

    @property
    def residual_variance(self) -> float:
        """The variance of the residuals."""
        return self.linearised.residual_cost / max(1, self.freedom)

    @property
    def prior_noise_variance(self) -> float:
        """The variance of the noise with which to weigh a prior, from the residuals."""
        if not self.problem.weighs_prior or not self.freedom:
            return self.problem.prior_noise_variance
        return self.variance

    def agrees_with(self, other: "FitResult") -> bool:
        """Whether they are one minimum: chi-square differs by no more than one residual's."""
        variance = min(x.problem.prior_noise_variance for x in (self, other))
        difference = abs(self.cost_with(variance) - other.cost_with(variance))
        return difference <= max(other.residual_variance, NO_NOISE)


def first_gap_sigma(linearised: Linearised) -> np.ndarray:
    """The root mean square at the gaps of turns, of changes of angular velocity, and of others."""
    m, count = linearised.system.unknowns, 0
    squares = np.zeros(m)
    for part in linearised.parts:
        if part.gaps is not None:
            gaps = part.gaps[part.chains.joined]
            squares, count = squares + np.sum(gaps**2, axis=0), count + len(gaps)
    *squares, count = linearised.system.processes.sum([*squares, count])
    sigma = np.sqrt(np.array(squares) / count)
    for group in (slice(0, 3), slice(3, 6)):
        sigma[group] = np.sqrt(np.mean(sigma[group] ** 2))
    # Where states agree from the start, as own leaves do: no narrower than rounding allows.
    return np.maximum(sigma, float(np.finfo(jax.dtypes.canonicalize_dtype(float)).eps) ** 0.5)


def least_gain(tolerance: float, problem: Linearised) -> float:
    """A gain of the cost that does not matter: a part of the variance of a residual."""
    eps = float(np.finfo(jax.dtypes.canonicalize_dtype(float)).eps)
    gain = max(tolerance, 30 * eps**0.5) * max(problem.residual_cost / problem.number, NO_NOISE)
    return max(gain, eps * problem.cost)  # which rounding makes


class AbstractAtMinimum:
    """What is computed about the minimum of whole trajectories, on first use."""

    def __init__(
        self,
        problem: Problem,
        longest_steps: Sequence[np.ndarray],
        states: InitialStates,
        known: Information,
        variance: float,
    ):
        """At the minimum of a problem, with the estimate in `problem.free`."""
        self.problem, self.longest_steps, self.states = problem, longest_steps, states
        self.known, self.variance = known, variance

    def require_noise(self, missing: str) -> None:
        """Check that chi-square is known, with the size of the noise.

        Raises
        ------
        ValueError
            If several processes fit together, or no more was read than is fitted. It says what is
            `missing`, such as "there are no draws".
        """
        if self.problem.processes.are_several:
            raise ValueError(f"Where several processes fit together {missing}.")
        if not np.isfinite(self.variance):
            raise ValueError(
                f"{missing.capitalize()} where no more was read than is fitted, as that does not "
                'tell the size of the noise: fit with `noise="given"`, or more readings.'
            )


class SimulatedReadings:
    """Residuals and predictions at a point, simulated when they are asked for.

    Memory may not hold all readings: those of more steps than are in memory are not kept.
    """

    def __init__(self, problem: Problem, level: Level, theta: np.ndarray, states: InitialStates):
        """At `theta` and the `states` of the windows."""
        self._problem, self._level, self._theta, self._states = problem, level, theta, states
        self._kept: dict[int, Followed] = {}

    def of_configuration(self, number: int, which: Which) -> ReadingArrays:
        """Residuals or predictions of all readings of a configuration, in their order."""
        parts = [readings for _, readings in self.in_parts(number, which)]
        if len(parts) == 1:
            return parts[0]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def in_parts(self, number: int, which: Which) -> Iterator[tuple[Recordings, ReadingArrays]]:
        """Residuals or predictions of a part of the trajectories after another, with recordings."""
        chains = self._level.chains[number]
        parts = -(-int(np.sum(chains.steps)) // chains.sizes.at_once)
        if parts <= 1:
            if number not in self._kept:
                self._kept[number] = self._follow(number, np.arange(chains.number))
            yield chains.recordings, getattr(self._kept[number], which)
            return
        for trajectories in np.array_split(np.unique(chains.trajectory), parts):
            if len(trajectories):
                windows = np.flatnonzero(np.isin(chains.trajectory, trajectories))
                recordings = chains.recordings.only(trajectories)
                yield recordings, getattr(self._follow(number, windows), which)

    def _follow(self, number: int, windows: np.ndarray) -> Followed:
        problem, level = self._problem, self._level
        at = problem.configurations[number].at(problem.parameters, problem.free, self._theta)
        states = self._states.at(level.parts[number].start + windows)
        chains = level.chains[number].only(windows)
        return follow(at, states, chains, problem.methods[number], problem.mesh)
