"""What was recorded, what the fitted model does, and the residuals."""

from itertools import cycle
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..identification import Estimate, FittedPart, Recordings, simulate_recordings
from ..identification.data.formats import INPUTS
from ..identification.data.recordings import stack_trajectories
from .style import COLORS, GREY, SeveralAxes, beside, darker, panels

FINE = 600  # times at which a fitted motion is drawn


def plot_residuals(fitted: Estimate | FittedPart, *, ax: SeveralAxes = None) -> Figure:
    """Residuals over the time since the start of each trajectory, with three standard deviations.

    Parameters
    ----------
    fitted
        What `identify` returned, or a part of what `identify_jointly` returned.
    ax
        Axes for each sensor; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        A row for each sensor. Residuals should lie within the dashed lines and show no pattern.
    """
    recorded = fitted.recordings.channels
    start = np.array([t[0] for t in fitted.recordings.reading_times()])
    figure, axes = panels(ax, len(recorded), height=2.6 * len(recorded), sharex=True)
    for (channel, sensor), axis in zip(fitted.model.sensors.items(), axes, strict=True):
        samples = recorded[channel]
        trajectory = np.repeat(np.arange(len(samples.count)), samples.count)
        draw_residuals(fitted, channel, samples.times - start[trajectory], slice(None), axis)
        beside(axis)
        axis.set_ylabel(f"residual of the\n{channel.replace('_', ' ')} ({sensor.unit})")
    axes[-1].set_xlabel("time since the start of the trajectory (s)")
    return figure


def plot_fit(
    fitted: Estimate | FittedPart, trajectory: str | None = None, *, ax: SeveralAxes = None
) -> Figure:
    """A trajectory as it was recorded, as dots, and as the fitted model moves, as lines.

    The fitted model is simulated from the estimated initial state on a fine grid of times, so that
    lines show the motion between readings, and in gaps.

    Parameters
    ----------
    fitted
        What `identify` returned, or a part of what `identify_jointly` returned.
    trajectory
        Its name; by default the first one.
    ax
        Two axes for each sensor; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        For each sensor readings and motion, with the residuals beneath; attitudes are drawn as
        quaternions, scalar first.

    Raises
    ------
    ValueError
        If there is no trajectory of that name.
    RuntimeError
        If a step of the simulation does not converge.
    """
    names = fitted.recordings.names
    if trajectory is not None and trajectory not in names:
        raise ValueError(f"Argument `trajectory` must be one of {names}, but is {trajectory!r}.")
    i = 0 if trajectory is None else names.index(trajectory)
    sensors = fitted.model.sensors
    ratios = {"height_ratios": [3, 1.2] * len(sensors)}
    size: dict[str, Any] = {"height": 4.2 * len(sensors), "gridspec_kw": ratios}
    figure, axes = panels(ax, 2 * len(sensors), sharex=True, **size)
    motion = _simulate_finely(fitted, i)
    for (channel, sensor), above, below in zip(sensors.items(), axes[::2], axes[1::2], strict=True):
        samples = fitted.recordings.channels[channel]
        draw_curves(sensor, samples.of(i), motion.channels[channel].of(0), above)
        beside(above)
        of_trajectory = np.repeat(np.arange(len(names)), samples.count) == i
        draw_residuals(fitted, channel, samples.times[of_trajectory], of_trajectory, below)
        beside(below)
        below.set_ylabel(f"residual\n({sensor.unit})")
    axes[0].set_title(f"trajectory {names[i]}: recorded (dots) and fitted (lines)")
    axes[-1].set_xlabel("time (s)")
    return figure


def draw_curves(
    sensor: Any,
    recorded: tuple[np.ndarray, np.ndarray],
    fitted: tuple[np.ndarray, np.ndarray],
    axis: Axes,
    dots: Any = slice(None),
) -> None:
    """Recorded readings of a sensor as dots, and fitted readings as lines, both over their times.

    `dots` are the numbers of the readings that are drawn.
    """
    (t, readings), (fine, motion) = recorded, fitted
    # All in the order of time, so that a sensor which makes curves continuous does so for both.
    order = np.argsort(np.concatenate([t, fine]), kind="stable")
    place, curves = sensor.as_curves(np.concatenate([readings, motion])[order])
    is_recorded = order < len(t)
    for color, (label, curve) in zip(cycle(COLORS), curves.items(), strict=False):
        seen = curve[is_recorded][dots]
        axis.plot(t[dots], seen, ".", ms=4, alpha=0.5, color=color, label=label)
        axis.plot(fine, curve[~is_recorded], lw=1, color=darker(color))
    axis.set_ylabel(place)


def draw_residuals(
    fitted: Estimate | FittedPart, channel: str, t: np.ndarray, which: Any, axis: Axes
) -> None:
    """Residuals of some samples in the unit of the sensor, and lines at three deviations of all."""
    sensor = fitted.model.sensors[channel]
    residuals = fitted.residuals[channel] * np.asarray(sensor.sigma)
    for color, component, name in zip(cycle(COLORS), residuals.T, sensor.axes, strict=False):
        axis.plot(t, component[which], ".", ms=3, alpha=0.7, color=color, label=name)
    if len(residuals):
        deviation = 3 * np.sqrt(np.mean(residuals**2))
        for sign, label in ((-1, None), (1, "±3 deviations")):
            axis.axhline(sign * deviation, color=GREY, lw=0.8, ls="--", label=label)
        reach = 1.15 * max(deviation, np.max(abs(residuals)))
        axis.set_ylim(-reach, reach)
    axis.ticklabel_format(axis="y", scilimits=(-2, 4), useMathText=True)


def _simulate_finely(fitted: Estimate | FittedPart, i: int) -> Recordings:
    """Recordings of a trajectory by the fitted model, without noise, on a fine grid of times."""
    model, recordings = fitted.model, fitted.recordings
    if fitted.own is not None:
        model = eqx.combine(jax.tree.map(lambda leaf: jnp.asarray(leaf[i]), fitted.own), model)
    read = recordings.reading_times()[i]
    t = np.linspace(read[0], read[-1], FINE)
    trajectory = dict.fromkeys(model.sensors, (t, np.zeros((FINE, 0))))
    for name, samples in recordings.quantities.items():
        if name in INPUTS:
            trajectory[name] = samples.of(i)
    layout = stack_trajectories([trajectory], (recordings.names[i],))
    return simulate_recordings(model, layout, fitted.states.at(np.array([i])))
