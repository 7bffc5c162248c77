"""The estimate of parameters after a fit, and its errors."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from ..diagnosis.suspects import ScoreTests
from ..fit.bootstrap import Bootstrap
from ..fit.part import FittedPart
from ..model.free_leaves import Free, Quantity
from ..model.prior import Prior
from ..uncertainty.information import Information
from ..uncertainty.posterior import (
    AbstractPosterior,
    Errors,
    Independent,
    LinearErrors,
    Spread,
    require_errors,
    spread_about,
)
from ..uncertainty.report_table import make_table
from ..uncertainty.sandwich import Sandwich


class AbstractEstimate(AbstractPosterior):
    """The most likely values of free leaves, with their covariance; see `JointEstimate`."""

    parameters: Any
    parts: dict[str, FittedPart]
    converged: bool
    iterations: int
    chi_square: float
    degrees_of_freedom: int
    step_bias: float
    unobservable: tuple[str, ...]
    messages: tuple[str, ...]
    mistakes: tuple[str, ...]
    reasons: tuple[str, ...]
    errors: Errors
    reason: str
    variance: float
    prior: tuple[Prior, ...]
    scaled: tuple[str, ...]
    free: Free
    information: Information
    independent: Independent
    clustered: Sandwich
    correlated: Sandwich
    bootstrap: Bootstrap
    score_tests: ScoreTests

    @property
    def trajectories(self) -> int:
        """Number of trajectories of all configurations, and of all processes that fit together."""
        return len(self.clustered.influence)

    def covariance(
        self, quantity: Quantity | None = None, errors: Errors | None = None
    ) -> Float[np.ndarray, "n n"]:
        r"""Covariance of a quantity.

        It is $G\,C\,G^T$ with the Jacobian $G$ of the quantity (the delta method), or the
        covariance of the values in all draws of a bootstrap.

        Parameters
        ----------
        quantity
            A function of the model that gives an array or a pytree of arrays, which is raveled to
            n numbers, such as `lambda model: model.body.inertia`. By default the free leaves.
        errors
            The kind of errors, as for [`identify`][lgvi.identification.identify]. By default the
            kind of the report.

        Returns
        -------
        numpy.ndarray
            Covariance (n, n). A number that is not observable has infinite variance, and NaN for
            its covariances.

        Raises
        ------
        ValueError
            For a kind of errors that one trajectory does not have.
        """
        kind = self.require_kind(errors)
        _, jacobian = self.linearise(quantity)
        if kind != "bootstrap":
            return self._linear_errors(kind).covariance_of(jacobian)
        draws = self._drawn(quantity)
        covariance = np.cov(draws, rowvar=False, ddof=1).reshape(jacobian.shape[:1] * 2)
        return self.information.without_unknown(jacobian, covariance)

    def covariance_of(self, jacobian: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "n n"]:
        """Covariance (n, n) of numbers with a Jacobian in the free leaves, of the report's kind."""
        kind = self.require_kind(None)
        if kind != "bootstrap":
            return self._linear_errors(kind).covariance_of(jacobian)
        return np.atleast_2d(np.cov(self.converged_draws @ jacobian.T, rowvar=False, ddof=1))

    def standard_error(self, quantity: Quantity | None = None, errors: Errors | None = None) -> Any:
        """Standard error of a quantity, in its shape; infinite where it is not observable.

        Parameters
        ----------
        quantity, errors
            As for `covariance`. By default the free leaves: a model with them alone.
        """
        return self.shaped(quantity, np.sqrt(np.diag(self.covariance(quantity, errors))))

    def interval(
        self,
        quantity: Quantity | None = None,
        errors: Errors | None = None,
        level: float = 0.95,
    ) -> tuple[Any, Any]:
        r"""Lower and upper ends of intervals that contain the true values with a probability.

        From the quantiles of Student's $t$ with the degrees of freedom that the standard error
        has; with `"bootstrap"` from the quantiles of the draws.

        Parameters
        ----------
        quantity, errors
            As for `covariance`.
        level
            The probability, between 0 and 1.

        Returns
        -------
        tuple
            The ends, each in the shape of the quantity; infinite where it is not observable.
        """
        if not 0 < level < 1:
            raise ValueError(
                f"Argument `level` must be a probability between 0 and 1, but is {level!r}."
            )
        values, jacobian = self.linearise(quantity)
        spread = self._spread(values, jacobian, lambda: self._drawn(quantity), errors, level)
        return self.shaped(quantity, spread.lower), self.shaped(quantity, spread.upper)

    def spread_of(
        self,
        values: Float[np.ndarray, " n"],
        jacobian: Float[np.ndarray, "n p"],
        of_leaves: Callable[[np.ndarray], np.ndarray],
    ) -> Spread:
        """How well numbers are known; see `AbstractPosterior`."""
        return self._spread(values, jacobian, lambda: of_leaves(self.converged_draws), None, 0.95)

    def _spread(
        self,
        values: np.ndarray,
        jacobian: np.ndarray,
        drawn: Callable[[], np.ndarray],
        errors: Errors | None,
        level: float,
    ) -> Spread:
        kind = self.require_kind(errors)
        if kind != "bootstrap":
            return spread_about(values, jacobian, self._linear_errors(kind), level)
        draws, unknown = drawn(), self.information.unknown(jacobian)
        ends = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2], axis=0)
        lower, upper = np.where(unknown, [[-np.inf], [np.inf]], ends)
        error = np.where(unknown, np.inf, np.std(draws, axis=0, ddof=1))
        return Spread(error, lower, upper, np.full(len(error), np.nan))

    def require_kind(self, errors: Errors | None) -> Errors:
        """The kind of standard errors, by default that of the report, checked."""
        kind = self.errors if errors is None else errors
        counts = [len(part.recordings) for part in self.parts.values()]
        require_errors(kind, counts, self.trajectories)
        return kind

    def _linear_errors(self, kind: Errors) -> LinearErrors:
        kinds: dict[str, LinearErrors] = {
            "independent": self.independent,
            "clustered": self.clustered,
            "correlated": self.correlated,
        }
        return kinds[kind]

    @property
    def converged_draws(self) -> np.ndarray:
        """The free leaves of each draw of the bootstrap whose fit converged (draws, p)."""
        draws = self.bootstrap.draws
        return draws[np.all(np.isfinite(draws), axis=1)]

    def _drawn(self, quantity: Quantity | None) -> np.ndarray:
        """The quantity, raveled to n numbers, in each draw (draws, n)."""
        draws = self.converged_draws
        return draws if quantity is None else self.evaluate(quantity, draws)

    def summary(self) -> dict[str, np.ndarray]:
        """The table of the report, as a dictionary of its columns.

        Returns
        -------
        dict
            `name`, `value`, `standard_error`, `lower` and `upper` end of the 95 % interval, `unit`,
            and `interval_freedom`, the degrees of freedom of Student's t, each an array (numbers,).
            A standard error is infinite for a number that is not observable, and NaN for a number
            that is at its bound. The degrees of freedom of a bootstrap are NaN, as its intervals
            are quantiles of draws.
        """
        return make_table(self).as_arrays()
