"""An estimate as text."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.special import chdtri

from .directions import ENTRIES
from .model import Model
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
    free = knowledge.free
    trace_is_known = knowledge.scale_is_observable

    def whole(model: Model):
        """What everything is divided by: the trace, where the size of the inertia is unknown."""
        return 1.0 if trace_is_known else jnp.trace(model.body.inertia)

    if any(leaf.startswith("body") for leaf in free.leaves):
        if not trace_is_known:
            yield "trace of the inertia", 1.0, np.inf, "kg m²"

        def entries(model: Model):
            return (model.body.inertia / whole(model))[tuple(zip(*ENTRIES.values(), strict=True))]

        def moments(model: Model):
            return jnp.linalg.eigvalsh(model.body.inertia / whole(model))

        unit = "kg m²" if trace_is_known else "1"
        for kind, labels, quantity in (
            ("inertia", ENTRIES, entries),
            ("principal moment,", ("smallest", "middle", "largest"), moments),
        ):
            values, errors = quantity(knowledge.model), knowledge.standard_error(quantity)
            zero = 1e-12 * float(jnp.max(jnp.abs(values)))  # rounding, not worth printing
            values = jnp.where(jnp.abs(values) < zero, 0, values)
            for label, value, error in zip(labels, values, errors, strict=True):
                yield f"{kind} {label}", float(value), float(error), unit

    proportional = np.isin(free.leaves, knowledge.scaled)

    def leaves(model: Model):
        theta = ravel_pytree(eqx.filter(model, free.selected))[0]
        return jnp.where(proportional, theta / whole(model), theta)

    errors = np.where(knowledge.information.held, np.nan, knowledge.standard_error(leaves))
    for i, (name, leaf) in enumerate(zip(free.names, free.leaves, strict=True)):
        if not leaf.startswith("body"):
            of_trace = " / trace" if proportional[i] else ""
            unit = UNITS.get(leaf, "")
            unit = "1" if proportional[i] and unit == "kg m²" else unit
            yield f"{name}{of_trace}", float(free.theta[i]), float(errors[i]), unit


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
        s = np.sum(np.asarray(r)[samples.mask] ** 2, axis=1) / part
        size = np.sqrt(np.mean(np.asarray(sensor.sigma) ** 2))
        rms = size * np.sqrt(np.mean(s) / 3)
        usual = size * np.sqrt(np.median(s) / chdtri(3, 0.5))  # outliers hardly change it
        sigma = np.array2string(
            np.asarray(sensor.sigma, float), formatter={"float": "{:.4g}".format}
        )
        yield name, unit, sigma, rms, usual, correlation
