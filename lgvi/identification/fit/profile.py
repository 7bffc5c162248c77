"""Profiles of chi-square: the least one where a number is held at other values.

D. J. Venzon & S. H. Moolgavkar, "A method for computing profile-likelihood-based confidence
intervals", Appl. Stat. 37 (1988), doi:10.2307/2347496. The number is held by a prior about a value.
Whatever the width of the prior is, the minimum with it is on the profile, at the number that the
minimum has; so the width need not be tiny, and the profile is exact.
"""

from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..model.free_leaves import Quantity, linearise_quantity
from ..model.prior import Prior
from ..running.progress import show_progress
from ..segments.levels import whole_level
from ..solver.levenberg_marquardt import NotSimulatedError, Point
from ..uncertainty.posterior import Spread
from .problem import AbstractAtMinimum, FitResult, Problem

WIDTH = 0.01  # of the prior that holds the number, in standard errors
ENOUGH = 1e-3  # relative error, at most, of the root of the rise of chi-square, at an end
MOST_FITS = 25  # for each end
MOST_ITERATIONS = 15  # of a fit, which starts near its minimum
MOST_CONTINUED = 8  # times that a fit goes on that has not converged
GROWTH = 3.0  # of the distance from the estimate, at most, from fit to fit
FARTHEST = 1e3  # half widths of the interval by the standard error, that an end is followed to
STUCK = 0.1  # part of a step that the number makes, at least, where it can go on
MOST_HALVINGS = 5  # of a step after which a fit does not converge
BETTER = 0.05  # variances of a residual by which chi-square may be below the minimum by rounding


class Profile(eqx.Module):
    """The interval of a number, by the profile of chi-square; see `profile` of an estimate.

    Attributes
    ----------
    value
        The number at the estimate.
    lower, upper
        The ends of the interval; infinite where chi-square does not rise enough as far as it was
        followed.
    level
        The probability.
    threshold
        How much chi-square is above its minimum at the ends.
    values
        The numbers at which chi-square was found (n,), rising.
    rises
        How much the least chi-square is above its minimum there (n,).
    """

    value: float
    lower: float
    upper: float
    level: float
    threshold: float
    values: Float[np.ndarray, " n"]
    rises: Float[np.ndarray, " n"]

    def __str__(self) -> str:
        if len(self.values) == 1:
            return "not observable"
        words = f"{100 * self.level:g} % interval: {self.lower:.6g} to {self.upper:.6g}"
        for end, k in ((self.lower, 0), (self.upper, -1)):
            if np.isinf(end):
                words += (
                    f"; followed to {self.values[k]:.6g}, where chi-square is "
                    f"{self.rises[k]:.4g} above its minimum, less than {self.threshold:.4g}"
                )
        return words


def require_number(quantity: Any, parameters: Any) -> Quantity:
    """Check that a function of the parameters gives one number.

    Raises
    ------
    TypeError, ValueError
        If it is no function, or gives something else.
    """
    if not callable(quantity):
        raise TypeError(
            "Argument `quantity` must be a function of the model that gives one number, but is "
            f"{quantity!r}."
        )
    sizes = [np.size(leaf) for leaf in jax.tree.leaves(quantity(parameters))]
    if sum(sizes) != 1:
        raise ValueError(
            f"Argument `quantity` must be a function that gives one number, but gives {sum(sizes)}."
        )
    return quantity


class Profiles(AbstractAtMinimum):
    """Profiles of chi-square about the minimum of a fit."""

    @show_progress("profile")
    def follow(self, quantity: Quantity, value: float, spread: Spread, level: float) -> Profile:
        """The interval of a number; `spread` (1,) is that by the standard error.

        Raises
        ------
        ValueError
            If several processes fit together, or no more was read than is fitted.
        RuntimeError
            If a fit does not converge, or fits better than the estimate.
        """
        self.require_noise("there is no profile")
        error, half = float(spread.error[0]), float(spread.upper[0]) - value
        if error == 0:
            raise ValueError(
                "Argument `quantity` must depend on what is free, and not on leaves at a bound "
                f"alone, but is always {value:.6g}."
            )
        if not np.isfinite(error):
            return Profile(value, -np.inf, np.inf, level, np.nan, np.array([value]), np.zeros(1))
        threshold = self.variance * (half / error) ** 2
        path = _Path(self, quantity, value, error, threshold)
        lower, of_lower = path.find_end(-half)
        upper, of_upper = path.find_end(half)
        values, rises = np.array(sorted([*of_lower, (value, 0.0), *of_upper])).T
        return Profile(value, lower, upper, level, threshold, values, rises)


class ProfilePoint(NamedTuple):
    """A minimum on the profile."""

    aim: float  # at which the number was held
    number: float
    root: float  # of how much chi-square is above its minimum
    point: Point


class _Path:
    """Minima with the number held at values ever farther from the estimate."""

    def __init__(
        self, profiles: Profiles, quantity: Quantity, value: float, error: float, threshold: float
    ):
        problem = self.problem = replace(profiles.problem, blocks=1, iterations=MOST_ITERATIONS)
        self.quantity, self.variance, self.threshold = quantity, profiles.variance, threshold
        # In the units of chi-square, in which the prior of a fit is weighed.
        self.deviation = WIDTH * error * np.sqrt(problem.prior_noise_variance / self.variance)
        self.level = whole_level(problem.configurations, profiles.longest_steps)
        start = Point(problem.free.theta, profiles.states)
        self.least = problem.cost(self.level, start.theta, start.states)
        self.first = ProfilePoint(value, value, 0.0, start)

    def find_end(self, half: float) -> tuple[float, list[tuple[float, float]]]:
        """The end, about `half` away, and the numbers on the way with the rises of chi-square.

        The root of the rise is nearly linear in what the number is held at, and so the secant finds
        the end.
        """
        below, above, last = self.first, None, self.first
        root, path = float(np.sqrt(self.threshold)), []
        aim = self.first.aim + half
        for _ in range(MOST_FITS):
            at = self._minimise(last, aim)
            if at is None:
                return float(np.copysign(np.inf, half)), path
            path.append((at.number, at.root**2))
            if abs(at.root - root) <= ENOUGH * root:
                return at.number, path
            before, last = last, at
            if at.root > root:
                above = at
            else:
                moved = (at.number - below.number) / (at.aim - below.number)
                distance = (at.number - self.first.number) / half
                if above is None and (moved < STUCK or distance > FARTHEST):
                    return float(np.copysign(np.inf, half)), path
                below = at
            aim = self._next(before, last, below, above, root)
        raise RuntimeError(
            f"The profile does not find its end near {last.number:.6g}: the quantity has no "
            "derivative there, as a moment has none that becomes equal to another, or chi-square "
            "is not continuous. Use `sample`."
        )

    def _next(
        self,
        before: ProfilePoint,
        last: ProfilePoint,
        below: ProfilePoint,
        above: ProfilePoint | None,
        root: float,
    ) -> float:
        """Where the secant has the root; within the bracket, or no farther than it may grow."""
        slope = (last.root - before.root) / (last.aim - before.aim)
        aim = last.aim + (root - last.root) / slope if slope else np.inf
        if above is None:
            most = GROWTH * (last.aim - self.first.aim)
            part = (aim - last.aim) / most
            return aim if 0 < part < 1 - 1 / GROWTH else self.first.aim + most
        inside = min(below.aim, above.aim) < aim < max(below.aim, above.aim)
        return aim if inside else (below.aim + above.aim) / 2

    def _minimise(self, start: ProfilePoint, aim: float) -> ProfilePoint | None:
        """The minimum with the number held at a value, or nearer to the start if that fails.

        None where the number does not go on, however much chi-square may rise: no model has such a
        number.
        """
        for _ in range(MOST_HALVINGS):
            held = Prior(
                self.quantity, ("the number",), np.array([aim]), np.array([self.deviation])
            )
            problem = replace(self.problem, prior=[*self.problem.prior, held])
            with suppress(NotSimulatedError):
                at, is_minimum = self._descend(problem, start.point, aim)
                moved = (at.number - start.number) / (aim - start.number)
                if is_minimum:
                    return at
                if 0 < moved < STUCK and at.root < np.sqrt(self.threshold):
                    return None
            aim = (start.aim + aim) / 2
        raise RuntimeError(
            f"The fit with the number held near {aim:.6g} does not converge, and so there is no "
            "profile: give the fit a `prior` or `bounds` for what is known roughly."
        )

    def _descend(self, problem: Problem, start: Point, aim: float) -> tuple[ProfilePoint, bool]:
        """Where a fit ends, and whether that is a minimum.

        Where a second moment vanishes its logarithm has no end, and a fit does not converge; but
        chi-square does.
        """
        result = problem.minimise_whole(self.level, start, None)
        at = self._at(result, aim)
        for _ in range(MOST_CONTINUED):
            if result.converged:
                return at, True
            before = at
            result = problem.minimise_whole(self.level, before.point, None)
            at = self._at(result, aim)
            if abs(at.root - before.root) <= ENOUGH / 10 * np.sqrt(self.threshold):
                return at, True
        return at, result.converged

    def _at(self, result: FitResult, aim: float) -> ProfilePoint:
        problem, theta = self.problem, result.theta
        values, _ = linearise_quantity(self.quantity, problem.parameters, problem.free, theta)
        rise = problem.cost(self.level, theta, result.states) - self.least
        rounding = float(jnp.finfo(jax.dtypes.canonicalize_dtype(float)).eps) * self.least
        if rise < -max(BETTER * self.variance, rounding):
            raise RuntimeError(
                f"With the number near {values[0]:.6g} the model fits better than the estimate, by "
                f"{-rise:.3g} of chi-square, which is no minimum then: fit again from there."
            )
        return ProfilePoint(
            aim, float(values[0]), float(np.sqrt(max(rise, 0.0))), result.start_nearby
        )
