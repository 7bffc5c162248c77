r"""Least squares with a few common unknowns and some for each of many windows: its solution.

The own unknowns of each window are eliminated by a small $QR$, all windows at once; a few rows in
the common unknowns are left. Those of all processes are put together.

Where a window continues the window before, six more rows have the unknowns of both. Such windows
are eliminated from the last to the first, all trajectories at once; the rows that are left of a
window are added to the window before.
"""

from typing import NamedTuple

import numpy as np

from .block_arrow import BlockArrow

SMALL = 1e-4  # part of a prior along what the residuals do not tell that may be rounding
ROUNDING = 1e-13  # of singular values, where rows that tell nothing are exactly zero


class Eliminated(NamedTuple):
    """Rows that determine the own unknowns, and the rows that are left for the common unknowns."""

    own: np.ndarray  # (windows, m, 2m+p+1), with columns as in a gap to the window before
    of_trajectories: np.ndarray  # (trajectories, rows, p+1)
    # Indices of the windows that are solved at once, one group after another.
    order: list[np.ndarray]


class Decomposed(NamedTuple):
    """The rows that are left, `u @ diag(singular) @ directions`, with columns of unit length."""

    singular: np.ndarray  # (q,), falling
    directions: np.ndarray  # (q, p), rows; zero for common unknowns at a bound
    side: np.ndarray  # (q,), the residuals along `u`
    zero: float  # singular values up to this count as zero
    unseen: np.ndarray  # (n, p), directions of which the residuals tell nothing, but a prior may


class Increment(NamedTuple):
    """A step of all unknowns."""

    theta: np.ndarray  # (p,)
    own: np.ndarray  # (windows, m)
    reduction: float  # of the sum of squares, by the linearised problem
    smallest_singular_value: float  # below this damping the step hardly changes


def eliminate(system: BlockArrow, damping: float) -> Eliminated:
    """Eliminate the own unknowns.

    For each own unknown a row of `damping` times the length of its column is added. The least
    damping keeps own unknowns that are not observable where they are.
    """
    windows, _, columns = system.triangles.shape
    m = system.unknowns
    damped = np.zeros((windows, m, columns))
    damped[:, range(m), range(m)] = max(damping, system.zero / 100) * system.own_lengths()
    triangles = system.triangles.astype(float)
    own = np.zeros((windows, m, columns + m))
    position = system.positions
    order = [np.flatnonzero(position == k) for k in range(max(position) + 1)]
    for now in reversed(order[1:]):
        assert system.gaps is not None
        of_window = np.concatenate([triangles[now], damped[now]], axis=1)
        of_window = np.concatenate(
            [of_window[:, :, :m], np.zeros_like(of_window[:, :, :m]), of_window[:, :, m:]], 2
        )
        # The gaps first: their rows are the largest, which keeps the decomposition accurate.
        done = triangularise(np.concatenate([system.gaps[now - 1], of_window], axis=1))
        own[now] = done[:, :m]
        triangles[now - 1] = triangularise(
            np.concatenate([triangles[now - 1], done[:, m:, m:]], axis=1)
        )
    first = order[0]
    done = triangularise(np.concatenate([triangles[first], damped[first]], axis=1))
    own[first, :, :m], own[first, :, 2 * m :] = done[:, :m, :m], done[:, :m, m:]
    return Eliminated(own, done[:, m:, m:], order)


def decompose(
    system: BlockArrow, eliminated: Eliminated, at_bound: np.ndarray, scale: np.ndarray
) -> Decomposed:
    """Singular values of the rows that are left, in units `scale` (p,) of the common unknowns.

    What residuals tell of a direction that they do not determine is rounding. It is left out
    before the prior is added, so that a prior counts whatever its weight is.
    """
    rows = eliminated.of_trajectories
    left = triangularise(rows.reshape(-1, rows.shape[2]))
    if system.together.are_several:
        left = triangularise(system.together.stack(left))
    singular, directions, side = _decompose(left[:, :-1] / scale, left[:, -1], at_bound)
    seen = singular > system.zero
    unseen, prior = directions[~seen], system.of_prior()
    if not len(prior):
        return Decomposed(singular, directions, side, system.zero, unseen)
    of_prior = prior[:, :-1] / scale
    along = of_prior @ unseen.T  # of which a small part is rounding of the directions
    small = np.linalg.norm(along, axis=1) < SMALL * np.linalg.norm(of_prior, axis=1)
    of_prior = of_prior - (along * small[:, None]) @ unseen
    rows = np.concatenate([singular[seen, None] * directions[seen], of_prior])
    sides = np.concatenate([side[seen], prior[:, -1]])
    return Decomposed(*_decompose(rows, sides, at_bound), ROUNDING, unseen)


def _decompose(
    rows: np.ndarray, sides: np.ndarray, at_bound: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As many singular values and directions as there are unknowns that are not at a bound."""
    u, singular, of_free = np.linalg.svd(rows[:, ~at_bound])
    count = len(of_free)
    directions = np.zeros((count, len(at_bound)))
    directions[:, ~at_bound] = of_free
    side = (u.T @ sides)[: len(singular)]
    missing = (0, count - len(singular))
    return np.pad(singular, missing), directions, np.pad(side, missing)


def triangularise(rows: np.ndarray) -> np.ndarray:
    """The triangle R of a QR decomposition (..., at most columns, columns)."""
    return np.asarray(np.linalg.qr(rows, mode="r"))


def solve(
    system: BlockArrow, damping: float, at_bound: np.ndarray, scale: np.ndarray | None = None
) -> Increment:
    """A step of Levenberg and Marquardt; common unknowns at a bound, `at_bound` (p,), stay.

    Common unknowns are damped in proportion to `scale` (p,), by default the lengths of their
    columns.
    """
    eliminated = eliminate(system, damping)
    own, _, order = eliminated
    m = system.unknowns
    scale = system.lengths() if scale is None else scale
    found = decompose(system, eliminated, at_bound, scale)
    observable = found.singular > found.zero
    singular = found.singular[observable]
    along = singular / (singular**2 + damping**2) * found.side[observable]
    theta = system.together.of_first(-along @ found.directions[observable] / scale)

    phi = np.zeros(own.shape[:2])
    remaining = -(own[:, :, -1] + own[:, :, 2 * m : -1] @ theta)
    for now in order:
        before = np.einsum("nij,nj->ni", own[now, :, m : 2 * m], phi[now - 1])
        side = (remaining[now] - before)[..., None]
        phi[now] = np.linalg.solve(own[now, :, :m], side)[..., 0]

    own_and_common = np.column_stack([phi, np.tile(theta, (len(phi), 1))])
    reduction = _reduction(system.triangles, own_and_common)
    if system.gaps is not None:
        both = np.column_stack([np.roll(phi, -1, axis=0), own_and_common])
        reduction += _reduction(system.gaps, both)
    reduction = float(system.together.sum(reduction))
    reduction += _reduction(system.of_prior()[None], theta[None])
    return Increment(theta, phi, reduction, float(min(singular, default=1.0)))


def _reduction(rows: np.ndarray, step: np.ndarray) -> float:
    """The decrease of the sum of squares of some rows by a step of their unknowns."""
    change = np.einsum("nij,nj->ni", rows[:, :, :-1], step)
    return float(-np.sum(change * (2 * rows[:, :, -1] + change)))
