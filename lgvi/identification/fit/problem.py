"""What is fitted to recordings: the least-squares problem of all configurations on any windows."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
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
from ..running.processes import ALONE, Together
from ..running.progress import Progress
from ..segments.chain import Followed, OfReadings, Which, follow
from ..segments.levels import Level
from ..solver.checkpoint import Checkpoint
from ..solver.levenberg_marquardt import (
    CLOSED,
    FIRST,
    Minimum,
    Point,
    at_bounds,
    close_gaps,
    minimise,
)
from ..solver.linearise import Linearised, join_parts, linearise_part
from ..uncertainty.information import (
    NO_NOISE,
    Information,
    compute_information,
    degrees_of_freedom,
    variance_factor,
)

COARSE, FINAL = 1e-2, 1e-6  # gain of a next step at most, in variances of a residual


@dataclass
class FitProblem:
    """Configurations to be fitted by an integrator each; the methods take some windows."""

    parameters: Any
    free: Free
    configurations: Sequence[Configuration]
    methods: Sequence[MoserVeselovIntegrator]
    prior: Sequence[Prior] = ()
    noise_is_given: bool = False
    unit: float = 1.0  # variance of the noise, with which a prior is weighed against residuals
    iterations: int = 100
    report: Progress = field(default_factory=Progress)
    blocks: int = 1  # of time, in each window
    checkpoint: Checkpoint | None = None
    mesh: Mesh | None = None
    together: Together = ALONE  # processes with configurations that have other recordings

    def linearise(
        self,
        level: Level,
        theta: np.ndarray,
        states: InitialStates,
        width: np.ndarray | None = None,
        caution: float = 0.0,
    ) -> Linearised:
        """The problem about a point, with gaps between segments of some width."""
        parts = []
        for configuration, method, layout, part in zip(
            self.configurations, self.methods, level.layouts, level.parts, strict=True
        ):
            at = configuration.at(self.parameters, self.free, theta)
            given = states.at(part), layout, method, width, caution, self.blocks, self.mesh
            parts.append(linearise_part(at, *given))
        return join_parts(parts, theta, self.prior_rows(theta), self.together)

    def prior_rows(self, theta: np.ndarray) -> np.ndarray:
        """The rows of all priors (..., rows, p+1) at `theta` (..., p), in the residuals' units."""
        rows = [each.rows(self.parameters, self.free, theta) for each in self.prior]
        none = np.zeros((*theta.shape[:-1], 0, theta.shape[-1] + 1))
        return np.concatenate([none, *rows], axis=-2) * np.sqrt(self.unit)

    @property
    def weighs_prior(self) -> bool:
        """Whether a prior is weighed by the variance that the residuals tell."""
        return bool(self.prior) and not self.noise_is_given

    def information(self, found: Minimum) -> Information:
        """What a minimum tells of the free leaves."""
        system, free = found.problem.system, self.free
        return compute_information(system, at_bounds(system, found.theta, free.lower, free.upper))

    def freedom(self, found: Minimum, known: Information) -> int:
        """The degrees of freedom that a minimum leaves."""
        problem = found.problem
        return degrees_of_freedom(problem.number, known, problem.system.of_prior())

    def variance(self, found: Minimum, freedom: int) -> float:
        """The factor on the covariance for unit noise; rounding is no noise to weigh a prior by."""
        variance = variance_factor(found.problem.spread, found.problem.number, freedom)
        return max(variance, NO_NOISE) if self.weighs_prior else variance

    def residual_variance(self, found: Minimum) -> float:
        """The variance of the residuals at a minimum."""
        cost = found.problem.cost - found.problem.prior_cost
        return cost / max(1, self.freedom(found, self.information(found)))

    def find_unit(self, found: Minimum) -> float:
        """The variance of the noise with which to weigh a prior, from the residuals."""
        if not self.weighs_prior:
            return self.unit
        freedom = self.freedom(found, self.information(found))
        if not freedom:
            return self.unit
        return self.variance(found, freedom)

    def minimise(
        self,
        level: Level,
        tolerance: float,
        theta: np.ndarray,
        states: InitialStates,
        width: np.ndarray | None = None,
        damping: float = FIRST,
    ) -> Minimum:
        """The minimum, from a start."""
        point = Point(theta, states, scale=np.zeros_like(theta), damping=damping)
        if self.checkpoint is not None:
            point = self.checkpoint.begin(point)
        return minimise(
            lambda theta, states, caution: self.linearise(level, theta, states, width, caution),
            lambda states, own: states.moved(own),
            point,
            self.free.lower,
            self.free.upper,
            self.free.max_step,
            self._names(level),
            partial(least_gain, tolerance),
            self.iterations,
            self._began,
        )

    def _began(self, point: Point, cost: float) -> None:
        """An iteration begins."""
        self.report.iteration(cost, point.theta)
        if self.checkpoint is not None:
            self.checkpoint.keep(point)

    def _names(self, level: Level) -> list[str]:
        """The name of the trajectory of each window; with the configuration, if there are some."""
        configurations, found = self.configurations, []
        for k, window in level.keys:
            name = configurations[k].recordings.names[window.trajectory]
            several = len(configurations) > 1
            found.append(f"{configurations[k].name}: {name}" if several else name)
        return found

    def minimise_whole(
        self,
        level: Level,
        theta: np.ndarray,
        states: InitialStates,
        width: np.ndarray | None,
        damping: float,
    ) -> tuple[Minimum, np.ndarray | None]:
        """The minimum of whole trajectories, with closed gaps between their segments."""
        if width is None:
            found = self.minimise(level, FINAL, theta, states, None, damping)
        else:
            found, width = close_gaps(
                partial(self.minimise, level, CLOSED, damping=damping),
                theta,
                states,
                width,
                partial(least_gain, CLOSED),
            )
        if any(each.model.is_robust for each in self.configurations):  # without caution
            about = self.linearise(level, found.theta, found.states, width)
            found = found._replace(problem=about)
        return found, width


def least_gain(tolerance: float, problem: Linearised) -> float:
    """A gain of the cost that does not matter: a part of the variance of a residual."""
    rounding = 30 * float(np.finfo(jax.dtypes.canonicalize_dtype(float)).eps) ** 0.5
    return max(tolerance, rounding) * max(problem.cost / problem.number, NO_NOISE)


class Simulated:
    """The minimum of some windows, which are simulated again: memory may not hold all readings."""

    def __init__(self, problem: FitProblem, level: Level, theta: np.ndarray, states: InitialStates):
        """At `theta` and the `states` of the windows."""
        self._problem, self._level, self._theta, self._states = problem, level, theta, states
        self._kept: dict[int, Followed] = {}

    def of_configuration(self, number: int, which: Which) -> OfReadings:
        """Something of all readings of a configuration, in their order."""
        parts = [found for _, found in self.in_parts(number, which)]
        if len(parts) == 1:
            return parts[0]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def in_parts(self, number: int, which: Which) -> Iterator[tuple[Recordings, OfReadings]]:
        """The same of some trajectories after others, with the recordings of these."""
        layout, recordings = (
            self._level.layouts[number],
            self._problem.configurations[number].recordings,
        )
        parts = -(-int(np.sum(layout.steps)) // layout.sizes.at_once)
        if parts <= 1:
            if number not in self._kept:
                self._kept[number] = self._follow(number, np.arange(layout.number))
            yield recordings, getattr(self._kept[number], which)
            return
        trajectory = np.array([window.trajectory for window in layout.windows])
        for some in np.array_split(np.unique(trajectory), parts):
            if len(some):
                windows = np.flatnonzero(np.isin(trajectory, some))
                yield recordings.only(some), getattr(self._follow(number, windows), which)

    def _follow(self, number: int, windows: np.ndarray) -> Followed:
        problem, level = self._problem, self._level
        at = problem.configurations[number].at(problem.parameters, problem.free, self._theta)
        states = self._states.at(level.parts[number].start + windows)
        chains = level.layouts[number].only(windows)
        return follow(at, states, chains, problem.methods[number], problem.mesh)
