"""Least squares with a few common unknowns and some for each of many windows: its rows.

The normal matrix has the shape of an arrow: small blocks on the diagonal and one border. It is not
formed, so that singular values are good to rounding.
"""

from typing import NamedTuple

import numpy as np

from ..running.processes import SINGLE_PROCESS, ProcessGroup

STATE_SIZE = 6  # unknowns of each window: those of its initial state


SMALL = 1e-4  # part of a prior along what the residuals do not tell that may be rounding
ROUNDING = 1e-13  # of singular values, where rows that tell nothing are exactly zero


class BlockArrow(NamedTuple):
    """A linearised problem: a triangle of rows for each window, and rows for the gaps between them.

    A triangle has columns for the window's own unknowns, the common unknowns and the residual. The
    rows of a gap have columns for the own unknowns of the next window, the own unknowns of this
    window, the common unknowns and the gap; they are zero where the next window does not continue
    this one. Prior rows have columns for the common unknowns and the residual.

    Windows are those of this process; what is said of common unknowns is of all processes.
    """

    triangles: np.ndarray  # (windows, rows, m+p+1)
    gaps: np.ndarray | None = None  # (windows, m, 2m+p+1)
    position: np.ndarray | None = None  # (windows,), number of earlier windows of the trajectory
    prior: np.ndarray | None = None  # (rows, p+1)
    sizes: np.ndarray | float = 1.0  # (p,), units of the common unknowns
    unobservable: np.ndarray | float = 0.0  # (p,), direction that is unobservable exactly, or zero
    unknowns: int = STATE_SIZE  # m, own ones of each window
    processes: ProcessGroup = SINGLE_PROCESS  # processes with windows of their own

    @property
    def rank_tolerance(self) -> float:
        """Singular values up to this, of columns of unit length, count as zero."""
        return float(np.finfo(self.triangles.dtype).eps) ** (1 / 2)

    @property
    def finite(self) -> bool:
        """Whether all numbers and their squares are finite."""
        parts = [self.triangles] if self.gaps is None else [self.triangles, self.gaps]
        with np.errstate(over="ignore"):
            return all(bool(np.isfinite(np.sum(part.astype(float) ** 2))) for part in parts)

    @property
    def positions(self) -> np.ndarray:
        """Number of earlier windows of the trajectory of each window (windows,)."""
        return np.zeros(len(self.triangles), int) if self.position is None else self.position

    @property
    def trajectories(self) -> int:
        """Number of trajectories of this process."""
        return int(np.sum(self.positions == 0))

    def own_lengths(self) -> np.ndarray:
        """Lengths of the columns of own unknowns (windows, m), 1 for a column of zeros."""
        length = np.linalg.norm(self.triangles[:, :, : self.unknowns].astype(float), axis=1)
        return np.where(length > 0, length, 1.0)

    def lengths(self) -> np.ndarray:
        """Lengths of the columns of the common unknowns (p,).

        The length is 1 / unit where a change by one unit changes the residuals by rounding alone.
        """
        length = np.linalg.norm(self.triangles[:, :, self.unknowns : -1].astype(float), axis=(0, 1))
        length = np.linalg.norm(self.processes.gather(length), axis=0)
        length = np.hypot(length, np.linalg.norm(self.of_prior()[:, :-1], axis=0))
        return np.where(
            length * self.sizes > self.rank_tolerance, length, 1 / np.asarray(self.sizes)
        )

    def of_prior(self) -> np.ndarray:
        """The prior rows (rows, p+1), of which there may be none."""
        empty = np.zeros((0, self.triangles.shape[2] - self.unknowns))
        return empty if self.prior is None else self.prior

    def without(self, direction: np.ndarray) -> "BlockArrow":
        """The system with a direction (p,) made unobservable exactly, and not to rounding alone.

        Columns change by as little as can be, each in proportion to its length.
        """
        if not direction.any():
            return self
        weight = self.lengths() ** 2 * direction
        weight /= weight @ direction

        def projected(rows: np.ndarray, first: int) -> np.ndarray:
            common = rows[:, :, first:-1]
            common = common - (common @ direction)[..., None] * weight
            parts = [rows[:, :, :first], common, rows[:, :, -1:]]
            return np.concatenate(parts, axis=2).astype(rows.dtype)

        gaps = None if self.gaps is None else projected(self.gaps, 2 * self.unknowns)
        return self._replace(
            triangles=projected(self.triangles, self.unknowns), gaps=gaps, unobservable=direction
        )

    def of_windows(self, numbers: np.ndarray) -> "BlockArrow":
        """The rows of some windows, of whole trajectories."""
        return self._replace(
            triangles=self.triangles[numbers],
            gaps=None if self.gaps is None else self.gaps[numbers],
            position=None if self.position is None else self.position[numbers],
        )

    def of_all_processes(self) -> "BlockArrow":
        """The rows of the windows of all processes, in each."""
        processes, gaps = self.processes, self.gaps
        if processes.any(gaps is not None):
            shape = self.unknowns, self.triangles.shape[2] + self.unknowns
            gaps = np.zeros((len(self.triangles), *shape)) if gaps is None else gaps
            gaps = processes.stack(gaps)
        return self._replace(
            triangles=processes.stack(self.triangles),
            gaps=gaps,
            position=processes.stack(self.positions),
            processes=SINGLE_PROCESS,
        )

    def gradient(self) -> np.ndarray:
        """Half the derivative of the sum of squares in the common unknowns (p,)."""
        rows = self.triangles[:, :, self.unknowns :]
        if self.gaps is not None:
            rows = np.concatenate([rows, self.gaps[:, :, 2 * self.unknowns :]], axis=1)
        prior = self.of_prior()
        gradient = np.einsum("nij,ni->j", rows[:, :, :-1], rows[:, :, -1]).astype(float)
        gradient = self.processes.sum(gradient)
        return gradient + prior[:, :-1].T @ prior[:, -1]


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
    rank_tolerance: float  # singular values up to this count as zero
    unseen: np.ndarray  # (n, p), directions of which the residuals tell nothing, but a prior may


class Increment(NamedTuple):
    """A step of all unknowns."""

    theta: np.ndarray  # (p,)
    own: np.ndarray  # (windows, m)
    reduction: float  # of the sum of squares, by the linearised problem
    reduction_by_common: float  # the part by the common unknowns, with own ones that follow them
    smallest_singular_value: float  # below this damping the step hardly changes


def eliminate(system: BlockArrow, damping: float) -> Eliminated:
    """Eliminate the own unknowns.

    For each own unknown a row of `damping` times the length of its column is added. The least
    damping keeps own unknowns that are not observable where they are.
    """
    windows, _, columns = system.triangles.shape
    m = system.unknowns
    damped = np.zeros((windows, m, columns))
    damped[:, range(m), range(m)] = max(damping, system.rank_tolerance / 100) * system.own_lengths()
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
    if system.processes.are_several:
        left = triangularise(system.processes.stack(left))
    singular, directions, side = _decompose(left[:, :-1] / scale, left[:, -1], at_bound)
    seen = singular > system.rank_tolerance
    unseen, prior = directions[~seen], system.of_prior()
    if not len(prior):
        return Decomposed(singular, directions, side, system.rank_tolerance, unseen)
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
    decomposed = decompose(system, eliminated, at_bound, scale)
    observable = decomposed.singular > decomposed.rank_tolerance
    singular = decomposed.singular[observable]
    side = decomposed.side[observable]
    along = singular / (singular**2 + damping**2) * side
    theta = system.processes.of_first(-along @ decomposed.directions[observable] / scale)
    by_common = system.processes.of_first(np.sum(side**2 - (side - singular * along) ** 2))

    phi = np.zeros(own.shape[:2])
    remaining = -(own[:, :, -1] + own[:, :, 2 * m : -1] @ theta)
    for now in order:
        before = np.einsum("nij,nj->ni", own[now, :, m : 2 * m], phi[now - 1])
        right = (remaining[now] - before)[..., None]
        phi[now] = np.linalg.solve(own[now, :, :m], right)[..., 0]

    own_and_common = np.column_stack([phi, np.tile(theta, (len(phi), 1))])
    reduction = _reduction(system.triangles, own_and_common)
    if system.gaps is not None:
        both = np.column_stack([np.roll(phi, -1, axis=0), own_and_common])
        reduction += _reduction(system.gaps, both)
    reduction = float(system.processes.sum(reduction))
    reduction += _reduction(system.of_prior()[None], theta[None])
    smallest = float(min(singular, default=1.0))
    return Increment(theta, phi, reduction, float(by_common), smallest)


def _reduction(rows: np.ndarray, step: np.ndarray) -> float:
    """The decrease of the sum of squares of some rows by a step of their unknowns."""
    change = np.einsum("nij,nj->ni", rows[:, :, :-1], step)
    return float(-np.sum(change * (2 * rows[:, :, -1] + change)))
