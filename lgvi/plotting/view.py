"""Bodies that turn, in a page: the data of their motions, and the elements that show these."""

import json
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from ..modules.body import AbstractRigidBody
from .shapes import ellipsoid_of, equivalent_box
from .style import COLORS


class Motion(NamedTuple):
    """A motion of a body, as recorded, as fitted, or both side by side."""

    name: str
    body: int  # its number among the bodies of the view
    times: Float[np.ndarray, " frames"]  # s
    at: Int[np.ndarray, " frames"]  # the attitude of each frame
    attitudes: dict[str, Float[np.ndarray, "attitudes 3 3"]]  # body to space, by label


def view_of(
    bodies: Sequence[AbstractRigidBody],
    motions: Sequence[Motion],
    words: str,
    *,
    speed: float,
    plays: bool = False,
    ellipsoids: bool = False,
) -> str:
    """Elements of a page that show boxes with the inertia of bodies, and turn them.

    Parameters
    ----------
    bodies
        The bodies.
    motions
        Their motions, of which the reader chooses one.
    words
        What is seen, for those who do not see it.
    speed
        Seconds of a motion that are shown in a second.
    plays
        Whether the motion begins to play, unless the reader has asked for less motion.
    ellipsoids
        Whether inertia ellipsoids are drawn too.

    Raises
    ------
    ValueError
        For an inertia that a body cannot have.
    """
    boxes = [equivalent_box(body) for body in bodies]
    shortest = min(np.min(abs(np.diff(m.times)), initial=np.inf) for m in motions)
    scene = {
        "colors": COLORS[:3],
        "speed": speed,
        "plays": plays,
        "begin": 0.0 if plays else 0.6,
        "digits": int(np.clip(np.ceil(-np.log10(shortest)), 0, 6)),
        "bodies": [
            {
                "lengths": lengths.round(5).tolist(),
                "ellipsoid": ellipsoid_of(body, lengths).round(5).tolist() if ellipsoids else None,
            }
            for body, (lengths, _) in zip(bodies, boxes, strict=True)
        ],
        "motions": [_data_of(motion, boxes[motion.body][1]) for motion in motions],
    }
    controls = ""
    if len(motions) > 1:
        names = "".join(f'<option value="{i}">{escape(m.name)}' for i, m in enumerate(motions))
        controls += f"<label>trajectory <select>{names}</select></label>"
    if max(len(motion.times) for motion in motions) > 1:
        controls += (
            '<button type="button">play</button><input type="range" min="0" value="0" '
            'aria-label="time"><output aria-live="off"></output>'
        )
    data = json.dumps(scene, separators=(",", ":"), allow_nan=False)
    script = files("lgvi.plotting").joinpath("view.js").read_text("utf-8")
    return (
        f'<div class="view"><canvas tabindex="0" role="img" aria-label="{escape(words)}"></canvas>'
        f'<form>{controls}</form><script type="application/json">{data}</script></div>'
        f'<script>{script}showMotions(document.querySelector(".view"));</script>'
    )


def _data_of(motion: Motion, axes: np.ndarray) -> dict[str, object]:
    attitudes = list(motion.attitudes.values())
    apart = None
    if len(attitudes) == 2:
        apart = _angles_between(*(R[motion.at] for R in attitudes)).round(3).tolist()
    quaternions = [Rotation.from_matrix(R @ axes).as_quat(scalar_first=True) for R in attitudes]
    return {
        "body": motion.body,
        "times": motion.times.round(6).tolist(),
        "at": motion.at.tolist(),
        "apart": apart,
        "shown": [
            {"label": label, "attitudes": q.round(5).tolist()}
            for label, q in zip(motion.attitudes, quaternions, strict=True)
        ],
    }


def _angles_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles (n,), in degrees, between attitudes (n, 3, 3)."""
    turn = Rotation.from_matrix(np.swapaxes(first, 1, 2) @ second)
    return np.degrees(turn.magnitude())
