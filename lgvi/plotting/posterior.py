"""How well a number is known: a normal distribution, its profile, and draws of the posterior."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..identification import Estimate, JointEstimate, PosteriorDraws, Profile
from ..identification.model.free_leaves import Quantity
from .style import COLORS, GREY, beside, panels

BINS = 50
MARGIN = 0.04  # beside the longest interval, of its length


def plot_posterior(
    estimate: Estimate | JointEstimate,
    quantity: Quantity,
    profile: Profile,
    draws: PosteriorDraws,
    *,
    label: str = "",
    ax: Axes | None = None,
) -> Figure:
    """How well a number is known, by three ways, with the interval of each beneath.

    Parameters
    ----------
    estimate
        What `identify` or `identify_jointly` returned.
    quantity
        A function of the model that gives one number.
    profile
        What `estimate.profile(quantity)` returned.
    draws
        What `estimate.sample` returned.
    label
        The name of the number, with its unit.
    ax
        Axes; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        The normal distribution of the standard error of the kind `"independent"`, the likelihood
        along the profile, at a height at which its area is that of the other two, and the histogram
        of the draws.

    Raises
    ------
    ValueError
        If the profile is that of another quantity, or the quantity is not observable.
    """
    value = np.asarray(quantity(estimate.parameters), float)
    error = np.asarray(estimate.standard_error(quantity, "independent"))
    if value.size != 1 or not np.isclose(value.item(), profile.value):
        raise ValueError(
            f"Argument `profile` must be that of `quantity`, which is {value} at the estimate, but "
            f"is that of a number that is {profile.value:.6g}."
        )
    if not np.isfinite(error.item()):
        raise ValueError("Argument `quantity` must be observable, but its standard error is inf.")
    figure, (axis,) = panels(ax, 1, height=3.2)
    numbers = np.asarray(draws.evaluate(quantity), float).ravel()
    normal = [float(np.asarray(end).item()) for end in estimate.interval(quantity, "independent")]
    drawn = [float(np.asarray(end).item()) for end in draws.interval(quantity)]
    ends = [x for x in (*normal, *drawn, *profile.values) if np.isfinite(x)]
    margin = MARGIN * (max(ends) - min(ends))
    x = np.linspace(min(ends) - margin, max(ends) + margin, 400)
    axis.hist(
        numbers, BINS, range=(x[0], x[-1]), density=True, color=GREY, alpha=0.4, label="draws"
    )
    error = error.item()
    shape = np.exp(-(((x - profile.value) / error) ** 2) / 2) / (error * np.sqrt(2 * np.pi))
    axis.plot(x, shape, color=COLORS[0], label="normal")
    # The root of the rise of chi-square is nearly a line, so that a few of its points tell it.
    signed = np.sign(profile.values - profile.value) * np.sqrt(profile.rises)
    inside = x[(x >= profile.values[0]) & (x <= profile.values[-1])]
    root = np.interp(inside, profile.values, signed) / np.sqrt(estimate.variance)
    shape = np.exp(-(root**2) / 2)
    axis.plot(inside, shape / np.trapezoid(shape, inside), color=COLORS[1], label="profile")
    top = axis.get_ylim()[1]
    rows = {COLORS[0]: normal, COLORS[1]: [profile.lower, profile.upper], GREY: drawn}
    for row, (color, interval) in enumerate(rows.items(), 1):
        at = np.clip(interval, x[0], x[-1])
        axis.plot(at, [-0.05 * row * top] * 2, color=color, marker="|", solid_capstyle="butt")
    axis.axhline(0, color=GREY, lw=0.8)
    axis.set(xlabel=label, ylabel="density", xlim=(x[0], x[-1]), yticks=[])
    beside(axis)
    return figure
