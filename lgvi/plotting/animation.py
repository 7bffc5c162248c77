"""A motion as moving pictures: a GIF, a film, or a page to turn and to stop."""

from importlib.resources import files
from os import PathLike
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, writers
from matplotlib.figure import Figure

from ..modules.body import AbstractRigidBody
from ..modules.trajectory import Trajectory
from .shapes import box_of, equivalent_box, faces_of, label_space
from .style import COLORS, panel_in_space, require_count
from .view import Motion, view_of

WRITERS = {".gif": "pillow", ".mp4": "ffmpeg"}
MOST_TRACED = 4000  # points of the path of a corner


def animate(
    body: AbstractRigidBody,
    trajectory: Trajectory,
    file: str | PathLike[str],
    *,
    frames: int = 150,
    fps: int = 25,
) -> Path:
    """Write moving pictures of the box that has the inertia of a body, in the space frame.

    Parameters
    ----------
    body
        The body.
    trajectory
        Its motion, with stored states at equal intervals.
    file
        `.gif`, `.mp4` (needs the program FFmpeg), or `.html`: a page by itself, with a view to turn
        and a slider for the time.
    frames
        How many of the stored states are shown, at most.
    fps
        Frames in a second.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    ValueError
        For another kind of file, a number that is not a whole one above 0, or an inertia that a
        body cannot have.
    RuntimeError
        If FFmpeg is not there.
    """
    path = Path(file)
    if path.suffix not in (*WRITERS, ".html"):
        raise ValueError(f"Argument `file` must end with .gif, .mp4 or .html, but is {file!r}.")
    for name, number in (("frames", frames), ("fps", fps)):
        require_count(name, number)
    lengths, axes = equivalent_box(body)
    R = np.asarray(trajectory.R, float) @ axes  # from principal axes to space
    count = len(R)
    shown = np.round(np.linspace(0, count - 1, min(frames, count))).astype(int)
    if path.suffix == ".html":
        path.write_text(_page(body, trajectory, shown, fps), encoding="utf-8")
        return path
    if not writers.is_available(WRITERS[path.suffix]):
        raise RuntimeError(f"{path.suffix} needs the program FFmpeg: write .gif or .html instead.")
    figure, film = _film(R, lengths, shown)
    try:
        film.save(path, writer=WRITERS[path.suffix], fps=fps)
    finally:
        plt.close(figure)
    return path


def _film(R: np.ndarray, lengths: np.ndarray, shown: np.ndarray) -> tuple[Figure, FuncAnimation]:
    figure, axis = panel_in_space(None)
    faces = faces_of(lengths)
    box = axis.add_collection3d(box_of(faces @ R[0].T, alpha=0.85))
    thin = len(R) // MOST_TRACED + 1
    path = R[::thin] @ (lengths / 2)
    (trace,) = axis.plot([], [], [], color=COLORS[1], lw=1)
    label_space(axis, list("xyz"), float(np.linalg.norm(lengths / 2)))
    axis.set_axis_off()

    def draw(k: int):
        box.set_verts(faces @ R[k].T)
        trace.set_data_3d(*path[: k // thin + 1].T)
        return [box, trace]

    return figure, FuncAnimation(figure, draw, frames=shown)


def _page(body: AbstractRigidBody, trajectory: Trajectory, shown: np.ndarray, fps: int) -> str:
    R, t = np.asarray(trajectory.R, float), np.asarray(trajectory.t, float)[shown]
    traced = np.unique(np.concatenate([np.arange(0, len(R), len(R) // MOST_TRACED + 1), shown]))
    motion = Motion("", 0, t, np.searchsorted(traced, shown), {"": R[traced]})
    frame = abs(t[-1] - t[0]) / max(len(t) - 1, 1)  # s
    words = "A box that turns, and the path of a corner. Arrow keys turn the view."
    view = view_of([body], [motion], words, speed=frame * fps, plays=True)
    template = files("lgvi.plotting").joinpath("animation.html").read_text("utf-8")
    return template.replace("VIEW", view)
