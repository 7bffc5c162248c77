"""Turns of initial attitudes that no reading shows, in words."""

from collections.abc import Iterator

import numpy as np

ALIKE = 0.01  # rad, between axes that count as one


def describe_unseen_turns(turns: np.ndarray, R: np.ndarray) -> Iterator[str]:
    """Axes (trajectories, 3) in the body frame, or zeros, of attitudes R (trajectories, 3, 3)."""
    unseen = np.any(turns != 0, axis=1)
    if not unseen.any():
        return
    axes = np.einsum("nij,nj->ni", np.asarray(R, float)[unseen], turns[unseen])
    spread, directions = np.linalg.eigh(np.einsum("ni,nj->ij", axes, axes) / len(axes))
    axis = directions[:, -1] * np.copysign(1, directions[np.argmax(abs(directions[:, -1])), -1])
    about = "an axis of its own"
    if spread[-1] > 1 - ALIKE**2:
        about = f"({', '.join(f'{x + 0:.2f}' for x in np.round(axis, 2))}) of space"
    which = "" if unseen.all() else f" in {np.sum(unseen)} of {len(unseen)} trajectories"
    yield (
        f"turn of the initial attitude about {about}{which}: a sensor of attitudes, or of another "
        "direction, would make it observable"
    )
