"""What a plan does, and what it gains."""

from collections.abc import Sequence
from itertools import cycle, product

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..identification import Plan
from .expected_errors import draw_errors, rows_to_draw
from .style import COLORS, GREY, SeveralAxes, beside, panels

LINES = list(product(("-", "-.", ":"), COLORS))  # the looks of curves; dashes are limits
MOST_NAMES = 12  # in a legend
LIMIT = {"color": GREY, "lw": 0.8, "ls": "--"}
HEIGHT = 2.2  # inches, of the curves over time


def plot_plan(plan: Plan, *, ax: SeveralAxes = None) -> Figure:
    """What a plan does, and how much better the numbers would be known than without it.

    Parameters
    ----------
    plan
        What [`plan`][lgvi.identification.plan] returned.
    ax
        Axes for each row; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        The size of the angular velocity of each trajectory over time. Where there are commands,
        these over time: of the first trajectory as thick lines, of others as thin ones. A pair of
        bars for each moment and each other free leaf: its standard error by the plan, and by an
        experiment that nobody planned. Limits are dashed.
    """
    bars = 1.2 + 0.45 * len(rows_to_draw(plan.summary()["name"]))
    heights = [HEIGHT] * (1 + bool(plan.commands)) + [bars]
    figure, axes = panels(
        ax, len(heights), height=sum(heights), gridspec_kw={"height_ratios": heights}
    )
    draw_motion(plan, axes[:-1])
    draw_gains(plan, axes[-1])
    return figure


def draw_motion(plan: Plan, axes: Sequence[Axes] | np.ndarray) -> None:
    """The size of the angular velocity and, in other axes, the commands, if there are any."""
    sizes = np.linalg.norm(plan.rates, axis=-1)
    for name, size, (style, color) in zip(plan.recordings.names, sizes, cycle(LINES), strict=False):
        label = f"trajectory {name}"
        axes[0].plot(plan.times, size, lw=1.2, ls=style, color=color, label=label)
    axes[0].axhline(plan.limits.rate, label="limit", **LIMIT)
    axes[0].set_ylim(0, 1.05 * plan.limits.rate)
    axes[0].set_ylabel("angular rate\n(rad/s)")
    if plan.limits.commands is not None:
        commands = plan.limits.commands.of(plan.model)
        alike = np.ptp(commands.lower) == np.ptp(commands.upper) == 0
        bounds = zip(commands.lower, commands.upper, strict=True)
        columns = zip(plan.commands.items(), bounds, cycle(LINES), strict=False)
        for (name, curves), of_column, (style, color) in columns:
            axes[1].plot(plan.knots, curves[1:].T, lw=0.5, ls=style, color=color)
            axes[1].plot(
                plan.knots, curves[0], lw=1.5, ls=style, color=color, marker=".", label=name
            )
            for bound in of_column:
                axes[1].axhline(bound, **(LIMIT if alike else {**LIMIT, "color": color}))
        axes[1].set_ylabel(f"commands\n({commands.unit})")
    for axis in axes:
        axis.set_xlim(plan.times[0], plan.times[-1])
        if len(axis.get_legend_handles_labels()[1]) <= MOST_NAMES:
            beside(axis)
    axes[-1].set_xlabel("time (s)")


def draw_gains(plan: Plan, axis: Axes) -> None:
    """Standard errors by the plan, beside those of an experiment that nobody planned."""
    summary = plan.summary()
    errors = {"planned": summary["standard_error"], "not planned": summary["usual"]}
    draw_errors(summary["name"], summary["value"], summary["unit"], errors, axis)
