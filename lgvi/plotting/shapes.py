"""A body: its inertia ellipsoid, and the box that turns as it does."""

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from ..modules.arguments import inertia_of
from ..modules.body import AbstractRigidBody
from .style import COLORS, NAMES, panel_in_space

ROUND = 33  # points along a circle


def equivalent_box(
    body: AbstractRigidBody, mass: float | None = None
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    r"""The edges of the solid box with the inertia of a body, and their directions.

    With the principal moments $I_i$ and the mass $m$ the edges are
    $a_i = \sqrt{6\,(I_j + I_k - I_i)/m}$.

    Parameters
    ----------
    body
        The body.
    mass
        Its mass, kg; `None` gives edges of which the longest is 1.

    Returns
    -------
    tuple
        Lengths (3,), m, and directions in the body frame, which are columns (3, 3).

    Raises
    ------
    ValueError
        If the mass is not above 0, or a body cannot have the inertia.
    """
    J = np.asarray(inertia_of(body))
    moments, axes = np.linalg.eigh(J.astype(float))
    squares = np.sum(moments) - 2 * moments
    rounding = 10 * np.finfo(J.dtype).eps * moments[-1]  # of a flat body
    if not np.all(moments > -rounding) or not np.min(squares) >= -rounding:
        raise ValueError(
            "Argument `body` must have an inertia that a body can have, none of whose moments is "
            f"larger than the sum of the others, but they are {moments}."
        )
    if mass is not None and not 0 < mass < np.inf:
        raise ValueError(f"Argument `mass` must be above 0 kg, but is {mass!r}.")
    squares = np.maximum(squares, 0)
    lengths = np.sqrt(squares / np.max(squares) if mass is None else 6 * squares / mass)
    return lengths, axes * np.sign(np.linalg.det(axes))


def plot_body(
    body: AbstractRigidBody, mass: float | None = None, *, ax: Axes | None = None
) -> Figure:
    r"""The inertia ellipsoid of a body and the solid box that has its inertia, in the body frame.

    The ellipsoid is $x^T J x = \text{const}$: it is long where the moment is small. It is drawn
    as long as the box.

    Parameters
    ----------
    body
        The body.
    mass
        Its mass, kg, which gives the size of the box; without it the longest edge is 1.
    ax
        Axes with `projection="3d"`; by default those of a new figure.

    Returns
    -------
    matplotlib.figure.Figure
        The figure.

    Raises
    ------
    ValueError
        If a body cannot have the inertia, or the mass is not above 0.
    """
    lengths, axes = equivalent_box(body, mass)
    moments = np.linalg.eigvalsh(np.asarray(inertia_of(body), float))
    figure, axis = panel_in_space(ax)
    axis.add_collection3d(box_of(faces_of(lengths) @ axes.T, alpha=0.25))
    longest = 0.5 * np.max(lengths)
    ellipsoid = np.moveaxis((unit_sphere() * ellipsoid_of(body, lengths)) @ axes.T, -1, 0)
    axis.plot_surface(*ellipsoid, color=COLORS[1], alpha=0.25, lw=0)
    words = [f"{each} moment, {x:.4g} kg m²" for each, x in zip(NAMES, moments, strict=True)]
    draw_axes(axis, axes, 1.35 * longest, words)
    unit = "in longest edges" if mass is None else "m"
    label_space(axis, [f"{name} ({unit})" for name in "xyz"], 1.35 * longest)
    axis.legend(loc="upper left", frameon=False)
    return figure


def ellipsoid_of(body: AbstractRigidBody, lengths: np.ndarray) -> np.ndarray:
    """The half axes (3,) of the inertia ellipsoid, which is drawn as long as the box."""
    moments = np.linalg.eigvalsh(np.asarray(inertia_of(body), float))
    return 0.5 * np.max(lengths) * np.sqrt(moments[0] / moments)


def unit_sphere() -> np.ndarray:
    """Points (n, m, 3) of the unit sphere."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, ROUND), np.linspace(0, np.pi, ROUND // 2))
    return np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)


def draw_axes(axis, directions: np.ndarray, reach: float, labels: list[str]) -> None:
    """Principal axes, the columns of `directions`, as dashed lines through the origin."""
    for color, direction, label in zip(COLORS[2:5], directions.T, labels, strict=True):
        ends = np.outer([-reach, reach], direction)
        axis.plot(*ends.T, color=color, lw=1.2, ls="--", label=label)


def faces_of(lengths: np.ndarray) -> np.ndarray:
    """The corners of the faces (6, 4, 3) of a box about the origin, two for each direction."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    faces = np.zeros((3, 2, 4, 3))
    for i in range(3):
        faces[i, :, :, i] = [[-1], [1]]
        faces[i, :, :, (i + 1) % 3], faces[i, :, :, (i + 2) % 3] = square.T
    return faces.reshape(6, 4, 3) * lengths / 2


def box_of(faces: np.ndarray, alpha: float) -> Poly3DCollection:
    """A box, with a colour for each of its three directions."""
    colors = np.repeat(COLORS[:3], 2)
    ink = plt.rcParams["text.color"]
    return Poly3DCollection(faces, facecolors=colors, edgecolors=ink, alpha=alpha, lw=0.8)


def label_space(axis, labels: list[str], reach: float) -> None:
    """Equal scales about the origin, and labels of the three directions."""
    limits = (-reach, reach)
    axis.set(xlim=limits, ylim=limits, zlim=limits)
    axis.set(xlabel=labels[0], ylabel=labels[1], zlabel=labels[2])
    axis.locator_params(nbins=5)
    axis.set_box_aspect((1, 1, 1), zoom=0.85)
    axis.grid(visible=False)
    for direction in (axis.xaxis, axis.yaxis, axis.zaxis):
        direction.set_pane_color((0.5, 0.5, 0.5, 0.06))
