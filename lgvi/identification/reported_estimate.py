"""The report of an estimate: whether the model holds, the numbers, and how well the model fits."""

import csv
import json
from collections.abc import Iterator
from dataclasses import replace
from os import PathLike
from typing import Any, Self

import numpy as np

from .abstract_estimate import AbstractEstimate
from .diagnosis.doubts import (
    CHANCE,
    Suspect,
    compare_halves,
    describe_suspects,
    describe_trajectories,
    differ_in_size,
    find_suspects,
)
from .error_kinds import Errors, require_errors
from .model.prior import Prior
from .report import find_numbers, make_table, wrap_lines
from .uncertainty.noise import NO_NOISE
from .uncertainty.posterior import describe_width

IMPLAUSIBLE = 3.0  # standard deviations from the mean of a prior
MOST_NAMED = 3  # trajectories in a verdict
MUCH_LARGER = 10.0  # residuals than a guess of the noise


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
        require_errors(errors, [len(part.recordings) for part in self.parts.values()])
        return replace(self, errors=errors, reason="as asked for")

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """What the model may leave out, by score tests; the largest gain first.

        Tried are the bias, the scale, the alignment and the time offset of each sensor that has
        such leaves, linear damping, quadratic drag, a time scale, and the delay of a rotor. What
        the recordings do not tell is left out, and all if whole trajectories cannot be simulated.
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
        if not self.degrees_of_freedom:
            return "nothing tells whether the model holds, as no more was read than is fitted"
        against, allowed = [*self.mistakes], []
        # Beside a mistake suspects mean nothing, and after the first they are often its shadows.
        suspects = () if self.mistakes else self.suspects
        certain = [each for each in suspects if each.is_certain]
        matters = [each for each in certain if each.matters]
        against += map(str, matters[:1])
        allowed += map(str, certain[:1])
        against += self.reasons
        against += [f"{words} is implausible" for words in self._implausible()]
        scatter, is_correlated = [], False  # what independent errors do not allow for
        for name, part in self.parts.items():
            where = f" of `{name}`" if len(self.parts) > 1 else ""
            if outliers := part.outliers:
                words = f"{_count(outliers)} not fit"
                words = f"in `{name}` {words}" if where else words
                (allowed if part.model.is_robust else against).append(words)
            correlated = [each for each, r in part.correlations.items() if r.is_certain]
            if correlated and self.variance > NO_NOISE:
                is_correlated = True
                scatter.append(f"residuals of {' and '.join(correlated)}{where} are correlated")
            if differ_in_size(part) and self.variance > NO_NOISE:
                scatter.append(f"residuals differ in size from trajectory to trajectory{where}")
        where, apart, probability = self._halves()
        if probability < CHANCE:
            against.append(
                f"halves of the data are {abs(apart):.2g} standard errors apart ({where})"
            )
        times = np.sqrt(self.variance)
        if self.errors != "independent" and times > MUCH_LARGER:
            words = f"the residuals are {times:.3g} times as large as `sigma`"
            (against if is_correlated else allowed).append(words)
        if against:
            return f"the model does not hold: {'; '.join(against)}"
        if scatter and self.errors == "independent":
            return f"the model may hold, but independent errors do not: {'; '.join(scatter)}"
        if allowed or scatter:
            return f"the model holds with the intervals given: {'; '.join([*allowed, *scatter])}"
        return "the model holds"

    def _implausible(self) -> list[str]:
        """Names of priors that the estimate contradicts."""
        return [
            name
            for prior in self.prior
            for name, by in zip(prior.names, self._contradiction(prior), strict=True)
            if abs(by) > IMPLAUSIBLE
        ]

    def _off(self, prior: Prior) -> np.ndarray:
        """How far the estimate is from the mean of a prior, in standard deviations."""
        return prior.rows(self.parameters, self.free, self.free.theta)[:, -1]

    def _contradiction(self, prior: Prior) -> np.ndarray:
        """How far the mean of a prior is from what the recordings tell without it.

        In standard errors of the difference, which is larger than that of the estimate, as the
        prior has drawn the estimate to its mean.
        """
        rows = prior.rows(self.parameters, self.free, self.free.theta)
        after = np.diag(self.independent.covariance_of(rows[:, :-1]))
        left = 1 - np.where(np.isfinite(after), after, 0)
        return rows[:, -1] / np.sqrt(np.maximum(left, 1e-6))

    def _halves(self) -> tuple[str, float, float]:
        """The number in which halves of the data differ most, by how many standard errors.

        With the probability that any number differs so by chance.
        """
        numbers = find_numbers(self)
        apart, chance = compare_halves(self.correlated, numbers.jacobian)
        known = ~self.information.unknown(numbers.jacobian) & (apart != 0)
        if not known.any():
            return "", 0.0, 1.0
        i = int(np.argmin(np.where(known, chance, np.inf)))
        return numbers.names[i], float(apart[i]), float(chance[i]) * len(self.free.theta)

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
            "suspects": [
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
        about = f"standard errors: {_about_errors(self)}; {self.reason}"
        table, verdict = make_table(self), wrap_lines([f"verdict: {self.verdict}"])
        lines = wrap_lines([about, *describe_width(table.spread), *_statements(self)])
        return "\n".join([*verdict, "", str(table), "", *lines])

    def report(self, errors: Errors | None = None) -> None:
        """Print whether the model holds, all estimated numbers, and how well the model fits.

        Parameters
        ----------
        errors
            The kind of standard errors, as for `covariance`.
        """
        print(self if errors is None else self.with_errors(errors))


def _count(outliers: tuple[str, ...]) -> str:
    """Such as `trajectory a does`, or `5 trajectories (a, b, c, ...) do`."""
    named = ", ".join(f"`{name}`" for name in outliers[:MOST_NAMED])
    if len(outliers) == 1:
        return f"trajectory {named} does"
    more = ", ..." if len(outliers) > MOST_NAMED else ""
    return f"{len(outliers)} trajectories ({named}{more}) do"


def _about_errors(estimate: AbstractReportedEstimate) -> str:
    """What the standard errors of the report take as independent."""
    number = estimate.trajectories
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


def _statements(estimate: AbstractReportedEstimate) -> Iterator[str]:
    """How well the model fits, what was known beforehand, and what the user should know."""
    chi_square, freedom = estimate.chi_square, estimate.degrees_of_freedom
    line = f"trajectories: {estimate.trajectories}, degrees of freedom: {freedom}"
    if freedom:
        robust = any(part.model.is_robust for part in estimate.parts.values())
        kind = "robust loss" if robust else "chi-square"
        line += f", {kind} for each: {chi_square / freedom:.4g}"
    yield line
    for name, part in estimate.parts.items():
        where = f"{name}: " if len(estimate.parts) > 1 else ""
        for words in (*part.statements(), *describe_trajectories(part)):
            yield where + words
    halves, apart, _ = estimate._halves()
    if halves:
        yield (
            f"halves of the data against each other: at most {abs(apart):.2g} standard errors "
            f"apart ({halves})"
        )
    yield from describe_suspects(estimate.suspects)
    for prior in estimate.prior:
        yield from _about_prior(estimate, prior)
    yield (
        f"{'converged' if estimate.converged else 'NOT CONVERGED'} after {estimate.iterations} "
        f"iterations; the step of the integrator moves the estimate by {estimate.step_bias:.1g} "
        "standard errors"
    )
    yield from (f"not observable: {words}" for words in estimate.unobservable)
    yield from (f"note: {message}" for message in estimate.messages)


def _about_prior(estimate: AbstractReportedEstimate, prior: Prior) -> Iterator[str]:
    """Each number with its mean and standard deviation, and the estimate of it."""
    for name, mean, deviation, by, against in zip(
        prior.names,
        prior.mean,
        prior.deviation,
        estimate._off(prior),
        estimate._contradiction(prior),
        strict=True,
    ):
        words = ""
        if abs(against) > IMPLAUSIBLE:
            words = f", IMPLAUSIBLE: without it {against:+.1f} standard errors"
        yield (
            f"{name}: {mean:.6g} +- {deviation:.2g}; the estimate is "
            f"{mean + by * deviation:.6g}, {by:+.1f} standard deviations from the mean{words}"
        )
