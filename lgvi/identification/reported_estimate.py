"""The report of an estimate: whether the model holds, the numbers, and how well the model fits."""

import csv
import json
from dataclasses import replace
from html import escape
from os import PathLike
from typing import Any, Self

import numpy as np

from .abstract_estimate import AbstractEstimate
from .contradictions import find_halves
from .diagnosis.doubts import Suspect, find_suspects
from .error_kinds import Errors
from .progress import show_progress
from .report import Table, find_numbers, make_table, wrap_lines
from .report_lines import describe_errors, describe_estimate, describe_width
from .verdict import judge


class AbstractReportedEstimate(AbstractEstimate):
    """An estimate with its report; see `JointEstimate`."""

    def with_errors(self, errors: Errors) -> Self:
        """The same estimate with standard errors of another kind in its report and table.

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

        Tried are the bias, the scale, the alignment and the time offset of each sensor that has
        such leaves, linear damping, quadratic drag, a time scale, and the delay of a rotor. What
        the recordings do not tell is left out, and all if whole trajectories cannot be simulated.
        Nothing is tried where recordings are in files or processes fit together, as the verdict
        and the report say; a JSON file then has `null` instead of suspects.
        """
        numbers, errors = find_numbers(self), make_table(self).spread.error
        # Entries of an inertia depend on its axes; its moments are what matters.
        errors = np.where(numbers.of_entries, np.nan, errors)
        return find_suspects(self.score_tests.found, numbers, errors)

    @property
    def verdict(self) -> str:
        """Whether the model holds, in words.

        It holds; it holds with the intervals given, as these allow for what is not as it should
        be; it may hold, but standard errors of the kind `"independent"` do not; or it does not
        hold, and why. If no more was read than is fitted, nothing tells.
        """
        return judge(self, self.suspects, find_halves(self, find_numbers(self)))

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
        with open(file, "w", encoding="utf-8") as opened:
            json.dump(content, opened, indent=2, ensure_ascii=False)
            opened.write("\n")

    def __str__(self) -> str:
        verdict, table, lines = self._contents()
        return "\n".join([*wrap_lines([verdict]), "", str(table), "", *wrap_lines(lines)])

    def __repr__(self) -> str:
        number = "1 trajectory" if self.trajectories == 1 else f"{self.trajectories} trajectories"
        converged = "converged" if self.converged else "NOT converged"
        return f"{type(self).__name__}({number}, {len(self.free.theta)} numbers, {converged})"

    def _repr_html_(self) -> str:
        """The report, for notebooks."""
        verdict, table, lines = self._contents()
        items = "".join(f"<li>{escape(line)}</li>" for line in lines)
        return f"<b>{escape(verdict)}</b>{table.as_html()}<ul>{items}</ul>"

    @show_progress("report")
    def _contents(self) -> tuple[str, Table, list[str]]:
        """The verdict, the table, and what is said under it, of a report."""
        suspects, table = self.suspects, make_table(self)
        about = f"standard errors: {describe_errors(self)}; {self.reason}"
        halves = find_halves(self, find_numbers(self))
        statements = describe_estimate(self, suspects, halves)
        verdict = f"verdict: {judge(self, suspects, halves)}"
        return verdict, table, [about, *describe_width(table.spread), *statements]

    def report(self, errors: Errors | None = None) -> None:
        """Print whether the model holds, all estimated numbers, and how well the model fits.

        Parameters
        ----------
        errors
            The kind of standard errors, as for `covariance`.
        """
        print(self if errors is None else self.with_errors(errors))
