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


class Comparison(NamedTuple):
    """How much larger chi-square of trajectories is than in the fit, for each degree of freedom.

    Attributes
    ----------
    names
        The trajectories that were not fitted; those with no more readings than an initial state
        has numbers are left out.
    ratios
        Of each trajectory (trajectories,).
    probabilities
        Of ratios as large, or larger, by chance (trajectories,).
    ratio, probability
        The geometric mean of the ratios, and its probability.
    """

    names: list[str]
    ratios: Float[np.ndarray, " trajectories"]
    probabilities: Float[np.ndarray, " trajectories"]
    ratio: float
    probability: float


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
    comparison
        Both beside each other, in numbers.
    converged
        Whether the fits of the initial states reached a minimum.
    """

    parts: dict[str, FittedPart]
    fitted: dict[str, FittedPart]
    comparison: Comparison
    converged: bool

    @property
    def ratio(self) -> float:
        """Chi-square for each degree of freedom, over that of the fit: the geometric mean."""
        return self.comparison.ratio

    @property
    def probability(self) -> float:
        """Of a `ratio` as large, or larger, by chance."""
        return self.comparison.probability

    @property
    def agrees(self) -> bool:
        """Whether the estimate predicts the trajectories, as far as chance allows to tell.

        All of them together, and each of them, with a probability of 1 % to say no by chance.
        """
        together = self.probability >= BY_CHANCE
        return bool(self.converged and together and not np.any(self._differs()))

    def _differs(self) -> np.ndarray:
        """Whether a trajectory differs from the fit by more than chance (trajectories,)."""
        probabilities = self.comparison.probabilities
        return probabilities * len(probabilities) < BY_CHANCE

    def summary(self) -> dict[str, np.ndarray]:
        """A row for each trajectory that was not fitted, as a dictionary of its columns.

        Returns
        -------
        dict
            `name`, `ratio` of chi-square for each degree of freedom to that of the fit, and
            `probability` of a ratio as large by chance, each an array (trajectories,).
            Trajectories with no more readings than an initial state has numbers are left out.
        """
        names, ratios, probabilities, *_ = self.comparison
        return {"name": np.array(names), "ratio": ratios, "probability": probabilities}

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

    def __str__(self) -> str:
        return "\n".join(wrap_lines(self.lines()))

    def lines(self) -> Iterator[str]:
        """What a report says: first whether the estimate agrees."""
        number, of_fit = (
            sum(len(part.recordings) for part in parts.values())
            for parts in (self.parts, self.fitted)
        )
        if number == 1:
            words = f"1 trajectory that was not fitted {'agrees' if self.agrees else 'DISAGREES'}"
        else:
            verb = "agree" if self.agrees else "DISAGREE"
            words = f"{number} trajectories that were not fitted {verb}"
        yield (
            f"{words} with the {of_fit} of the fit: chi-square for each degree of freedom is "
            f"{self.ratio:.3g} times that of the fit; as large or larger by chance with a "
            f"probability of {self.probability:.2g}"
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
        names, ratios, probabilities, *_ = self.comparison
        for i in np.flatnonzero(self._differs()):
            yield f"{names[i]}: {ratios[i]:.3g} times as large, by chance {probabilities[i]:.1g}"


def compare(
    unseen: Mapping[str, FittedPart],
    fitted: Mapping[str, FittedPart],
    by_errors: Mapping[str, np.ndarray],
) -> Comparison:
    """Trajectories beside those that were fitted, by the logarithm of their chi-square.

    Errors of the parameters make chi-square larger: by the trace of a matrix of `by_errors`
    (trajectories, k, k), in coordinates in which their covariance is 1 for unit noise.
    """
    names, differences, deviations, of_errors, sizes = [], [], [], [], []
    for name, part in unseen.items():
        before = fitted[name]
        errors = by_errors[name]
        expected = part.trajectory_freedom + np.trace(errors, axis1=1, axis2=2)
        judged, of_fit = part.trajectory_freedom > 0, before.expected_chi_square
        expected, errors = expected[judged], errors[judged]
        now = _logarithms(part.trajectory_chi_square[judged], expected)
        then = _logarithms(before.trajectory_chi_square[of_fit > 0], of_fit[of_fit > 0])
        some = np.array(part.recordings.names)[judged].tolist()
        names += [f"{name}: {trajectory}" if name else trajectory for trajectory in some]
        differences.append(now - np.mean(then))
        deviations.append(then - np.mean(then))
        of_errors.append(errors / expected[:, None, None])
        sizes += [expected, of_fit[of_fit > 0]]
    freedom = sum(map(len, deviations)) - len(deviations)
    # At least as large as for white noise: two trajectories may be alike by chance.
    scatter = float(np.sum(np.concatenate(deviations) ** 2)) / max(freedom, 1)
    white = 2 * float(np.mean(1 / np.concatenate(sizes)))
    variance, freedom = max(scatter, white), freedom if scatter > white else MANY

    def probability(difference: Any, variance: Any, errors: np.ndarray) -> Any:
        # A square of errors with a covariance has twice the variance of their sum of squares.
        of_errors = 2 * np.sum(errors**2, axis=(-2, -1))
        return stdtr(freedom, -difference / np.sqrt(variance + of_errors))

    counts = [(len(now), len(then)) for now, then in zip(differences, deviations, strict=True)]
    total = sum(now for now, _ in counts)
    of_one = np.concatenate([np.full(now, 1 + 1 / then) for now, then in counts])
    of_mean = sum(now * (1 + now / then) for now, then in counts) / total**2
    difference, errors = np.concatenate(differences), np.concatenate(of_errors)
    mean, mean_errors = np.mean(difference), np.mean(errors, axis=0)
    return Comparison(
        names,
        np.exp(difference),
        probability(difference, variance * of_one, errors),
        float(np.exp(mean)),
        float(probability(mean, variance * of_mean, mean_errors)),
    )


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
    fitted = {name: fitted[name] for name in parts}
    return Validation(parts, fitted, compare(parts, fitted, by_errors), converged)
