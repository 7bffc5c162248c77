"""Least squares with a few common unknowns and some for each of many windows: its rows.

The normal matrix has the shape of an arrow: small blocks on the diagonal and one border. It is not
formed, so that singular values are good to rounding.
"""

from typing import NamedTuple

import numpy as np

from ..together import ALONE, Together

OWN = 6  # unknowns of each window: those of its initial state


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
    unknowns: int = OWN  # m, own ones of each window
    together: Together = ALONE  # processes with windows of their own

    @property
    def zero(self) -> float:
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
        length = np.linalg.norm(self.together.gather(length), axis=0)
        length = np.hypot(length, np.linalg.norm(self.of_prior()[:, :-1], axis=0))
        return np.where(length * self.sizes > self.zero, length, 1 / np.asarray(self.sizes))

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
        together, gaps = self.together, self.gaps
        if together.any(gaps is not None):
            shape = self.unknowns, self.triangles.shape[2] + self.unknowns
            gaps = np.zeros((len(self.triangles), *shape)) if gaps is None else gaps
            gaps = together.stack(gaps)
        return self._replace(
            triangles=together.stack(self.triangles),
            gaps=gaps,
            position=together.stack(self.positions),
            together=ALONE,
        )

    def gradient(self) -> np.ndarray:
        """Half the derivative of the sum of squares in the common unknowns (p,)."""
        rows = self.triangles[:, :, self.unknowns :]
        if self.gaps is not None:
            rows = np.concatenate([rows, self.gaps[:, :, 2 * self.unknowns :]], axis=1)
        prior = self.of_prior()
        found = np.einsum("nij,ni->j", rows[:, :, :-1], rows[:, :, -1]).astype(float)
        found = self.together.sum(found)
        return found + prior[:, :-1].T @ prior[:, -1]
