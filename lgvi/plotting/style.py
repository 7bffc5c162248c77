"""What all pictures have in common: colours, sizes, and the axes to draw in."""

from collections.abc import Iterable, Sequence
from numbers import Integral
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

WIDTH = 8.0  # inches, of a page
# After Okabe and Ito, of middle lightness so that they are seen on white and on black.
COLORS = "#2a8fd4", "#e07b22", "#1fa87e", "#c96aa8", "#b39b1e", "#7d7d7d"
GREY = "#8a8a8a"
NAMES = "smallest", "middle", "largest"  # of principal moments
SeveralAxes = Axes | Sequence[Axes] | np.ndarray | None


def darker(color: str) -> tuple[float, float, float]:
    """A colour that is nearer to that of the text."""
    red, green, blue = 0.5 * np.array([to_rgb(color), to_rgb(plt.rcParams["text.color"])]).sum(0)
    return red, green, blue


def panels(
    ax: SeveralAxes,
    rows: int,
    columns: int = 1,
    *,
    height: float,
    **options: Any,
) -> tuple[Figure, np.ndarray]:
    """The figure and its axes (rows * columns,): those that are given, or new ones.

    Raises
    ------
    ValueError
        If another number of axes is given.
    """
    count = rows * columns
    if ax is None:
        figure, axes = plt.subplots(
            rows, columns, figsize=(WIDTH, height), layout="constrained", squeeze=False, **options
        )
        return figure, axes.ravel()
    given = np.array([ax] if isinstance(ax, Axes) else ax, dtype=object).ravel()
    if len(given) != count:
        needed = "one of Matplotlib's axes" if count == 1 else f"{count} of Matplotlib's axes"
        raise ValueError(f"Argument `ax` must be {needed}, but has {len(given)}.")
    return figure_of(given[0]), given


def panel_in_space(ax: Axes | None) -> tuple[Figure, Any]:
    """The figure and one axes with three dimensions.

    Raises
    ------
    ValueError
        If the axes that are given have two dimensions.
    """
    if ax is None:
        figure = plt.figure(figsize=(0.7 * WIDTH, 0.7 * WIDTH), layout="constrained")
        return figure, figure.add_subplot(projection="3d")
    require_space(ax)
    return figure_of(ax), ax


def figure_of(ax: Axes) -> Figure:
    figure = ax.get_figure(root=True)
    assert figure is not None
    return figure


def require_space(ax: Axes) -> None:
    if ax.name != "3d":
        raise ValueError(
            'Argument `ax` must be axes with `projection="3d"`, but has two dimensions.'
        )


def require_count(name: str, value: object) -> None:
    if not isinstance(value, Integral) or int(value) < 1:
        raise ValueError(f"Argument `{name}` must be a whole number above 0, but is {value!r}.")


def beside(axis: Axes, *of: Iterable) -> None:
    """A legend to the right of what is drawn, of handles and labels if these are given."""
    place = {"loc": "center left", "bbox_to_anchor": (1, 0.5), "frameon": False}
    axis.legend(*of, markerscale=3, **place)
