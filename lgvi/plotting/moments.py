"""The principal moments with their errors."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from ..identification import Estimate
from .style import COLORS, GREY, NAMES, beside, panels

PAIRS = (0, 1), (0, 2), (1, 2)
LEVELS = {0.68: "-", 0.95: "--"}


def plot_moments(estimate: Estimate, *, ax: Sequence[Axes] | np.ndarray | None = None) -> Figure:
    """The principal moments, two by two, with the ellipses that hold the truth in 68 and 95 %.

    Where it is near, the limit of inertias that a body can have is drawn: beyond it the largest
    moment exceeds the sum of the other two.

    Parameters
    ----------
    estimate
        What `identify` returned.
    ax
        Three axes; by default those of a new figure.

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
        raise ValueError(
            "Argument `estimate` must have principal moments that are observable, but they are not."
        )
    unit = "kg m²" if known else "part of the trace"
    figure, axes = panels(ax, 1, 3, height=2.9)
    for axis, (i, j) in zip(axes, PAIRS, strict=True):
        block = covariance[np.ix_([i, j], [i, j])]
        lengths, directions = np.linalg.eigh(block)
        angle = np.degrees(np.arctan2(directions[1, 1], directions[0, 1]))
        for level, line in LEVELS.items():
            # Of two normal numbers of unit variance, that part is within this radius.
            size = 2 * np.sqrt(-2 * np.log(1 - level) * np.maximum(lengths, 0))
            ellipse = Ellipse(
                tuple(values[[i, j]]),
                *size[::-1],
                angle=angle,
                fill=False,
                color=COLORS[0],
                ls=line,
                label=f"{100 * level:.0f} %",
            )
            axis.add_patch(ellipse)
        axis.plot(*values[[i, j]], "+", color=COLORS[1], ms=9)
        reach = np.maximum(3.5 * np.sqrt(np.diag(block)), 1e-6 * values[[i, j]])
        axis.set_xlim(values[i] - reach[0], values[i] + reach[0])
        axis.set_ylim(values[j] - reach[1], values[j] + reach[1])
        _draw_limit(axis, i, j, values, known)
        axis.set(xlabel=f"{NAMES[i]} ({unit})", ylabel=f"{NAMES[j]} ({unit})")
        axis.ticklabel_format(useOffset=False, scilimits=(-3, 3), useMathText=True)
        axis.locator_params(nbins=4)
        axis.tick_params(axis="x", labelrotation=30)
    named: dict[str, Any] = {}  # the limit is in view in some panels only
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    beside(axes[-1], named.values(), named.keys())
    return figure


def _draw_limit(axis: Axes, i: int, j: int, values: np.ndarray, known: bool) -> None:
    """Where the largest moment is the sum of the others, if that is in view."""
    left, right = axis.get_xlim()
    x = np.array([left, right])
    if j < 2:
        y = (values[2] if known else 0.5) - x
    else:
        y = x + values[1 - i] if known else np.full(2, 0.5)
    low, high = axis.get_ylim()
    if np.all(y < low) or np.all(y > high):
        return
    beyond = low if j < 2 else high
    axis.plot(x, y, color=GREY, lw=1)
    axis.fill_between(x, y, beyond, color=GREY, alpha=0.25, lw=0, label="no body")
    axis.set(xlim=(left, right), ylim=(low, high))
