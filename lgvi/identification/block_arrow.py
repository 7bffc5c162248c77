r"""Least squares with a few common unknowns and six for each of many windows.

The normal matrix has the shape of an arrow: blocks of 6 x 6 on the diagonal and one border. Each
window's own unknowns are eliminated by a small $QR$, all windows at once; what is left are a few
rows in the common unknowns. No normal matrix is formed, so that singular values are good to
rounding.

Each window is a triangle with columns for its own unknowns, the common ones, and the residual.
"""

from typing import NamedTuple

import numpy as np

OWN = 6  # unknowns of each window


class Step(NamedTuple):
    """A step of all unknowns."""

    theta: np.ndarray  # (p,)
    own: np.ndarray  # (windows, 6)
    reduction: float  # of the sum of squares, by the linearised problem


def common_rows(triangles: np.ndarray, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows that determine the own unknowns (windows, 6, columns), and what is left of all others.

    `damping` times its column is added as a row for each own unknown; at least as much as keeps
    those that are not observable where they are.
    """
    windows, _, columns = triangles.shape
    damping = max(damping, zero(triangles) / 100)
    triangles = triangles.astype(float)
    length = np.linalg.norm(triangles[:, :, :OWN], axis=1)
    damped = np.zeros((windows, OWN, columns))
    # An own unknown on which nothing depends stays where it is.
    damped[:, range(OWN), range(OWN)] = damping * np.where(length > 0, length, 1.0)
    rows = triangle(np.concatenate([triangles, damped], axis=1))
    left = triangle(rows[:, OWN:, OWN:].reshape(-1, columns - OWN))
    return rows[:, :OWN], left


def zero(triangles: np.ndarray) -> float:
    """What counts as zero of a column of unit length: more than rounding leaves of it."""
    return float(np.finfo(triangles.dtype).eps) ** (1 / 2)


def rank(triangles: np.ndarray, held: np.ndarray) -> int:
    """Number of unknowns that are determined, of all windows and in common."""
    own, left = common_rows(triangles, 0)
    length = np.linalg.norm(triangles[:, :, :OWN], axis=1)
    diagonal = abs(np.diagonal(own[:, :, :OWN], axis1=1, axis2=2))
    common = (left[:, :-1] / lengths(triangles))[:, ~held]
    singular = np.linalg.svd(common, compute_uv=False)
    least = zero(triangles)
    own_rank = np.sum(diagonal > least * np.where(length > 0, length, 1.0))
    return int(own_rank + np.sum(singular > least))


def triangle(rows: np.ndarray) -> np.ndarray:
    """The triangle R of a QR decomposition (..., at most columns, columns)."""
    return np.asarray(np.linalg.qr(rows, mode="r"))


def lengths(triangles: np.ndarray) -> np.ndarray:
    """Lengths of the columns of the common unknowns (p,), 1 where nothing depends on one.

    So it is where a change by one unit is not seen in the residuals but for rounding.
    """
    length = np.linalg.norm(triangles[:, :, OWN:-1].astype(float), axis=(0, 1))
    return np.where(length > zero(triangles), length, 1.0)


def solve(
    triangles: np.ndarray, damping: float, held: np.ndarray, scale: np.ndarray | None = None
) -> Step:
    """A step of Levenberg and Marquardt, with common unknowns left as they are where `held` (p,).

    They are damped in proportion to `scale` (p,), by default the lengths of their columns.
    """
    own, left = common_rows(triangles, damping)
    A, b = left[:, :-1], left[:, -1]
    scale = lengths(triangles) if scale is None else scale
    u, singular, directions = np.linalg.svd(np.where(held, 0, A / scale), full_matrices=False)
    seen = singular > zero(triangles)
    u, singular, directions = u[:, seen], singular[seen], directions[seen]
    along = singular / (singular**2 + damping**2) * (u.T @ b)
    theta = -along @ directions / scale
    remaining = -(own[:, :, -1] + own[:, :, OWN:-1] @ theta)
    phi = np.linalg.solve(own[:, :, :OWN], remaining[..., None])[..., 0]
    change = triangles[:, :, OWN:-1] @ theta
    change += np.einsum("nij,nj->ni", triangles[:, :, :OWN], phi)
    residual = triangles[:, :, -1]
    return Step(theta, phi, float(-np.sum(change * (2 * residual + change))))
