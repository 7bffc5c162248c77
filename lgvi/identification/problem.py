"""What is fitted to recordings: the least-squares problem of all configurations on any windows."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import numpy as np

from ..modules.integrator import MoserVeselovIntegrator
from .least_squares.levenberg_marquardt import Minimum, minimise
from .least_squares.linearise import Linearised, join_parts, linearise_part
from .least_squares.multiple_shooting import CLOSED, close_gaps
from .model.configuration import Configuration
from .model.free import Free
from .model.prior import Prior
from .model.states import InitialStates
from .progress import Progress
from .uncertainty.noise import NO_NOISE, number_of_residuals
from .windows.level import Level

FINAL = 1e-6  # gain of a next step at most, in variances of a residual


@dataclass
class FitProblem:
    """Configurations to be fitted by an integrator each; the methods take some windows."""

    parameters: Any
    free: Free
    configurations: Sequence[Configuration]
    methods: Sequence[MoserVeselovIntegrator]
    prior: Sequence[Prior] = ()
    unit: float = 1.0  # variance of the noise, with which a prior is weighed against residuals
    iterations: int = 100
    report: Progress = field(default_factory=Progress)
    blocks: int = 1  # of time, in each window
    compiled: set[tuple[int, ...]] = field(default_factory=set)  # shapes

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
            given = states.at(part), layout, method, width, caution, self.blocks
            parts.append(linearise_part(at, *given))
        return join_parts(parts, theta, self.prior_rows(theta))

    def prior_rows(self, theta: np.ndarray) -> np.ndarray:
        """The rows of all priors (rows, p+1), in the units of the residuals."""
        rows = [each.rows(self.parameters, self.free, theta) for each in self.prior]
        return np.concatenate([np.zeros((0, len(theta) + 1)), *rows]) * np.sqrt(self.unit)

    def number_of_residuals(self, level: Level) -> int:
        """Number of scalar residuals of all readings."""
        return sum(
            number_of_residuals(configuration.model, layout)
            for configuration, layout in zip(self.configurations, level.layouts, strict=True)
        )

    def least_gain(self, level: Level, tolerance: float, cost: float) -> float:
        """A gain of the cost that does not matter: a part of the variance of a residual."""
        rounding = 30 * float(np.finfo(jax.dtypes.canonicalize_dtype(float)).eps) ** 0.5
        variance = cost / self.number_of_residuals(level)
        return max(tolerance, rounding) * max(variance, NO_NOISE)

    def minimise(
        self,
        level: Level,
        tolerance: float,
        theta: np.ndarray,
        states: InitialStates,
        width: np.ndarray | None = None,
    ) -> Minimum:
        """The minimum, from a start."""
        shapes = {
            x.shape[1:]
            for layout in level.layouts
            for _, part in layout.parts
            for x in jax.tree.leaves(part)
        }
        if not shapes <= self.compiled:
            self.compiled |= shapes
            self.report.compiling()
        return minimise(
            lambda theta, states, caution: self.linearise(level, theta, states, width, caution),
            lambda states, own: states.moved(own),
            theta,
            states,
            self.free.lower,
            self.free.upper,
            self.free.max_step,
            self._names(level),
            partial(self.least_gain, level, tolerance),
            self.iterations,
            self.report,
        )

    def _names(self, level: Level) -> list[str]:
        """The name of the trajectory of each window; with the configuration, if there are some."""
        configurations, found = self.configurations, []
        for k, window in level.keys:
            name = configurations[k].recordings.names[window.trajectory]
            several = len(configurations) > 1
            found.append(f"{configurations[k].name}: {name}" if several else name)
        return found

    def minimise_whole(
        self, level: Level, theta: np.ndarray, states: InitialStates, width: np.ndarray | None
    ) -> tuple[Minimum, np.ndarray | None]:
        """The minimum of whole trajectories, with closed gaps between their segments."""
        if width is None:
            found = self.minimise(level, FINAL, theta, states)
        else:
            found, width = close_gaps(
                partial(self.minimise, level, CLOSED),
                theta,
                states,
                width,
                partial(self.least_gain, level, CLOSED),
            )
        if any(each.model.is_robust for each in self.configurations):  # without caution
            about = self.linearise(level, found.theta, found.states, width)
            found = found._replace(problem=about)
        return found, width
