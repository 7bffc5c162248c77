"""A simulated motion: its polhode, and how well it keeps what must be conserved."""

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..core.diagnostics import ortho_error, spatial_momentum
from ..modules.arguments import inertia_of
from ..modules.body import AbstractRigidBody
from ..modules.trajectory import Trajectory
from .shapes import box_of, draw_axes, equivalent_box, faces_of, label_space, unit_sphere
from .style import (
    COLORS,
    GREY,
    NAMES,
    WIDTH,
    SeveralAxes,
    panel_in_space,
    panels,
    require_count,
    require_space,
)

LEAST = 1e-17  # error that is drawn


def plot_polhode(
    body: AbstractRigidBody, trajectory: Trajectory, *, ax: Axes | None = None
) -> Figure:
    r"""The curve of the angular momentum in the body frame, on the sphere on which it stays.

    Without torque it lies where the sphere $|\pi| = \text{const}$ meets the ellipsoid of constant
    energy.

    Parameters
    ----------
    body
        The body; its principal axes are drawn.
    trajectory
        Its motion.
    ax
        Axes with `projection="3d"`; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        The figure.
    """
    pi = np.asarray(trajectory.pi, float)
    _, axes = np.linalg.eigh(np.asarray(inertia_of(body), float))
    figure, axis = panel_in_space(ax)
    radius = float(np.max(np.linalg.norm(pi, axis=1)))
    sphere = np.moveaxis(radius * unit_sphere(), -1, 0)
    axis.plot_wireframe(*sphere, color=GREY, lw=0.3, alpha=0.5)
    axis.plot(*pi.T, color=COLORS[1], lw=1.2, label="momentum")
    draw_axes(axis, axes, 1.25 * radius, [f"axis of the {name} moment" for name in NAMES])
    names = [rf"$\pi_{name}$ (kg m²/s)" for name in "xyz"]
    label_space(axis, names, 1.25 * radius)
    axis.legend(loc="upper left", frameon=False)
    return figure


def plot_snapshots(
    body: AbstractRigidBody,
    trajectory: Trajectory,
    count: int = 5,
    *,
    ax: SeveralAxes = None,
) -> Figure:
    """The box that has the inertia of a body at some instants, side by side, in the space frame.

    Parameters
    ----------
    body
        The body.
    trajectory
        Its motion.
    count
        Number of instants, from the first state to the last; the time of each is below it.
    ax
        As many axes with `projection="3d"`; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        The figure, with the path of a corner since the instant before.

    Raises
    ------
    ValueError
        If a body cannot have the inertia, `count` is not a whole number above 0, or other axes are
        given.
    """
    require_count("count", count)
    lengths, principal = equivalent_box(body)
    R = np.asarray(trajectory.R, float) @ principal
    faces, path = faces_of(lengths), R @ (lengths / 2)
    at = np.round(np.linspace(0, len(R) - 1, count)).astype(int)
    space = {"subplot_kw": {"projection": "3d"}}
    figure, axes = panels(ax, 1, count, height=WIDTH / count + 0.4, **space)
    for axis, before, k in zip(axes, [0, *at], at, strict=False):
        require_space(axis)
        axis.add_collection3d(box_of(faces @ R[k].T, alpha=0.85))
        axis.plot(*path[before : k + 1].T, color=COLORS[1], lw=1)
        label_space(axis, ["", "", ""], float(np.linalg.norm(lengths / 2)))
        axis.set_box_aspect((1, 1, 1), zoom=1.4)
        axis.set_axis_off()
        axis.set_title(f"{float(trajectory.t[k]):.3g} s", y=-0.12)
    return figure


def plot_invariants(
    body: AbstractRigidBody, trajectory: Trajectory, *, ax: Axes | None = None
) -> Figure:
    r"""How far energy and spatial momentum are from where they began, and $R^TR$ from $I$.

    Parameters
    ----------
    body
        The body.
    trajectory
        Its motion.
    ax
        Axes; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        Relative errors of the energy and of the momentum $R\pi$, and $\|R^TR - I\|$.
    """
    R, pi, _ = trajectory
    energy = np.asarray(jax.vmap(body.energy)(pi), float)
    momentum = np.asarray(jax.vmap(spatial_momentum)(R, pi), float)
    size = np.linalg.norm(momentum[0])
    errors = {
        "energy": abs(energy - energy[0]) / (abs(energy[0]) or 1.0),
        "spatial momentum": np.linalg.norm(momentum - momentum[0], axis=1) / (size or 1.0),
        "orthogonality": np.asarray(jax.vmap(ortho_error)(R), float),
    }
    figure, (axis,) = panels(ax, 1, height=3.2)
    t = np.asarray(trajectory.t, float)
    for color, (name, error) in zip(COLORS, errors.items(), strict=False):
        axis.plot(t, np.maximum(error, LEAST), color=color, lw=1, label=name)
    axis.set(yscale="log", xlabel="time (s)", ylabel="error")
    axis.legend(frameon=False, ncols=3, loc="lower left", bbox_to_anchor=(0, 1))
    return figure
