"""Pictures of estimates. The only part of the package that needs Matplotlib."""

from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from .identification import Estimate, Samples


def _trajectories(samples: Samples) -> np.ndarray:
    """The trajectory of each sample."""
    return np.repeat(np.arange(len(samples.count)), samples.count)


def _rows(count: int) -> tuple[Figure, np.ndarray]:
    size = (8, 3 * count)
    figure, rows = plt.subplots(
        count, 1, figsize=size, layout="constrained", squeeze=False, sharex=True
    )
    return figure, rows[:, 0]


def plot_residuals(estimate: Estimate) -> Figure:
    """Residuals over the time since the start of each trajectory, with three standard deviations.

    Parameters
    ----------
    estimate
        What `identify` returned.

    Returns
    -------
    matplotlib.figure.Figure
        A row for each sensor. Residuals should lie within the dashed lines and show no pattern.
    """
    recorded = estimate.recordings.channels
    start = np.array([t[0] for t in estimate.recordings.reading_times()])
    figure, axes = _rows(len(recorded))
    for (channel, sensor), axis in zip(estimate.model.sensors.items(), axes, strict=True):
        samples = recorded[channel]
        residuals = estimate.residuals[channel] * np.asarray(sensor.sigma)
        since = samples.times - start[_trajectories(samples)]
        for component, name in zip(residuals.T, sensor.axes, strict=True):
            axis.plot(since, component, ".", ms=2, alpha=0.6, label=name)
        if not len(residuals):
            continue
        deviation = 3 * np.sqrt(np.mean(residuals**2))
        for sign in (-1, 1):
            axis.axhline(sign * deviation, color="0.4", lw=0.8, ls="--")
        axis.ticklabel_format(axis="y", scilimits=(-2, 4), useMathText=True)
        axis.set_ylabel(f"residual of the\n{channel.replace('_', ' ')} ({sensor.unit})")
        axis.legend(markerscale=5, loc="center left", bbox_to_anchor=(1, 0.5))
    axes[-1].set_xlabel("time since the start of the trajectory (s)")
    return figure


def plot_prediction(estimate: Estimate, trajectory: str | None = None) -> Figure:
    """What was recorded of a trajectory, as dots, and what the estimate predicts, as lines.

    Parameters
    ----------
    estimate
        What `identify` returned.
    trajectory
        Its name; by default the first one.

    Returns
    -------
    matplotlib.figure.Figure
        A row for each sensor; attitudes are drawn as quaternions, scalar first.

    Raises
    ------
    ValueError
        If there is no trajectory of that name.
    """
    names = estimate.recordings.names
    if trajectory is not None and trajectory not in names:
        raise ValueError(f"Argument `trajectory` must be one of {names}, but is {trajectory!r}.")
    i = 0 if trajectory is None else names.index(trajectory)
    figure, axes = _rows(len(estimate.model.sensors))
    for (channel, sensor), axis in zip(estimate.model.sensors.items(), axes, strict=True):
        samples = estimate.recordings.channels[channel]
        t, recorded = samples.of(i)
        predicted = samples.split(estimate.predicted[channel])[i]
        # One after the other, so that a sensor which makes curves continuous does so for both.
        both = np.stack([recorded, predicted], axis=1).reshape(-1, *recorded.shape[1:])
        place, curves = sensor.as_curves(both)
        for label, values in curves.items():
            (dots,) = axis.plot(t, values[::2], ".", ms=4, alpha=0.4, label=label)
            axis.plot(t, values[1::2], lw=1, color=_darker(dots.get_color()))
        axis.set_ylabel(place)
        axis.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    axes[0].set_title(f"trajectory {names[i]}: recorded (dots) and predicted (lines)")
    axes[-1].set_xlabel("time (s)")
    return figure


def _darker(color: Any) -> tuple[float, ...]:
    return tuple(0.5 * part for part in to_rgb(color))


def plot_moments(estimate: Estimate) -> Figure:
    """The principal moments, two by two, with the ellipses that hold the truth in 68 and 95 %.

    Parameters
    ----------
    estimate
        What `identify` returned.

    Returns
    -------
    matplotlib.figure.Figure
        Three panels; moments are parts of the trace where the scale is not observable.

    Raises
    ------
    ValueError
        If the moments are not observable.
    """
    known = estimate.scale_is_observable

    def moments(model):
        J = model.body.inertia
        return jnp.linalg.eigvalsh(J if known else J / jnp.trace(J))

    values, covariance = np.asarray(moments(estimate.model)), estimate.covariance(moments)
    if not np.all(np.isfinite(covariance)):
        raise ValueError("The principal moments of the estimate are not observable.")
    unit = "(kg m²)" if known else "(part of the trace)"
    names = ("smallest", "middle", "largest")
    figure, axes = plt.subplots(1, 3, figsize=(10, 3.4), layout="constrained")
    for axis, (i, j) in zip(axes, ((0, 1), (0, 2), (1, 2)), strict=True):
        block = covariance[np.ix_([i, j], [i, j])]
        lengths, directions = np.linalg.eigh(block)
        angle = np.degrees(np.arctan2(directions[1, 1], directions[0, 1]))
        for part in (0.68, 0.95):
            # Of two normal numbers of unit variance, that part is within this radius.
            size = 2 * np.sqrt(-2 * np.log(1 - part) * lengths)
            center = values[i], values[j]
            axis.add_patch(Ellipse(center, size[1], size[0], angle=angle, fill=False))
        axis.plot(*values[[i, j]], "+", color="black")
        spread = np.maximum(3.5 * np.sqrt(np.diag(block)), 1e-6 * values[[i, j]])
        axis.set_xlim(values[i] - spread[0], values[i] + spread[0])
        axis.set_ylim(values[j] - spread[1], values[j] + spread[1])
        axis.set(xlabel=f"{names[i]} moment {unit}", ylabel=f"{names[j]} moment {unit}")
        axis.ticklabel_format(useOffset=True, style="sci", scilimits=(-3, 3))
        axis.tick_params(axis="x", labelrotation=30)
    return figure
