"""The table of all estimated numbers."""

from collections.abc import Iterator

import numpy as np

from .model.free import inertia_and_derivative
from .uncertainty.posterior import AbstractPosterior
from .uncertainty.unobservable import ENTRIES


def format_table(posterior: AbstractPosterior) -> str:
    """A row for each number: its value, standard error, unit, and whether it is observable."""
    lines = [f"{'':32}{'value':>14}{'std. error':>14}  unit"]
    for name, value, error, unit in _rows(posterior):
        words = "not observable" if np.isinf(error) else "at its bound" if np.isnan(error) else ""
        lines.append(f"{name:32}{value:>14.6g}{error:>14.2g}  {unit:8}{words}".rstrip())
    return "\n".join(lines)


def _rows(posterior: AbstractPosterior) -> Iterator[tuple[str, float, float, str]]:
    free, trace_is_known = posterior.free, posterior.scale_is_observable
    J, derivative = inertia_and_derivative(posterior.model, free)
    trace, of_trace = np.trace(J), np.trace(derivative)

    def parts(values: np.ndarray, jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers divided by the trace, and the Jacobian of the quotients."""
        parts = values / trace
        return parts, (jacobian - parts[:, None] * of_trace) / trace

    if free.of_body.any():
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
            errors = np.sqrt(np.diag(posterior.covariance_of(jacobian)))
            # Rounding is not worth printing.
            values = np.where(abs(values) < 1e-12 * np.max(abs(values)), 0, values)
            for label, value, error in zip(labels, values, errors, strict=True):
                yield f"{kind} {label}", float(value), float(error), unit

    proportional = np.isin(free.leaves, posterior.scaled)
    jacobian = np.eye(len(free.theta))
    if not trace_is_known:  # the trace of the model is 1 then
        _, of_parts = parts(free.theta, jacobian)
        jacobian = np.where(proportional[:, None], of_parts, jacobian)
    errors = np.sqrt(np.diag(posterior.covariance_of(jacobian)))
    errors = np.where(posterior.information.at_bound, np.nan, errors)
    for i in np.flatnonzero(~free.of_body):
        name, unit = free.names[i], free.units[i]
        if proportional[i]:
            name = f"{name} / trace"
            unit = unit and ("1" if unit == "kg m²" else f"{unit}/(kg m²)")
        yield name, float(free.theta[i]), float(errors[i]), unit
