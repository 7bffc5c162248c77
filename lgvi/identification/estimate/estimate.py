"""The report of an estimate: whether the model holds, the numbers, and how well the model fits."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...modules.mass.mass_properties import MassProperties
from ..data.recordings import Recordings
from ..diagnosis.suspects import Suspect, find_suspects
from ..fit.part import FittedPart
from ..model.model import Model
from ..model.states import InitialStates
from ..running.progress import show_progress
from ..uncertainty.posterior import Errors
from ..uncertainty.report_table import Table, find_numbers, make_table, wrap_lines
from .abstract_estimate import AbstractEstimate
from .validation import Validation, validate
from .wording import (
    describe_errors,
    describe_fit,
    describe_left_out,
    describe_width,
    find_halves,
    judge,
)


class AbstractReportedEstimate(AbstractEstimate):
    """An estimate with its report; see `JointEstimate`."""

    def with_errors(self, errors: Errors) -> Self:
        """The estimate with standard errors of another kind in its report and table.

        Parameters
        ----------
        errors
            The kind, as for [`identify`][lgvi.identification.identify].

        Returns
        -------
        JointEstimate or Estimate
            The estimate.

        Raises
        ------
        ValueError
            For a kind that the recordings do not have.
        """
        return replace(self, errors=self.require_kind(errors), reason="as asked for")

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """What the model may leave out, by score tests; the largest gain first.

        Suspects are the bias, the scale, the alignment, the place and the time offset of each
        sensor that has such leaves, linear damping, quadratic drag, a time scale, and the delay of
        a rotor. A suspect that the recordings do not determine is left out, and all suspects are if
        whole trajectories cannot be simulated. None is tried where recordings are in files or
        processes fit together, as the verdict and the report say; a JSON file then has `null` for
        suspects.
        """
        numbers, errors = find_numbers(self), make_table(self).spread.error
        # Entries of an inertia depend on its axes, so that shifts of its moments are judged.
        errors = np.where(numbers.of_entries, np.nan, errors)
        return find_suspects(self.score_tests.found, numbers, errors)

    @property
    def verdict(self) -> str:
        """Whether the model holds, in words.

        The model holds; it holds with the intervals given, as these allow for a deviation, which
        is named; it may hold, but standard errors of the kind `"independent"` do not; or it does
        not hold, and why. If no more was read than is fitted, there is no verdict.
        """
        return judge(self, self.suspects, find_halves(self, find_numbers(self)))

    def to_csv(self, file: str | PathLike[str]) -> None:
        """Write the columns of `summary` to a CSV file with a header."""
        columns = self.summary()
        with open(file, "w", newline="", encoding="utf-8") as opened:
            writer = csv.writer(opened)
            writer.writerow(columns)
            writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))

    def as_dict(self) -> dict[str, Any]:
        """`summary`, and how the model fits, as lists, words and numbers that JSON has.

        Numbers that JSON does not have, infinite ones and NaN, are None.
        """

        def plain(value: Any) -> Any:
            if isinstance(value, list):
                return [plain(item) for item in value]
            return None if isinstance(value, float) and not np.isfinite(value) else value

        return {
            **{name: plain(column.tolist()) for name, column in self.summary().items()},
            "errors": self.errors,
            "converged": self.converged,
            "chi_square": plain(self.chi_square),
            "degrees_of_freedom": self.degrees_of_freedom,
            "trajectories": self.trajectories,
            "unobservable": self.unobservable,
            "messages": self.messages,
            "mistakes": self.mistakes,
            "suspects": None
            if self.score_tests.not_tried
            else [
                {
                    "names": suspect.names,
                    "gain": plain(suspect.gain),
                    "values": plain(suspect.values.tolist()),
                    "errors": plain(suspect.errors.tolist()),
                    "probability": plain(suspect.probability),
                }
                for suspect in self.suspects
            ],
            "verdict": self.verdict,
        }

    def to_json(self, file: str | PathLike[str]) -> None:
        """Write what `as_dict` returns to a JSON file."""
        with open(file, "w", encoding="utf-8") as opened:
            json.dump(self.as_dict(), opened, indent=2, ensure_ascii=False)
            opened.write("\n")

    @show_progress("report")
    def to_html(self, file: str | PathLike[str], *, validation: Validation | None = None) -> Path:
        """Write the report with pictures as a page by itself, for a browser and to print.

        Parameters
        ----------
        file
            The page, such as `"report.html"`. It needs no network.
        validation
            Trajectories that were not fitted, as `validate` returns them, for a section of the
            page.

        Returns
        -------
        pathlib.Path
            The file.

        Raises
        ------
        ImportError
            If Matplotlib is not installed.
        """
        # Pictures stand on estimates, so that they are imported when they are drawn.
        pages = import_module("lgvi.plotting.report")
        return pages.write_report(self, file, validation=validation)

    def __str__(self) -> str:
        contents = contents_of(self)
        verdict, lines = (wrap_lines(part) for part in ([contents.verdict_line], contents.lines))
        return "\n".join([*verdict, "", str(contents.table), "", *lines])

    def __repr__(self) -> str:
        number = "1 trajectory" if self.trajectories == 1 else f"{self.trajectories} trajectories"
        converged = "converged" if self.converged else "NOT converged"
        return f"{type(self).__name__}({number}, {len(self.free.theta)} numbers, {converged})"

    def _repr_html_(self) -> str:
        """The report, for notebooks."""
        contents = contents_of(self)
        items = "".join(f"<li>{escape(line)}</li>" for line in contents.lines)
        return f"<b>{escape(contents.verdict_line)}</b>{contents.table.as_html()}<ul>{items}</ul>"

    def report(self, errors: Errors | None = None) -> None:
        """Print whether the model holds, all estimated numbers, and how well the model fits.

        Parameters
        ----------
        errors
            The kind of standard errors, as for `covariance`.
        """
        print(self if errors is None else self.with_errors(errors))


class Contents(NamedTuple):
    """What a report says."""

    verdict: str
    table: Table
    about: list[str]  # the kind of the standard errors of the table, and the widths of intervals
    fit: list[str]
    suspects: tuple[Suspect, ...]
    left_out: list[str]  # the suspects in words
    unobservable: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def verdict_line(self) -> str:
        """The verdict as a line of text."""
        return f"verdict: {self.verdict}"

    @property
    def lines(self) -> list[str]:
        """What a text has below the table."""
        unobservable = [f"not observable: {words}" for words in self.unobservable]
        notes = [f"note: {words}" for words in self.notes]
        return [*self.about, *self.fit, *self.left_out, *unobservable, *notes]


@show_progress("report")
def contents_of(estimate: AbstractReportedEstimate) -> Contents:
    """What the report of an estimate says."""
    suspects, table = estimate.suspects, make_table(estimate)
    halves = find_halves(estimate, find_numbers(estimate))
    return Contents(
        judge(estimate, suspects, halves),
        table,
        [describe_errors(estimate), *describe_width(table.spread)],
        list(describe_fit(estimate, halves)),
        suspects,
        list(describe_left_out(estimate, suspects)),
        estimate.unobservable,
        estimate.messages,
    )


class JointEstimate(AbstractReportedEstimate):
    """The most likely values of the free leaves of parameters, with their covariance.

    Attributes
    ----------
    parameters
        The parameters with the estimated leaves.
    parts
        For each configuration by its name the model, the recordings, the initial states, the
        residuals and their size `residual_rms`, such as `estimate.parts["bare"].model`: a
        [`FittedPart`][lgvi.identification.FittedPart].
    converged
        Whether the fit reached a minimum.
    iterations
        Number of iterations of Levenberg and Marquardt's method, at all lengths of windows.
    chi_square
        Sum of the losses: of the squared whitened residuals, if no loss is robust.
    degrees_of_freedom
        Number of residuals minus number of estimated numbers.
    step_bias
        Shift of the estimate by the step of the integrator, in standard errors: the largest shift
        of any combination of the free leaves.
    unobservable
        The directions of the free leaves that are not observable, and a turn of the initial
        attitudes that is not, in words.
    messages
        Notes for the user, in words.
    mistakes
        Usual mistakes of a log that another reading would mend, in words.
    reasons
        Why the model cannot hold, as far as the fit tells; see also `verdict`.
    errors
        The kind of standard errors that the report has, and that the methods give by default:
        `"independent"`, `"clustered"`, `"correlated"` or `"bootstrap"`; see
        [`identify`][lgvi.identification.identify].
    reason
        Why the errors are of that kind, in words.
    variance
        The factor on the covariance for unit noise and independent residuals: 1, or the variance
        of the residuals.
    prior
        The priors: what was known beforehand.
    scaled
        Names of the leaves that are known only as parts of the trace of the inertia.
    free, information
        The free leaves as a vector, and the information on the vector.
    """

    @show_progress("validate")
    def validate(self, recordings: Mapping[str, Recordings]) -> Validation:
        """Whether the estimate predicts trajectories that were not fitted.

        All estimated numbers stay, and only the initial states of these trajectories are fitted.
        They agree where their residuals are no larger than those of the fit but for chance; what is
        wrong in all trajectories alike agrees too, so look at the `verdict` as well.

        Parameters
        ----------
        recordings
            Recordings of one configuration or more, by name, with the channels that were fitted.

        Returns
        -------
        Validation
            The trajectories with fitted initial states, beside those of the fit.

        Raises
        ------
        ValueError, TypeError
            For names without a configuration, and recordings of other channels.
        RuntimeError
            If a trajectory cannot be simulated.
        """
        if not isinstance(recordings, Mapping) or not recordings:
            raise TypeError(
                "Argument `recordings` must be a mapping of names of parts to recordings, but is "
                f"{recordings!r}."
            )
        for name in recordings:
            if name not in self.parts:
                raise ValueError(
                    f"Argument `recordings` must have names of parts, {', '.join(self.parts)}, but "
                    f"has {name!r}."
                )
        return validate(self.parts, self.score_tests, recordings)


class Estimate(AbstractReportedEstimate):
    """The most likely values of the free leaves of a model, with their covariance.

    `report()` prints the values with their intervals and the verdict, whether the model holds, and
    `to_html` writes them with pictures. Errors of any function of the model are those of
    `standard_error`, `interval` and `covariance`.

    Attributes
    ----------
    model, body
        The model, and its body, with the estimated leaves.
    recordings, states
        The recordings that were fitted, and the initial states of their trajectories.
    own
        A model of the leaves that each trajectory has of its own.
    verdict
        Whether the model holds, and why not.
    suspects
        What the model may leave out, the worst first.
    mistakes, reasons
        Usual mistakes of the log, and why the model cannot hold, in words.
    converged, iterations, messages
        Whether the fit reached a minimum, in how many iterations, and what else to know, in words.
    unobservable
        What the recordings do not tell, in words.
    residuals, predicted, residual_rms, outliers
        Whitened residuals, readings without noise, the size of the residuals, and the names of
        trajectories that do not fit.
    chi_square, degrees_of_freedom, step_bias, errors, reason, variance, prior, scaled, information
        As in [`JointEstimate`][lgvi.identification.JointEstimate], whose parameters are the model.
    """

    @property
    def _part(self) -> FittedPart:
        (part,) = self.parts.values()
        return part

    @property
    def model(self) -> Model:
        """The model with the estimated leaves; those of each trajectory are as at the start."""
        return self.parameters

    @property
    def body(self):
        """The body with the estimated leaves; of unit trace if the scale is not observable."""
        return self.model.body

    @show_progress("validate")
    def validate(self, recordings: Recordings) -> Validation:
        """Whether the estimate predicts trajectories that were not fitted.

        All estimated numbers stay, and only the initial states of these trajectories are fitted.
        They agree where their residuals are no larger than those of the fit but for chance; what is
        wrong in all trajectories alike agrees too, so look at the `verdict` as well.

        Parameters
        ----------
        recordings
            Recordings with the channels that were fitted.

        Returns
        -------
        Validation
            The trajectories with fitted initial states, beside those of the fit.

        Raises
        ------
        ValueError, TypeError
            For recordings of other channels.
        RuntimeError
            If a trajectory cannot be simulated.
        """
        return validate(self.parts, self.score_tests, {"": recordings})

    def mass_properties(
        self, mass: float, centre: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> MassProperties:
        """The mass properties of the body, for URDF and MuJoCo files, where the mass is known.

        Parameters
        ----------
        mass
            Mass, kg.
        centre
            Centre of mass (3,), m, in a frame whose axes are those of the estimated inertia.

        Returns
        -------
        MassProperties
            The mass, the centre, and the estimated inertia, kg m².

        Raises
        ------
        ValueError
            If the recordings do not determine the size of the inertia, or the mass is not above 0.
        """
        if np.isinf(self.standard_error(lambda model: jnp.trace(model.body.inertia))):
            raise ValueError(
                "The recordings must determine the size of the inertia, but they tell only its "
                "ratios: a known rotor, torque or thrust does; or scale `estimate.body.inertia`, "
                "whose trace is 1, by a trace that is known."
            )
        if not 0 < mass < np.inf:
            raise ValueError(f"Argument `mass` must be above 0 kg, but is {mass!r}.")
        return MassProperties(mass, jnp.asarray(centre, float), self.body.inertia)

    @property
    def recordings(self) -> Recordings:
        """The recordings that were fitted."""
        return self._part.recordings

    @property
    def states(self) -> InitialStates:
        """The estimated initial states, at the first sample of each trajectory."""
        return self._part.states

    @property
    def residuals(self) -> dict[str, Float[np.ndarray, "samples m"]]:
        """Whitened residuals of each channel; see `FittedPart`."""
        return self._part.residuals

    @property
    def predicted(self) -> dict[str, Float[np.ndarray, "samples ..."]]:
        """Readings of the sensor of each channel without noise; see `FittedPart`."""
        return self._part.predicted

    @property
    def own(self) -> Any:
        """A model of the leaves that each trajectory has of its own; see `FittedPart`."""
        return self._part.own

    @property
    def trajectory_chi_square(self) -> Float[np.ndarray, " trajectories"]:
        """Sum of the squared whitened residuals of each trajectory."""
        return self._part.trajectory_chi_square

    @property
    def residual_rms(self) -> dict[str, Float[np.ndarray, " m"]]:
        """Root mean square of the residuals of each channel; see `FittedPart`."""
        return self._part.residual_rms

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of trajectories that do not fit; see `FittedPart`."""
        return self._part.outliers
