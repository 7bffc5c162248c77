"""What an identification returns."""

import csv
import json
from collections.abc import Callable, Iterator
from os import PathLike
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float
from scipy.special import chdtrc, chdtri

from .bootstrap import Bootstrap
from .data.recordings import Recordings
from .model.free import Free
from .model.model import Model
from .model.states import InitialStates
from .report import make_table, wrap_lines
from .uncertainty.information import Information
from .uncertainty.noise import NO_NOISE, compute_correlations
from .uncertainty.posterior import (
    AbstractPosterior,
    Independent,
    LinearErrors,
    Quantity,
    Spread,
    spread_about,
)
from .uncertainty.sandwich import Sandwich

OUTLYING = 2.0  # times the residuals of the median trajectory
FEWEST_TRAJECTORIES = 10  # for errors of whole trajectories, by default
Noise = Literal["residuals", "given"]
Errors = Literal["independent", "clustered", "correlated", "bootstrap"]


class Estimate(AbstractPosterior):
    """The most likely values of the free leaves, with their covariance.

    Attributes
    ----------
    model
        The model with the estimated leaves.
    states
        The estimated initial states, at the first sample of each trajectory.
    converged
        Whether the fit reached a minimum.
    iterations
        Number of iterations of Levenberg and Marquardt's method, at all lengths of windows.
    chi_square
        Sum of the losses: of the squared whitened residuals, if no loss is robust.
    degrees_of_freedom
        Number of residuals minus number of estimated numbers.
    step_bias
        Shift of the estimate by the step of the integrator, in standard errors: the largest of any
        combination of the free leaves.
    unobservable
        The directions of the free leaves that are not observable, in words.
    messages
        What the user should know, in words.
    recordings
        What was fitted.
    residuals
        Whitened residuals of each channel (samples, m), of all trajectories one after another; see
        [`Samples.split`][lgvi.identification.Samples].
    predicted
        What the sensor of each channel reads without noise (samples, ...), in the same order.
    errors
        The kind of standard errors that the report has, and that the methods give by default:
        `"independent"`, `"clustered"`, `"correlated"` or `"bootstrap"`; see
        [`identify`][lgvi.identification.identify].
    variance
        The factor on the covariance for unit noise and independent residuals: 1, or the variance
        of the residuals.
    scaled
        Names of the leaves that are known only as parts of the trace of the inertia.
    free, information
        The free leaves as a vector, and the information on the vector.
    """

    model: Model
    states: InitialStates
    recordings: Recordings
    residuals: dict[str, Float[np.ndarray, "samples m"]]
    predicted: dict[str, Float[np.ndarray, "samples ..."]]
    converged: bool
    iterations: int
    chi_square: float
    degrees_of_freedom: int
    step_bias: float
    unobservable: tuple[str, ...]
    messages: tuple[str, ...]
    errors: Errors
    variance: float
    scaled: tuple[str, ...]
    free: Free
    information: Information
    independent: Independent
    clustered: Sandwich
    correlated: Sandwich
    bootstrap: Bootstrap

    def covariance(
        self, quantity: Quantity | None = None, errors: Errors | None = None
    ) -> Float[np.ndarray, "n n"]:
        r"""Covariance of a quantity.

        It is $G\,C\,G^T$ with the Jacobian $G$ of the quantity (the delta method), or the
        covariance of the values in all draws of a bootstrap.

        Parameters
        ----------
        quantity
            A function of the model that gives an array or a pytree of some, which is raveled to n
            numbers, such as `lambda model: model.body.inertia`. By default the free leaves.
        errors
            Their kind, as for [`identify`][lgvi.identification.identify]. By default that of the
            report.

        Returns
        -------
        numpy.ndarray
            Covariance (n, n). A number that is not observable has infinite variance, and NaN for
            its covariances.

        Raises
        ------
        ValueError
            For errors that one trajectory does not have.
        """
        kind = self._kind(errors)
        _, jacobian = self.linearise(quantity)
        if kind != "bootstrap":
            return self._linear_errors(kind).covariance_of(jacobian)
        draws = self._drawn(quantity)
        covariance = np.cov(draws, rowvar=False, ddof=1).reshape(jacobian.shape[:1] * 2)
        return self.information.without_unknown(jacobian, covariance)

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
        return self._spread(
            values, jacobian, lambda: of_leaves(self._converged_draws()), None, 0.95
        )

    def _spread(
        self,
        values: np.ndarray,
        jacobian: np.ndarray,
        drawn: Callable[[], np.ndarray],
        errors: Errors | None,
        level: float,
    ) -> Spread:
        kind = self._kind(errors)
        if kind != "bootstrap":
            return spread_about(values, jacobian, self._linear_errors(kind), level)
        draws, unknown = drawn(), self.information.unknown(jacobian)
        ends = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2], axis=0)
        lower, upper = np.where(unknown, [[-np.inf], [np.inf]], ends)
        return Spread(np.where(unknown, np.inf, np.std(draws, axis=0, ddof=1)), lower, upper)

    def _kind(self, errors: Errors | None) -> Errors:
        kind = self.errors if errors is None else errors
        require_errors(kind, len(self.recordings))
        return kind

    def _linear_errors(self, kind: Errors) -> LinearErrors:
        kinds: dict[str, LinearErrors] = {
            "independent": self.independent,
            "clustered": self.clustered,
            "correlated": self.correlated,
        }
        return kinds[kind]

    def _converged_draws(self) -> np.ndarray:
        draws = self.bootstrap.draws
        return draws[np.all(np.isfinite(draws), axis=1)]

    def _drawn(self, quantity: Quantity | None) -> np.ndarray:
        """The quantity, raveled to n numbers, in each draw (draws, n)."""
        draws = self._converged_draws()
        return draws if quantity is None else self.evaluate(quantity, draws)

    def summary(self) -> dict[str, np.ndarray]:
        """The table of the report, as a dictionary of its columns.

        Returns
        -------
        dict
            `name`, `value`, `standard_error`, `lower` and `upper` end of the 95 % interval, and
            `unit`, each an array (numbers,). A standard error is infinite for a number that is not
            observable, and NaN for a number that is at its bound.
        """
        return make_table(self).as_arrays()

    def to_csv(self, file: str | PathLike[str]) -> None:
        """Write the columns of `summary` to a CSV file with a header."""
        columns = self.summary()
        with open(file, "w", newline="", encoding="utf-8") as opened:
            writer = csv.writer(opened)
            writer.writerow(columns)
            writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))

    def to_json(self, file: str | PathLike[str]) -> None:
        """Write `summary`, and how the model fits, to a JSON file.

        Numbers that JSON does not have, infinite ones and NaN, are `null`.
        """

        def plain(value: Any) -> Any:
            if isinstance(value, list):
                return [plain(each) for each in value]
            return None if isinstance(value, float) and not np.isfinite(value) else value

        content = {
            **{name: plain(column.tolist()) for name, column in self.summary().items()},
            "errors": self.errors,
            "converged": self.converged,
            "chi_square": plain(self.chi_square),
            "degrees_of_freedom": self.degrees_of_freedom,
            "trajectories": len(self.recordings),
            "unobservable": self.unobservable,
            "messages": self.messages,
        }
        with open(file, "w", encoding="utf-8") as opened:
            json.dump(content, opened, indent=2, ensure_ascii=False)
            opened.write("\n")

    @property
    def trajectory_chi_square(self) -> Float[np.ndarray, " trajectories"]:
        """Sum of the squared whitened residuals of each trajectory."""
        total = np.zeros(len(self.recordings))
        for channel, r in self.residuals.items():
            trajectory = np.repeat(np.arange(len(total)), self.recordings.channels[channel].count)
            total += np.bincount(trajectory, np.sum(r**2, axis=1), len(total))
        return total

    @property
    def residual_rms(self) -> dict[str, Float[np.ndarray, " m"]]:
        """Root mean square of the residuals about each axis (m,) of each channel.

        In the unit of the sensor's `sigma`, with the part that the fit has taken off put back: an
        estimate of `sigma`. NaN if as many numbers are fitted as were read.
        """
        freedom = self.degrees_of_freedom or np.nan
        left = freedom / sum(r.size for r in self.residuals.values())
        return {
            channel: np.asarray(self.model.sensors[channel].sigma, float)
            * np.sqrt(np.mean(r**2, axis=0) / left)
            for channel, r in self.residuals.items()
        }

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of trajectories that do not fit, to be looked at, or dropped from the recordings.

        Their residuals are more than twice as large as the residuals of the median trajectory. By
        chance that happens in less than one of a thousand sets of recordings.
        """
        counts = [
            len(sensor.axes) * self.recordings.channels[channel].count
            for channel, sensor in self.model.sensors.items()
        ]
        freedom = np.sum(counts, axis=0) - 6
        judged = freedom > 0  # others are fitted exactly
        if not judged.any():
            return ()
        freedom, chi_square = freedom[judged], self.trajectory_chi_square[judged]
        ratio = chi_square / freedom
        median = np.median(ratio)
        chance = chdtrc(freedom, chi_square / max(median, NO_NOISE))
        outlying = (chance < 1e-3 / len(ratio)) & (ratio > OUTLYING**2 * median)
        return tuple(np.array(self.recordings.names)[judged][outlying].tolist())

    def __str__(self) -> str:
        lines = [f"standard errors: {_about_errors(self)}", *_statistics(self)]
        return "\n".join([str(make_table(self)), "", *wrap_lines(lines)])

    def report(self) -> None:
        """Print a table of all estimated numbers, and how well the model fits."""
        print(self)


def require_errors(errors: str, trajectories: int) -> None:
    """Check a kind of standard errors.

    Raises
    ------
    ValueError
        If there is no such kind, or it needs more trajectories.
    """
    if not isinstance(errors, str) or errors not in get_args(Errors):
        kinds = ", ".join(f'"{kind}"' for kind in get_args(Errors))
        raise ValueError(f"Argument `errors` must be one of {kinds}, but is {errors!r}.")
    if trajectories < 2 and errors in ("clustered", "bootstrap"):
        raise ValueError(
            f'Argument `errors` must be "correlated" or "independent" for a single trajectory, but '
            f'is "{errors}", which compares trajectories.'
        )


def choose_errors(trajectories: int, freedom: int, noise: Noise) -> Errors:
    """The kind of standard errors that holds for recordings, as far as these can tell."""
    if noise == "given" or freedom == 0:
        return "independent"
    return "clustered" if trajectories >= FEWEST_TRAJECTORIES else "correlated"


def _about_errors(estimate: Estimate) -> str:
    """What the standard errors of the report take as independent."""
    number = len(estimate.recordings)
    together = "1 trajectory" if number == 1 else f"{number} trajectories"
    if estimate.errors == "independent":
        return "independent (the noise of each reading independent of all others)"
    if estimate.errors == "clustered":
        return f"clustered (from the scatter of {together})"
    if estimate.errors == "correlated":
        blocks = len(estimate.correlated.influence)
        return f"correlated (from the scatter of {blocks} blocks of time in {together})"
    draws, converged = len(estimate.bootstrap.draws), len(estimate._converged_draws())
    failed = "" if converged == draws else f", {draws - converged} of which did not converge"
    return f"bootstrap (from {draws} draws of {together}{failed})"


def _statistics(estimate: Estimate) -> list[str]:
    """How well the model fits, and which trajectories it does not."""
    chi_square, freedom = estimate.chi_square, estimate.degrees_of_freedom
    lines = [f"trajectories: {len(estimate.recordings)}, degrees of freedom: {freedom}"]
    if freedom:
        kind = "robust loss" if estimate.model.is_robust else "chi-square"
        lines[0] += f", {kind} for each: {chi_square / freedom:.4g}"
    lines += _of_channels(estimate)
    outliers = estimate.outliers
    if outliers:
        lines.append(f"trajectories that do not fit: {len(outliers)}: {', '.join(outliers)}")
    if estimate.recordings.dropped:
        lines.append(f"dropped: {'; '.join(estimate.recordings.dropped)}")
    lines.append(
        f"{'converged' if estimate.converged else 'NOT CONVERGED'} after {estimate.iterations} "
        f"iterations; the step of the integrator moves the estimate by {estimate.step_bias:.1g} "
        "standard errors"
    )
    lines += [f"not observable: {words}" for words in estimate.unobservable]
    return lines + [f"note: {message}" for message in estimate.messages]


def _of_channels(estimate: Estimate) -> Iterator[str]:
    """The size of the residuals of each channel, and how they are correlated."""
    part_left = estimate.degrees_of_freedom / sum(r.size for r in estimate.residuals.values())
    if not part_left:
        return
    found = compute_correlations(estimate.model, estimate.residuals, estimate.recordings)
    for channel, correlation in found.items():
        sensor, axes = estimate.model.sensors[channel], estimate.residuals[channel].shape[1]
        s = np.sum(estimate.residuals[channel] ** 2, axis=1) / part_left
        sigma = np.asarray(sensor.sigma, float)
        rms = np.sqrt(np.mean(estimate.residual_rms[channel] ** 2))
        usual = np.sqrt(np.mean(sigma**2)) * np.sqrt(
            np.median(s) / chdtri(axes, 0.5)
        )  # outliers hardly change it
        given = np.array2string(sigma, formatter={"float": "{:.4g}".format})
        yield (
            f"{channel.replace('_', ' ')}: residual {rms:.4g} {sensor.unit} for each axis, "
            f"{usual:.4g} {sensor.unit} by the median (sigma {given}), correlation of successive "
            f"ones {correlation.value:+.3f} +- {correlation.error:.3f}"
        )
