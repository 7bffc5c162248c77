"""An estimate as text."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri

from .directions import ENTRIES
from .model import inertia_and_derivative
from .noise import correlations, part_left

if TYPE_CHECKING:
    from .estimate import Estimate
    from .knowledge import AbstractKnowledge

UNITS = {
    "gyroscope.bias": "rad/s",
    "gyroscope.scale": "1",
    "gyroscope.alignment": "rad",
    "gyroscope.time_offset": "s",
    "attitude.alignment": "rad",
    "attitude.time_offset": "s",
    "rotor_inertia": "kg m²",
    "time_scale": "1",
}


def table(knowledge: "AbstractKnowledge") -> str:
    """A row for each number: its value, standard error, unit, and whether it is observable."""
    lines = [f"{'':32}{'value':>14}{'std. error':>14}  unit"]
    for name, value, error, unit in _rows(knowledge):
        words = "not observable" if np.isinf(error) else "at its bound" if np.isnan(error) else ""
        lines.append(f"{name:32}{value:>14.6g}{error:>14.2g}  {unit:8}{words}".rstrip())
    return "\n".join(lines)


def _rows(knowledge: "AbstractKnowledge") -> Iterator[tuple[str, float, float, str]]:
    free, trace_is_known = knowledge.free, knowledge.scale_is_observable
    J, derivative = inertia_and_derivative(knowledge.model, free)
    trace, of_trace = np.trace(J), np.trace(derivative)

    def parts(values: np.ndarray, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Divided by the trace, and so the Jacobian."""
        parts = values / trace
        return parts, (jacobian - parts[:, None] * of_trace) / trace

    if any(leaf.startswith("body") for leaf in free.leaves):
        if not trace_is_known:
            yield "trace of the inertia", 1.0, np.inf, "kg m²"
        at = tuple(zip(*ENTRIES.values(), strict=True))
        moments, axes = np.linalg.eigh(J)
        of_moments = np.einsum("im,ijp,jm->mp", axes, derivative, axes)
        unit = "kg m²" if trace_is_known else "1"
        for kind, labels, values, jacobian in (
            ("inertia", ENTRIES, J[at], derivative[at]),
            ("principal moment,", ("smallest", "middle", "largest"), moments, of_moments),
        ):
            if not trace_is_known:
                values, jacobian = parts(values, jacobian)
            errors = np.sqrt(np.diag(knowledge.covariance_of(jacobian)))
            # Rounding is not worth printing.
            values = np.where(abs(values) < 1e-12 * np.max(abs(values)), 0, values)
            for label, value, error in zip(labels, values, errors, strict=True):
                yield f"{kind} {label}", float(value), float(error), unit

    proportional = np.isin(free.leaves, knowledge.scaled)
    values, jacobian = free.theta, np.eye(len(free.theta))
    if not trace_is_known:
        of_parts = parts(values, jacobian)
        values = np.where(proportional, of_parts[0], values)
        jacobian = np.where(proportional[:, None], of_parts[1], jacobian)
    errors = np.sqrt(np.diag(knowledge.covariance_of(jacobian)))
    errors = np.where(knowledge.information.held, np.nan, errors)
    for i, (name, leaf) in enumerate(zip(free.names, free.leaves, strict=True)):
        if not leaf.startswith("body"):
            over_trace = " / trace" if proportional[i] else ""
            unit = UNITS.get(leaf, "")
            unit = "1" if proportional[i] and unit == "kg m²" else unit
            yield f"{name}{over_trace}", float(free.theta[i]), float(errors[i]), unit


def statistics(estimate: "Estimate") -> str:
    """How well the model fits, and which trajectories it does not."""
    chi_square, freedom = estimate.chi_square, estimate.degrees_of_freedom
    lines = [f"trajectories: {len(estimate.recordings)}, degrees of freedom: {freedom}"]
    if freedom:
        kind = "robust loss" if estimate.model.is_robust else "chi-square"
        lines[0] += f", {kind} for each: {chi_square / freedom:.4g}"
    for name, unit, sensor, rms, usual, found in _sensors(estimate):
        lines.append(
            f"{name}: residual {rms:.4g} {unit} for each axis, {usual:.4g} {unit} by the median "
            f"(sigma {sensor}), correlation of successive ones {found.value:+.3f} +- "
            f"{found.error:.3f}"
        )
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
    lines += [f"note: {message}" for message in estimate.messages]
    return "\n".join(lines)


def _sensors(estimate: "Estimate"):
    model, recorded = estimate.model, estimate.recordings.sensed
    part = part_left(estimate.recordings, estimate.degrees_of_freedom)
    named = (("attitude", "rad"), ("angular velocity", "rad/s"))
    found = correlations(estimate.residuals, estimate.recordings)
    for (name, unit), sensor, r, samples, correlation in zip(
        named, model.sensors, estimate.residuals, recorded, found, strict=True
    ):
        if sensor is None or r is None or samples is None or correlation is None or not part:
            continue
        s = np.sum(r**2, axis=1) / part
        size = np.sqrt(np.mean(np.asarray(sensor.sigma) ** 2))
        rms = size * np.sqrt(np.mean(s) / 3)
        usual = size * np.sqrt(np.median(s) / chdtri(3, 0.5))  # outliers hardly change it
        sigma = np.array2string(
            np.asarray(sensor.sigma, float), formatter={"float": "{:.4g}".format}
        )
        yield name, unit, sigma, rms, usual, correlation
