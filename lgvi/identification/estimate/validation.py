"""Whether a fit predicts trajectories that were not fitted."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.special import stdtr

from ..checks import require_model
from ..data.recordings import Recordings
from ..fit.fit import fit
from ..fit.part import FittedPart, fitted_parts
from ..fit.problem import AbstractAtMinimum, Problem
from ..start.measured import largest_rates
from ..uncertainty.information import NO_NOISE
from ..uncertainty.report_table import wrap_lines

BY_CHANCE = 1e-2  # probability below which trajectories differ from those of a fit
MANY = 1e9  # degrees of freedom of a variance that is known


class _Comparison(NamedTuple):
    """How much larger residuals are than those of the fit, by the logarithm of their squares."""

    names: list[str]  # of the trajectories that were not fitted
    difference: np.ndarray  # (trajectories,), from the mean of the fit
    fitted: np.ndarray  # (trajectories,), numbers of trajectories that were fitted alike
    by_errors: np.ndarray  # (trajectories, k, k), part of the squares by errors of the parameters
    variance: float  # of the logarithm of a trajectory
    variance_of_mean: float  # of the differences
    freedom: float  # degrees of freedom of both

    def of_each(self) -> np.ndarray:
        """Probabilities of differences as large by chance (trajectories,)."""
        variance = self.variance * (1 + 1 / self.fitted)
        return self._probability(self.difference, variance, self.by_errors)

    def of_all(self) -> float:
        """Probability of a mean difference as large by chance."""
        mean, by_errors = np.mean(self.difference), np.mean(self.by_errors, axis=0)
        return float(self._probability(mean, self.variance_of_mean, by_errors))

    def _probability(self, difference: Any, variance: Any, by_errors: np.ndarray) -> Any:
        # A square of errors with a covariance has twice the variance of their sum of squares.
        of_errors = 2 * np.sum(by_errors**2, axis=(-2, -1))
        return stdtr(self.freedom, -difference / np.sqrt(variance + of_errors))


class Validation(eqx.Module):
    r"""Trajectories that were not fitted, beside those of a fit.

    Initial states are fitted to them, and the parameters are those of the estimate. Where the
    estimate predicts them, their chi-square for each degree of freedom is that of the fit, but for
    chance. Trajectories are compared by its logarithm: the mean of those that were not fitted with
    the mean of those that were, by Student's t-test with the scatter of the fit. So noise may be
    correlated within a trajectory, and larger in some than in others, as long as it is alike in
    both.

    Attributes
    ----------
    parts
        For each configuration by its name the trajectories that were not fitted, with the initial
        states that fit best: a [`FittedPart`][lgvi.identification.FittedPart]. The name of the
        only configuration of an [`Estimate`][lgvi.identification.Estimate] is `""`.
    fitted
        The trajectories of the fit, by the same names.
    by_errors
        By the same names, for each trajectory that was not fitted a matrix (trajectories, k, k):
        the chi-square that errors of the parameters make, as a quadratic form in coordinates in
        which the covariance of the estimate is 1 for unit noise.
    converged
        Whether the fits of the initial states reached a minimum.
    """

    parts: dict[str, FittedPart]
    fitted: dict[str, FittedPart]
    by_errors: dict[str, Float[np.ndarray, "trajectories k k"]]
    converged: bool

    @property
    def ratio(self) -> float:
        """Chi-square for each degree of freedom, over that of the fit: the geometric mean."""
        return float(np.exp(np.mean(self._compare().difference)))

    @property
    def probability(self) -> float:
        """Of a `ratio` as large, or larger, by chance."""
        return self._compare().of_all()

    @property
    def agrees(self) -> bool:
        """Whether the estimate predicts the trajectories, as far as chance allows to tell.

        All of them together, and each of them, with a probability of 1 % to say no by chance.
        """
        each = self.summary()["probability"]
        together = self.probability >= BY_CHANCE
        return bool(self.converged and together and np.all(each * len(each) >= BY_CHANCE))

    def summary(self) -> dict[str, np.ndarray]:
        """A row for each trajectory that was not fitted, as a dictionary of its columns.

        Returns
        -------
        dict
            `name`, `ratio` of chi-square for each degree of freedom to that of the fit, and
            `probability` of a ratio as large by chance, each an array (trajectories,).
            Trajectories with no more readings than an initial state has numbers are left out.
        """
        comparison = self._compare()
        return {
            "name": np.array(comparison.names),
            "ratio": np.exp(comparison.difference),
            "probability": comparison.of_each(),
        }

    def as_dict(self) -> dict[str, Any]:
        """Whether the estimate agrees, and `summary`, as what JSON has."""
        columns = {name: column.tolist() for name, column in self.summary().items()}
        return {
            "agrees": self.agrees,
            "converged": self.converged,
            "ratio": self.ratio,
            "probability": self.probability,
            **{f"trajectory_{name}": column for name, column in columns.items()},
        }

    def _compare(self) -> _Comparison:
        names, differences, counts, by_errors, deviations, sizes = [], [], [], [], [], []
        for name, part in self.parts.items():
            fitted, errors = self.fitted[name], self.by_errors[name]
            expected = part.trajectory_freedom + np.trace(errors, axis1=1, axis2=2)
            judged, of_fit = part.trajectory_freedom > 0, fitted.expected_chi_square
            expected, errors = expected[judged], errors[judged]
            now = _logarithms(part.trajectory_chi_square[judged], expected)
            before = _logarithms(fitted.trajectory_chi_square[of_fit > 0], of_fit[of_fit > 0])
            some = np.array(part.recordings.names)[judged].tolist()
            names += [f"{name}: {trajectory}" if name else trajectory for trajectory in some]
            differences.append(now - np.mean(before))
            counts.append(np.full(len(now), len(before)))
            by_errors.append(errors / expected[:, None, None])
            deviations.append(before - np.mean(before))
            sizes += [expected, of_fit[of_fit > 0]]
        freedom = sum(map(len, deviations)) - len(deviations)
        # At least as large as for white noise: two trajectories may be alike by chance.
        scatter = float(np.sum(np.concatenate(deviations) ** 2)) / max(freedom, 1)
        white = 2 * float(np.mean(1 / np.concatenate(sizes)))
        variance, total = max(scatter, white), sum(map(len, differences))
        of_means = [
            len(now) * (1 + len(now) / len(before)) / total**2
            for now, before in zip(differences, deviations, strict=True)
        ]
        return _Comparison(
            names,
            np.concatenate(differences),
            np.concatenate(counts),
            np.concatenate(by_errors),
            variance,
            variance * sum(of_means),
            freedom if scatter > white else MANY,
        )

    def __str__(self) -> str:
        return "\n".join(wrap_lines(self._lines()))

    def _lines(self) -> Iterator[str]:
        summary = self.summary()
        number, of_fit = (
            sum(len(part.recordings) for part in parts.values())
            for parts in (self.parts, self.fitted)
        )
        yield (
            f"{number} trajectories that were not fitted {'agree' if self.agrees else 'DISAGREE'} "
            f"with the {of_fit} of the fit: chi-square for each degree of freedom is "
            f"{self.ratio:.3g} times as large, or larger by chance with a probability of "
            f"{self.probability:.2g}"
        )
        if not self.converged:
            yield "the fit of their initial states did NOT converge"
        for name, part in self.parts.items():
            before = self.fitted[name].residual_rms
            for channel, size in part.residual_rms.items():
                rms, rms_before = (np.sqrt(np.mean(x**2)) for x in (size, before[channel]))
                label = f"{name}: {channel}" if name else channel
                yield (
                    f"{label.replace('_', ' ')}: residual {rms:.4g} "
                    f"{part.model.sensors[channel].unit} for each axis, {rms_before:.4g} in the fit"
                )
        for trajectory, ratio, probability in zip(*summary.values(), strict=True):
            if probability * len(summary["name"]) < BY_CHANCE:
                yield f"{trajectory}: {ratio:.3g} times as large, by chance {probability:.1g}"


def _logarithms(chi_square: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    return np.log(np.maximum(chi_square / freedom, NO_NOISE))


def validate(
    fitted: Mapping[str, FittedPart],
    minimum: AbstractAtMinimum,
    recordings: Mapping[str, Recordings],
) -> Validation:
    """Trajectories of some configurations beside those that were `fitted` to a minimum."""
    problem, parts, by_errors, converged = minimum.problem, {}, {}, True
    configurations = zip(problem.configurations, minimum.longest_steps, strict=True)
    for configuration, longest_steps in configurations:
        name = configuration.name
        if name not in recordings:
            continue
        before, unseen = fitted[name], recordings[name]
        require_model(before.model, unseen)
        # Steps by which the body turns as far as in the fit, where they are short enough.
        speeds = largest_rates(before.model, before.recordings, before.states)
        free = problem.free
        pinned = Problem(
            problem.parameters,
            free._replace(
                lower=free.theta,
                upper=free.theta,
                scale_direction=np.zeros_like(free.scale_direction),
            ),
            [configuration._replace(model=before.model, recordings=unseen)],
            [None],
            noise_is_given=True,
            turn_of_step=float(np.max(longest_steps * speeds)),
            mesh=problem.mesh,
        )
        result = fit(pinned, None, None)
        converged = converged and result.converged
        parts.update(fitted_parts(result.problem, result))
        m = result.states.unknowns
        rows = result.linearised.system.triangles[:, m:, m:-1].astype(float)
        rows = minimum.known.whiten(rows)
        by_errors[name] = np.swapaxes(rows, 1, 2) @ rows
    return Validation(parts, {name: fitted[name] for name in parts}, by_errors, converged)
