"""The estimate of parameters after a fit, and its errors."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from ..checks import require_key
from ..diagnosis.suspects import ScoreTests
from ..fit.bootstrap import Bootstrap
from ..fit.part import FittedPart
from ..fit.profile import Profile, Profiles, require_number
from ..fit.sampler import Sampler, require_draws
from ..model.free_leaves import Free, Quantity
from ..model.prior import Prior
from ..uncertainty.draws import PosteriorDraws, diagnose, require_convergence
from ..uncertainty.information import Information
from ..uncertainty.posterior import (
    AbstractPosterior,
    Errors,
    Independent,
    LinearErrors,
    Spread,
    require_errors,
    require_level,
    spread_about,
    spread_of_draws,
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
    sampler: Sampler
    profiles: Profiles

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
        require_level(level)
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
        return spread_of_draws(drawn(), self.information.unknown(jacobian), level)

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

    def sample(self, draws: int, key: Array) -> PosteriorDraws:
        r"""Draws of the posterior of the free leaves, by the No-U-Turn Sampler.

        They say how well any function of the model is known where it is far from linear, or where
        the likelihood is far from a normal distribution. Readings are independent, as for the
        errors `"independent"`, and their noise is normal:

        $$ p(\theta, x_0) \propto e^{-\chi^2/2} \, p(\theta)
        \quad\text{or}\quad (\chi^2)^{-N/2} \, p(\theta) , $$

        the first with `noise="given"`, the second where the size of the noise of the $N$ residuals
        is not known, and is integrated out under Jeffreys' prior. Initial states $x_0$ are drawn
        too, and dropped. In a linear model with one variance the draws are those of Student's $t$
        of the intervals of kind `"independent"`.

        The prior is flat in the entries of each inertia that a body can have, or in its entries
        over the trace where the size of the inertia is not observable; flat in the other free
        leaves, within their bounds, in initial attitudes, in rates, and in other states; times the
        `prior` of the fit. Directions that are not observable are not drawn: leaves stay as
        estimated along them.

        Four chains begin about the estimate, twice as far from each other as draws are: another
        minimum is not found. The first call compiles a program for all recordings of one shape;
        further calls compile nothing. The time grows with the number of readings, and with that of
        trajectories, as each has a state to be drawn.

        Parameters
        ----------
        draws
            Number of draws of each of the four chains, such as 1000.
        key
            A key of random numbers, such as `jax.random.key(0)`.

        Returns
        -------
        PosteriorDraws
            The draws, which give intervals of any function of the model.

        Raises
        ------
        ImportError
            If the package `blackjax` is not installed.
        ValueError, TypeError
            For a wrong argument; if a loss is robust, several processes fit together, no more was
            read than is fitted, a leaf of a body has bounds, or no direction of the free leaves is
            observable.
        RuntimeError
            If the chains do not agree ($\hat R$ above 1.01), or the effective sample size of a leaf
            is below 400, which are the limits of Vehtari et al. (Bayesian Analysis 16, 2021,
            [doi:10.1214/20-BA1221](https://doi.org/10.1214/20-BA1221)); if more than a hundredth
            of the transitions diverge, so that a part of a tail may be missing; if the posterior is
            so narrow and bent that draws would take hours, which is known after the warm-up; or if
            whole trajectories cannot be simulated.
        """
        require_draws(draws)
        require_key("key", key)
        drawn = self.sampler.draw(int(draws), key)
        r_hat, size = diagnose(drawn.theta)
        mean = np.mean(drawn.theta, axis=(0, 1))
        posterior = PosteriorDraws(
            self.free.put(self.parameters, mean),
            self.unobservable,
            self.scaled,
            self.variance,
            self.free._replace(theta=mean),
            drawn.information,
            drawn.theta,
            r_hat,
            size,
            drawn.divergences,
        )
        require_convergence(posterior)
        return posterior

    def profile(self, quantity: Quantity, level: float = 0.95) -> Profile:
        r"""The interval of a number by the profile of its likelihood.

        It holds the values $c$ for which a model with `quantity(model) == c` fits about as well as
        the estimate: the least $\chi^2$ over all other directions of the free leaves and over the
        initial states is at most $s^2 t^2$ above the minimum. $s^2$ is the variance of the
        residuals, or 1 with `noise="given"`. $t$ is the quantile of Student's $t$, or of the normal
        distribution, that intervals of kind `"independent"` have: where the model is linear, both
        agree. Unlike those, the profile does not depend on coordinates (Venzon & Moolgavkar, Appl.
        Stat. 37, 1988, [doi:10.2307/2347496](https://doi.org/10.2307/2347496)).

        Parameters
        ----------
        quantity
            A function of the model that gives one number, such as
            `lambda model: model.body.inertia[0, 0]`.
        level
            The probability, between 0 and 1.

        Returns
        -------
        Profile
            The ends, and the values of $\chi^2$ that were found on the way. An end that is not
            reached is infinite.

        Raises
        ------
        ValueError, TypeError
            If the quantity is not one number, no more was read than is fitted, or several processes
            fit together.
        RuntimeError
            If a fit on the way does not converge, or fits better than the estimate.
        """
        require_level(level)
        values, jacobian = self.linearise(require_number(quantity, self.parameters))
        spread = spread_about(values, jacobian, self.independent, level)
        return self.profiles.follow(quantity, float(values[0]), spread, level)

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
