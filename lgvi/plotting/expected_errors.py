"""What an experiment would tell."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..identification import Estimate, Identifiability, JointEstimate
from ..identification.uncertainty.report_table import make_table
from .style import COLORS, GREY, panels

Result = Estimate | JointEstimate | Identifiability


def plot_identifiability(found: Result, *, ax: Axes | None = None) -> Figure:
    """How well each number of a report would be known, or is known after a fit.

    Parameters
    ----------
    found
        What `identifiability`, `identify` or `identify_jointly` returned.
    ax
        Axes; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        A bar for each moment and each other free leaf: its standard error as a part of the number,
        or as it is where the number is about zero. A number that is not observable has a grey bar
        over the whole width.
    """
    names, values, spread, units = make_table(found)
    shown = [k for k, name in enumerate(names) if "inertia " not in name]
    errors = np.array([spread.error[k] for k in shown])
    numbers = np.array([values[k] for k in shown])
    relative = abs(numbers) > errors
    lengths = np.where(relative, 100 * errors / np.where(relative, abs(numbers), 1), errors)
    finite = np.isfinite(lengths) & (lengths > 0)
    figure, (axis,) = panels(ax, 1, height=0.8 + 0.3 * len(shown))
    least = np.min(lengths[finite], initial=1.0) / 5
    most = np.max(lengths[finite], initial=10 * least) * 5
    for row, k in enumerate(shown):
        if finite[row]:
            axis.barh(row, lengths[row] - least, left=least, color=COLORS[0], height=0.6)
            unit = "%" if relative[row] else ("" if units[k] == "1" else units[k])
            axis.text(lengths[row] * 1.15, row, f"{lengths[row]:.2g} {unit}", va="center")
        else:
            words = "not observable" if np.isinf(errors[row]) else "at its bound"
            words = "0" if errors[row] == 0 else words
            axis.barh(row, 3 * most - least, left=least, color=GREY, alpha=0.3, height=0.6)
            axis.text(least * 1.15, row, words, va="center")
    axis.set(xscale="log", xlim=(least, most * 3))
    axis.set_yticks(range(len(shown)), [names[k] for k in shown])
    axis.invert_yaxis()
    axis.set_xlabel("standard error (% of the number,\nor its unit where that is about zero)")
    return figure
