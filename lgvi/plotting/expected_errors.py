"""What an experiment would tell."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from ..identification import Estimate, Identifiability, JointEstimate
from ..identification.uncertainty.report_table import make_table
from .style import COLORS, GREY, beside, panels

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
    figure, (axis,) = panels(ax, 1, height=0.8 + 0.3 * len(rows_to_draw(names)))
    draw_errors(names, values, units, {"": spread.error}, axis)
    return figure


def rows_to_draw(names: Sequence[str] | np.ndarray) -> list[int]:
    """The rows of a report that are drawn: all but the entries of inertias."""
    return [k for k, name in enumerate(names) if "inertia " not in name]


def draw_errors(
    names: Sequence[str] | np.ndarray,
    values: np.ndarray,
    units: Sequence[str] | np.ndarray,
    errors: Mapping[str, np.ndarray],
    axis: Axes,
) -> None:
    """Bars of the standard errors (numbers,) of the rows of a report, by label, the first on top.

    Whether a bar is a part of its number, the first standard error tells.
    """
    shown = rows_to_draw(names)
    numbers = abs(np.asarray(values)[shown])
    by_label = np.array([error[shown] for error in errors.values()])
    relative = numbers > by_label[0]
    lengths = np.where(relative, 100 * by_label / np.where(relative, numbers, 1), by_label)
    finite = np.isfinite(lengths) & (lengths > 0)
    least = np.min(lengths[finite], initial=1.0) / 5
    longest = np.max(lengths[finite], initial=10 * least)
    end = longest * max(15, (longest / least) ** 0.4)  # with room for the words
    thickness = 0.6 if len(errors) == 1 else 0.8 / len(errors)
    for row, k in enumerate(shown):
        for i, length in enumerate(lengths[:, row]):
            place = row + thickness * (i - (len(errors) - 1) / 2)
            if finite[i, row]:
                axis.barh(place, length - least, thickness, left=least, color=COLORS[i])
                unit = "%" if relative[row] else ("" if units[k] == "1" else units[k])
                words = f"{length:.2g}" if length < 100 else f"{length:.0f}"
                axis.text(length * 1.15, place, f"{words} {unit}", va="center")
            else:
                error = by_label[i, row]
                words = "not observable" if np.isinf(error) else "at its bound"
                words = "0" if error == 0 else words
                axis.barh(place, end - least, thickness, left=least, color=GREY, alpha=0.3)
                axis.text(least * 1.15, place, words, va="center")
    axis.set(xscale="log", xlim=(least, end))
    axis.set_yticks(range(len(shown)), [names[k] for k in shown])
    axis.invert_yaxis()
    axis.set_xlabel("standard error (% of the number,\nor its unit where that is about zero)")
    if len(errors) > 1:
        beside(axis, [Patch(color=color) for color, _ in zip(COLORS, errors, strict=False)], errors)
