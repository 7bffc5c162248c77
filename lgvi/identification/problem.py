"""A model to be fitted to recordings: its least-squares problem on any windows."""

from dataclasses import dataclass, field
from functools import partial

import jax
import numpy as np

from ..modules.integrator import MoserVeselovIntegrator
from .data.recordings import Recordings
from .least_squares.levenberg_marquardt import Minimum, minimise
from .least_squares.linearise import Linearised, linearise
from .least_squares.multiple_shooting import CLOSED, close_gaps
from .model.free import Free
from .model.model import Model
from .model.states import InitialStates
from .progress import Progress
from .uncertainty.noise import NO_NOISE, number_of_residuals
from .windows.grid import Window
from .windows.layout import Layout

FINAL = 1e-6  # gain of a next step at most, in variances of a residual


@dataclass
class FitProblem:
    """A model to be fitted to recordings by an integrator; the methods take some windows."""

    model: Model
    free: Free
    recordings: Recordings
    method: MoserVeselovIntegrator
    iterations: int
    report: Progress
    blocks: int = 1  # of time, in each window
    compiled: set[tuple[int, ...]] = field(default_factory=set)  # shapes

    def linearise(
        self,
        layout: Layout,
        theta: np.ndarray,
        states: InitialStates,
        width: np.ndarray | None = None,
        caution: float = 0.0,
    ) -> Linearised:
        """The problem about a point, with gaps between segments of some width."""
        given = theta, states, layout, self.method, width, caution, self.blocks
        return linearise(self.model, self.free, *given)

    def least_gain(self, layout: Layout, tolerance: float, cost: float) -> float:
        """A gain of the cost that does not matter: a part of the variance of a residual."""
        rounding = 30 * float(np.finfo(jax.dtypes.canonicalize_dtype(float)).eps) ** 0.5
        variance = cost / number_of_residuals(self.model, layout)
        return max(tolerance, rounding) * max(variance, NO_NOISE)

    def minimise(
        self,
        layout: Layout,
        windows: list[Window],
        tolerance: float,
        theta: np.ndarray,
        states: InitialStates,
        width: np.ndarray | None = None,
    ) -> Minimum:
        """The minimum, from a start."""
        shapes = {x.shape[1:] for _, part in layout.parts for x in jax.tree.leaves(part)}
        if not shapes <= self.compiled:
            self.compiled |= shapes
            self.report.compiling()
        return minimise(
            lambda theta, states, caution: self.linearise(layout, theta, states, width, caution),
            lambda states, own: states.moved(own),
            theta,
            states,
            self.free.lower,
            self.free.upper,
            self.free.max_step,
            [self.recordings.names[window.trajectory] for window in windows],
            partial(self.least_gain, layout, tolerance),
            self.iterations,
            self.report,
        )

    def minimise_whole(
        self,
        layout: Layout,
        windows: list[Window],
        theta: np.ndarray,
        states: InitialStates,
        width: np.ndarray | None,
    ) -> tuple[Minimum, np.ndarray | None]:
        """The minimum of whole trajectories, with closed gaps between their segments."""
        if width is None:
            found = self.minimise(layout, windows, FINAL, theta, states)
        else:
            found, width = close_gaps(
                partial(self.minimise, layout, windows, CLOSED),
                theta,
                states,
                width,
                partial(self.least_gain, layout, CLOSED),
            )
        if self.model.is_robust:  # without caution
            about = self.linearise(layout, found.theta, found.states, width)
            found = found._replace(problem=about)
        return found, width
