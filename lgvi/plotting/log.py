"""What is in a log: signals over time, with the free flights."""

from collections.abc import Sequence
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..logs import Log
from ..logs.signal import Signal
from .style import COLORS, GREY, SeveralAxes, beside, panels

MOST_ROWS = 12
MOST_POINTS = 4000  # of a component; of more samples extremes are drawn
APART = 0.025  # of the width of the picture, between names of flights


def plot_log(
    log: Log, flights: Sequence[tuple[str, float, float]] = (), *, ax: SeveralAxes = None
) -> Figure:
    """Signals of a log over time, with the free flights shaded and named.

    Parameters
    ----------
    log
        The log.
    flights
        For each flight its name, its first and its last time, s, as from
        [`find_free_flights`][lgvi.logs.find_free_flights].
    ax
        Axes for each row; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        A row for each signal that is a quantity by the documentation of the format, in the unit of
        the file. If none is, a row for each signal. Of many the first twelve are drawn.

    Raises
    ------
    ValueError
        If the log has no samples.
    """
    filled = [signal for signal in log.signals.values() if len(signal)]
    if not filled:
        raise ValueError("Argument `log` must have a sample at least, but has none.")
    known = sorted((s for s in filled if s.quantity), key=lambda s: s.quantity)
    rows = (known or filled)[:MOST_ROWS]
    figure, axes = panels(ax, len(rows), height=0.6 + 1.6 * len(rows), sharex=True)
    for signal, axis in zip(rows, axes, strict=True):
        _draw_signal(signal, axis)
        for _, begin, end in flights:
            axis.axvspan(begin, end, color=GREY, alpha=0.25, lw=0)
    _name_flights(flights, axes[0])
    axes[-1].set_xlabel("time since the zero of the log (s)")
    return figure


def _draw_signal(signal: Signal, axis: Axes) -> None:
    columns = signal.values.reshape(len(signal), -1).T
    names = signal.components or [str(i) for i in range(len(columns))]
    for color, name, values in zip(cycle(COLORS), names, columns, strict=False):
        _draw_samples(signal.times, values, axis, color, name)
    named = f"{signal.name}{f' ({signal.unit})' if signal.unit else ''}"
    axis.set_ylabel("\n".join(filter(None, [signal.quantity.replace("_", " "), named])))
    if len(columns) > 1:
        beside(axis)


def _draw_samples(t: np.ndarray, values: np.ndarray, axis: Axes, color: str, label: str) -> None:
    """All samples as dots, or of many stretches of them a line from the lowest to the highest."""
    present = np.isfinite(values)
    t, values = t[present], values[present]
    if len(t) > MOST_POINTS:
        starts = np.linspace(0, len(t), MOST_POINTS // 2, endpoint=False).astype(int)
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        axis.vlines(t[starts], low, high, color=color, lw=0.8, rasterized=True)
        t, values = np.tile(t[starts], 2), np.concatenate([low, high])
    axis.plot(t, values, ".", ms=1.2, color=color, label=label, rasterized=True)


def _name_flights(flights: Sequence[tuple[str, float, float]], axis: Axes) -> None:
    """Names over the shaded parts, as far as there is room."""
    left, right = axis.get_xlim()
    taken = -np.inf
    for name, begin, end in flights:
        middle = (begin + end) / 2
        if middle - taken >= APART * (right - left):
            place = axis.get_xaxis_transform()
            axis.text(middle, 1.02, name, size="small", ha="center", va="bottom", transform=place)
            taken = middle
